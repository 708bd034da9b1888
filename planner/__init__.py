"""The planner: from a scene - textures, hand, actuators, controllers, requirements - to how each texture is coded."""
