"""Tests of listening studies."""
