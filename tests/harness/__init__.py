"""Tests of the hardware-in-the-loop harness."""
