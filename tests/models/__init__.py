"""Tests of the models that ship and of folders of models."""
