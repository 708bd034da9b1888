"""Recordings and height profiles in: files, data sets, units, resampling; and a texture generator."""
