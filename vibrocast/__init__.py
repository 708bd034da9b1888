"""Compress vibrotactile textures and play them in real time on an actuator."""
