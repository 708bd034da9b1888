"""The codec `dct` against equations (2) to (10) of the texture paper, written here again in NumPy.

Equation (4) is the arithmetic of `tests/studies/test_texture_paper.py`.
"""

import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from studies.texture_paper import RATE_HZ, generated_profiles
from vibrocast import codec
from vibrocast.codec import Setting, Signal, dct
from vibrocast.codec.core import UNIT
from vibrocast.codec.threshold import DETECTION_THRESHOLD

S_UM, B0_DB = 0.05, -4.0
FREQUENCY_HZ = 2.5 * np.arange(1, 161)
"""k v / (2 D) at v = 50 mm/s, D = 10 mm, up to 400 Hz."""


@cache
def heights_um(material: str) -> Signal:
    """The first 10 mm of a generated material: (20 000,)."""
    return generated_profiles()[material].without_form()[:20_000]


@cache
def amplitudes_um(material: str) -> Signal:
    """Their DCT as amplitudes of cosines, without DC, up to 400 Hz: (160,)."""
    phase = np.pi * (2 * np.arange(20_000) + 1) / 40_000
    return np.array([2 / 20_000 * np.cos(k * phase) @ heights_um(material) for k in range(1, 161)])


def by_equations_2_and_3(coefficients_um: Signal, levels: int) -> Signal:
    step = (np.max(coefficients_um) - np.min(coefficients_um)) / (levels - 1)
    return np.rint(coefficients_um / step) * step


def by_equations_5_to_9(coefficients_um: Signal, levels: int) -> Signal:
    quantised = np.zeros_like(coefficients_um)
    for sign in (-1, 1):
        side = sign * coefficients_um > 0
        exponents = np.maximum(np.log10(np.abs(coefficients_um[side]) / S_UM), 0)
        step = np.max(exponents) / (levels / 2 - 1)
        quantised[side] = sign * S_UM * 10 ** (step * np.rint(exponents / step))
    return quantised


def by_the_nearest_logarithmic_level(coefficients_um: Signal, levels: int) -> Signal:
    ends = np.max(coefficients_um), -np.min(coefficients_um)
    above, below = (np.geomspace(S_UM, end, levels // 2) for end in ends)
    every = np.concatenate([above, -below])
    return np.asarray(every[np.argmin(np.abs(coefficients_um[:, None] - every), axis=1)])


def by_equation_10(coefficients_um: Signal, _: int) -> Signal:
    threshold_hz, threshold_db = np.loadtxt(DETECTION_THRESHOLD, delimiter=",", skiprows=4).T
    b_db = np.interp(np.log10(FREQUENCY_HZ), np.log10(threshold_hz), threshold_db)
    cut = np.log10(np.abs(coefficients_um)) < b_db / 20 + B0_DB / 20
    return np.where(cut, 0, coefficients_um)


PAPER_RULES: dict[str, tuple[Setting, Callable[[Signal, int], Signal]]] = {
    "linear": ({"quantiser": "linear"}, by_equations_2_and_3),
    "log": ({"quantiser": "log"}, by_equations_5_to_9),
    "log-nearest": ({"quantiser": "log-nearest"}, by_the_nearest_logarithmic_level),
    "cut": ({"threshold": "on", "b0_db": B0_DB}, by_equation_10),
}


@pytest.mark.parametrize("material", ["wood", "sandpaper", "leather"])
@pytest.mark.parametrize(
    ("rule", "levels"),
    [*itertools.product(("linear", "log", "log-nearest"), (4, 6, 8, 10, 12, 14)), ("cut", dct.MAX_LEVELS)],
)
def test_each_coefficient_takes_the_level_of_the_papers_equations(rule: str, levels: int, material: str) -> None:
    """Decisions, not only levels. The coded ends lie up to 0.3 % beyond the extremes, so that a few change sides."""
    setting, by_equations = PAPER_RULES[rule]
    whole: Setting = {**setting, "levels": levels, "block": "whole", "dc": "drop"}
    stream = codec.encode(heights_um(material)[:, None], RATE_HZ, whole, codec="dct", unit="um")
    decided = dct.WholeDecoder(stream.header.configuration, 1).coefficients(stream.packets[0])[0]
    wanted_um = by_equations(amplitudes_um(material), levels)
    same = np.isclose(decided * stream.header.gains[0] / UNIT, wanted_um, rtol=0.005, atol=1e-3)
    assert np.mean(same) >= 0.98
