"""Alignment of a recording with the sent signal: lag, gain and drift, to fractions of a sample."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from vibrocast.host.playback import AlignmentError, align

RATE_HZ = 2800
RNG = np.random.default_rng(1)
FINE = 16


def textured(samples: int) -> CubicSpline:
    """Return band-limited noise, 30 to 400 Hz, as a function of time in samples."""
    spectrum = np.fft.rfft(RNG.standard_normal(samples * FINE))
    frequencies_hz = np.fft.rfftfreq(samples * FINE, 1 / (RATE_HZ * FINE))
    spectrum[(frequencies_hz < 30) | (frequencies_hz > 400)] = 0
    return CubicSpline(np.arange(samples * FINE) / FINE, np.fft.irfft(spectrum, samples * FINE))


SIGNAL = textured(8400)
REFERENCE = SIGNAL(np.arange(1000, 6600))


@settings(deadline=None, max_examples=25)
@given(
    lag=st.floats(0, 990), gain=st.floats(-4, 4).filter(lambda gain: abs(gain) > 0.1), drift_ppm=st.floats(-120, 120)
)
def test_lag_gain_and_drift_are_found(lag: float, gain: float, drift_ppm: float) -> None:
    stretch = 1 + drift_ppm / 1e6
    recorded = gain * SIGNAL(1000 + (np.arange(7200) - lag) / stretch)
    recorded += 0.01 * np.std(recorded) * np.random.default_rng(3).standard_normal(len(recorded))
    found = align(REFERENCE, recorded, RATE_HZ, drifts=True)
    assert found.lag_s * RATE_HZ == pytest.approx(lag, abs=0.02)
    assert found.gain == pytest.approx(gain, rel=1e-3)
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=1.0)
    assert np.std(found.aligned(recorded, len(REFERENCE), RATE_HZ) - REFERENCE) < 0.02 * np.std(REFERENCE)


def test_a_clock_that_no_recorder_has_is_reported() -> None:
    recorded = SIGNAL(1000 + (np.arange(7200) - 300) / (1 + 700e-6))
    with pytest.raises(AlignmentError, match=r"off by \+700 ppm.*correct the sample rate"):
        align(REFERENCE, recorded, RATE_HZ, drifts=True)


def test_the_lag_stays_at_its_peak_where_the_recording_is_another_signal_in_part() -> None:
    """A resonance repeats itself: the neighbouring peaks of the correlation are nearly as high."""
    numbers = np.arange(7200)
    reference = np.sin(2 * np.pi * 90 * numbers[:5600] / RATE_HZ) * np.hanning(5600)
    shaken = np.random.default_rng(5).standard_normal(7200).cumsum() / 20
    recorded = np.pad(reference, (400, 1200)) + shaken - shaken.mean()
    found = align(reference, recorded, RATE_HZ)
    assert found.lag_s * RATE_HZ == pytest.approx(400, abs=1)
    assert found.drift_ppm == 0


@pytest.mark.parametrize(
    ("recorded", "message"),
    [
        (np.zeros(7200), "does not contain the texture"),
        (RNG.standard_normal(7200), "does not contain the texture"),
        (np.zeros(5000), "shorter than the texture"),
    ],
)
def test_a_recording_of_something_else_is_reported(recorded: NDArray[np.float64], message: str) -> None:
    with pytest.raises(AlignmentError, match=message):
        align(REFERENCE, recorded, RATE_HZ)
