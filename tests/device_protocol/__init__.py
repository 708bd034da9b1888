"""Tests of the room `device_protocol`."""
