"""Tests of the room `textures`."""
