"""Tests of the emulated boards."""
