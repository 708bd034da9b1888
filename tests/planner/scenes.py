"""A small scene to test the planner with, and the parts that a test may put in place of its own."""

from pathlib import Path

from vibrocast.planner.scene import Scene, read_scene

TEXTURE = '[[textures]]\ngenerate = "wood"\nseconds = 0.6\nrate_hz = 2800\n'
HAND = "[hand]\nspeed_mm_s = 60\n"
CONTROLLER = '[[controllers]]\nname = "one"\naddress = "cortex-m4"\n'
ACTUATOR = '[[actuators]]\nmodel = "piezo-stack"\n'
ASKED = "[asked]\nsnr_db = 10\n"


def written(folder: Path, **changed: str) -> Path:
    """Write the scene, some of its parts replaced, and return its path."""
    parts = {"texture": TEXTURE, "hand": HAND, "controller": CONTROLLER, "actuator": ACTUATOR, "asked": ASKED}
    path = folder / "scene.toml"
    path.write_text("\n".join({**parts, **changed}.values()), encoding="utf-8")
    return path


def scene(folder: Path, **changed: str) -> Scene:
    """Write the scene, some of its parts replaced, and read it."""
    return read_scene(written(folder, **changed))
