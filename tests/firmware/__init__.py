"""Tests of the firmware's C sources."""
