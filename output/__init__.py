"""Samples to skin: actuator models, compensation, limits, DAC codes."""
