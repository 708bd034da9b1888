"""Tests of the package `codec`."""
