"""Tests of the package `textures`."""
