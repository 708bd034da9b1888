"""The planner: from a scene - textures, hand, actuators, controllers, requirements - to how each texture is coded."""

from vibrocast.host.planner.choose import PlanningError, TextureChoice, plan
from vibrocast.host.planner.plan_file import Plan, PlanError, PlannedTexture, read_plan, write_plan
from vibrocast.host.planner.playing import PartlyPlayedError, Played, play
from vibrocast.host.planner.scene import Scene, SceneError, read_scene

__all__ = [
    "PartlyPlayedError",
    "Plan",
    "PlanError",
    "PlannedTexture",
    "PlanningError",
    "Played",
    "Scene",
    "SceneError",
    "TextureChoice",
    "plan",
    "play",
    "read_plan",
    "read_scene",
    "write_plan",
]
