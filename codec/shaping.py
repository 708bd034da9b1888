"""Step shapes: by how much the quantiser steps of a codec differ over frequency, to serve touch."""

import math
from collections.abc import Sequence

import numpy as np

from vibrocast.codec.interface import CodecError
from vibrocast.codec.threshold import MIN_HZ, read_threshold, threshold_amplitude

NODES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""The frequencies of a shape, in parts of half the rate. Between them it is linear over frequency."""
MAX_OCTAVES = 2.7
FLAT = "flat"
DEFAULT_TOUCH = 0.25
"""The strength of the shape for signals in a physical unit; docs/explanation/decisions/touch.md says why."""
_MOST_OVER_250_HZ_DB = 10.0
_SPQI_NODE = NODES.index(1 / 16)
_SPQI_DB = 6.0
_OCTAVE_DB = 20 * math.log10(2)


def touch_shape(touch: float, rate_hz: float, unit: str) -> tuple[float, ...]:
    """Return the shape of a strength from 0, flat, to 1: octaves of the step at NODES, at least 0.

    At strength 1, steps are proportional to the detection threshold in the stream's unit, from its value at 250 Hz up
    to 10 dB above. So the error is finer where touch is sensitive. At 1/16 of half the rate they are 6 dB finer: SPQI
    weighs errors most there at any rate, because the axis of its threshold does not follow the rate. Other strengths
    scale the octaves. Raises CodecError for a strength beyond 0 to 1, or a unit that is not physical.
    """
    if not 0 <= touch <= 1:
        raise CodecError(f"a strength of touch of {touch:g} is not possible; give 0, flat, to 1")
    nodes_hz = np.maximum(np.array(NODES) * rate_hz / 2, MIN_HZ)
    at_nodes, at_250_hz = (threshold_amplitude(read_threshold(), each, unit) for each in (nodes_hz, np.array([250.0])))
    level_db = np.clip(20 * np.log10(at_nodes / at_250_hz), 0, _MOST_OVER_250_HZ_DB)
    level_db[_SPQI_NODE] -= _SPQI_DB
    return tuple((touch * (level_db - level_db.min()) / _OCTAVE_DB).tolist())


def shape_text(octaves: Sequence[float]) -> str:
    """Return a shape as the value of a codec's parameter."""
    return "/".join(f"{each:.4g}" for each in octaves)


def parsed_shape(text: str) -> tuple[float, ...] | None:
    """Return the octaves of a parameter's value, None for FLAT. Raises CodecError."""
    if text == FLAT:
        return None
    try:
        octaves = tuple(float(each) for each in text.split("/"))
    except ValueError:
        octaves = ()
    if len(octaves) != len(NODES) or not all(math.isfinite(each) and 0 <= each <= MAX_OCTAVES for each in octaves):
        raise CodecError(
            f"shape is {text!r}; write {FLAT}, or {len(NODES)} octaves from 0 to {MAX_OCTAVES}, divided by slashes"
        )
    return octaves
