"""Tests of the package `host`."""
