"""Samples to skin: actuator models, compensation, DAC codes; firmware/core/drive.c and dac.c compute them."""
