"""Trains what controllers are flashed with: tables and models, and packs them as model images."""
