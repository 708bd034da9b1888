"""Stability maps: `make_maps` joins the maps that need the host's player with those of evaluation."""

from vibrocast.host.stability.report import MAPS, make_maps

__all__ = ["MAPS", "make_maps"]
