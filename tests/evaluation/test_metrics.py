"""Tests of the quality metrics against values known beforehand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from evaluation.metrics import snr_db


def three_sines() -> NDArray[np.float64]:
    n = np.arange(2100)
    parts = [
        amplitude * np.sin(2 * np.pi * frequency_hz * n / 2800 + phase)
        for amplitude, frequency_hz, phase in ((0.5, 60, 0), (0.2, 250, 0.3), (0.05, 700, 0))
    ]
    signal: NDArray[np.float64] = sum(parts[1:], parts[0])
    return signal.reshape(-1, 1)


def test_snr_of_a_rounded_signal_is_the_published_value() -> None:
    signal = three_sines()
    assert snr_db(signal, np.round(16 * signal) / 16) == pytest.approx(26.3637133687, abs=1e-9)


def test_half_the_amplitude_is_six_decibels() -> None:
    assert snr_db(three_sines(), three_sines() / 2) == pytest.approx(6.0206, abs=1e-4)


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_scale_does_not_matter(scale: float) -> None:
    signal = three_sines()
    assert snr_db(signal * scale, signal * scale * 0.9) == pytest.approx(20.0)


def test_special_cases() -> None:
    signal, silence = three_sines(), np.zeros((2100, 1))
    assert snr_db(signal, signal) == math.inf
    assert snr_db(silence, signal) == -math.inf
    assert math.isnan(snr_db(silence, silence))


def test_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        snr_db(np.zeros((3, 1)), np.zeros((3, 2)))
