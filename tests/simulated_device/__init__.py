"""Tests of the room `simulated_device`."""
