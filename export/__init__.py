"""Trains tables and models for codecs, and packs them as model images for controllers."""
