"""Tests of the package `simulated_device`."""
