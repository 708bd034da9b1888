"""Emulated boards that run the firmware, one file each, and the firmware as a process of this machine."""
