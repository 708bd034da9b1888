"""The planner: from a scene - textures, hand, actuators, controllers, wishes - to how each texture is best coded."""
