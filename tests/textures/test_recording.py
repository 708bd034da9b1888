"""Tests of the values that a recording may hold."""

import numpy as np
import pytest

from vibrocast.textures import Recording, TextureError


def test_each_channel_has_its_axis() -> None:
    assert Recording(np.zeros((9, 1)), 2800, "um", "one").axes == ()
    with pytest.raises(TextureError, match="2 axes for 3 channels"):
        Recording(np.zeros((9, 3)), 2800, "um", "three", ("X", "Y"))


@pytest.mark.parametrize(
    ("samples", "rate_hz", "unit", "message"),
    [
        (np.zeros((0, 1)), 2800.0, "um", "no samples"),
        (np.zeros(5), 2800.0, "um", "float64"),
        (np.zeros((5, 17)), 2800.0, "um", "17 channels"),
        (np.zeros((5, 1)), float("nan"), "um", "sample rate"),
        (np.zeros((5, 1)), 0.009, "um", "sample rate 0.009 Hz; it must be 0.01 to 1e[+]07 Hz"),
        (np.zeros((5, 1)), 2.0**31, "um", "sample rate 2.14748e[+]09 Hz"),
        (np.zeros((5, 1)), 2800.0, "volt", "unit"),
        (np.array([[0.0, 1.0], [0.0, np.nan]]), 2800.0, "um", "sample 1 of channel 1 is nan"),
        (np.array([[np.inf]]), 2800.0, "um", "is inf"),
        (np.array([[0.0], [-2e30]]), 2800.0, "um", "sample 1 of channel 0 is -2e[+]30; .* at most 1e[+]30"),
    ],
)
def test_rejected(samples: np.ndarray, rate_hz: float, unit: str, message: str) -> None:
    with pytest.raises(TextureError, match=message):
        Recording(samples, rate_hz, unit, "test")
