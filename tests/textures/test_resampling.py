"""Tests of the resampler's stated band, length and limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.textures import Recording, TextureError, resample


def level_db(frequency_hz: float, old_hz: float, new_hz: float) -> float:
    """Return the level of a resampled sine relative to the sine, away from its ends."""
    sine = np.sin(2 * np.pi * frequency_hz * np.arange(int(2 * old_hz)) / old_hz).reshape(-1, 1)
    resampled = resample(Recording(sine, old_hz, "um", "sine"), new_hz).samples
    middle = resampled[len(resampled) // 4 : -len(resampled) // 4]
    return float(10 * np.log10(2 * np.mean(middle**2) + 1e-30))


@pytest.mark.parametrize(
    ("old_hz", "new_hz"), [(10000, 2800), (8000, 2800), (2800, 8000), (33333.3, 2800), (2200, 2800)]
)
@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.9, 0.91])
def test_pass_band_is_flat(old_hz: float, new_hz: float, fraction: float) -> None:
    assert abs(level_db(fraction * min(old_hz, new_hz) / 2, old_hz, new_hz)) < 0.02


@pytest.mark.parametrize("old_hz", [10000, 48000, 200000])
@pytest.mark.parametrize("fraction", [1.0, 1.2, 2.5])
def test_stop_band_is_empty(old_hz: float, fraction: float) -> None:
    assert level_db(fraction * 1400, old_hz, 2800) < -120


def test_no_delay() -> None:
    pulse = np.zeros((10000, 1))
    pulse[5000] = 1
    assert np.argmax(resample(Recording(pulse, 10000, "um", "pulse"), 2800).samples) == 1400


@given(
    count=st.integers(1, 3000),
    channels=st.integers(1, 3),
    old_hz=st.floats(1, 1e5),
    new_hz=st.floats(100, 20000),
)
def test_length_and_axes(count: int, channels: int, old_hz: float, new_hz: float) -> None:
    expected = round(count * new_hz / old_hz)
    if expected > 1_000_000:
        new_hz, expected = old_hz, count
    axes = ("X", "Y", "Z")[:channels]
    recording = Recording(np.ones((count, channels)), old_hz, "m/s^2", "ones", axes)
    if expected == 0:
        with pytest.raises(TextureError, match="less than one sample"):
            resample(recording, new_hz)
        return
    resampled = resample(recording, new_hz)
    assert resampled.samples.shape == (expected, channels)
    assert (resampled.rate_hz, resampled.unit, resampled.name, resampled.axes) == (new_hz, "m/s^2", "ones", axes)


@pytest.mark.parametrize("rate_hz", [0, -1, float("nan"), float("inf"), 1e15, 1e-5])
def test_rejected_rates(rate_hz: float) -> None:
    with pytest.raises(TextureError, match="rate"):
        resample(Recording(np.ones((7, 1)), 2800, "um", "ones"), rate_hz)


@pytest.mark.parametrize(
    ("count", "old_hz", "new_hz", "message"),
    [
        (10, 1e7, 50, "too far from 50 Hz"),
        (10, 0.01, 2800, "too far from 2800 Hz"),
        (3, 1e6, 2800, "3 samples at 1e[+]06 Hz last less than one sample at 2800 Hz"),
    ],
)
def test_rejected_pairs_of_rates(count: int, old_hz: float, new_hz: float, message: str) -> None:
    with pytest.raises(TextureError, match=message):
        resample(Recording(np.ones((count, 1)), old_hz, "um", "ones"), new_hz)


def test_a_slow_recording_that_would_fill_the_memory_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibrocast.memory.available_bytes", lambda: 100_000_000)
    recording = Recording(np.ones((1000, 1)), 1, "um", "slow")
    with pytest.raises(TextureError, match=r"slow: 1000 s at 2800 Hz needs .* of memory, .* choose a lower rate"):
        resample(recording, 2800)
    assert len(resample(recording, 1000).samples) == 1_000_000
