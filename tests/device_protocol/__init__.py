"""Tests of the package `device_protocol`."""
