"""The planner: from a scene - textures, hand, actuators, controllers, targets - to how each texture is best coded."""
