"""Samples to skin: actuator models, compensation, DAC codes; vc_drive.c and vc_dac.c of the core compute them."""
