"""Aligns a recording with the sent signal: lag, gain and drift of the recorder's clock, to fractions of a sample."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vibrocast.errors import VibrocastError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Samples = NDArray[np.float64]

# Cubic splines interpolate the recording between this many points per sample.
_OVERSAMPLING = 8
_ITERATIONS = 12
_HALVINGS = 5
_MIN_CORRELATION = 0.1
MAX_DRIFT_PPM = 500.0
"""Five times what the crystal of a cheap recorder is off; a larger drift is a wrong sample rate, or a wrong fit."""


class AlignmentError(VibrocastError):
    """A recording that cannot be aligned with the sent signal; the message says what to do."""


@dataclass(frozen=True)
class Alignment:
    """How a recording lies over its reference.

    `lag_s`: from the recording's first sample to where the reference begins in it. `gain`: recorded over sent, negative
    for a sensor the other way round. `drift_ppm`: how much faster the recorder's clock runs.
    """

    lag_s: float
    gain: float
    drift_ppm: float

    def aligned(self, recorded: Samples, samples: int, rate_hz: float) -> Samples:
        """Return a recording (m,) at the first samples of the reference, divided by the gain: float64 (samples,)."""
        numbers = np.arange(samples, dtype=np.float64)
        at = self.lag_s * rate_hz + numbers * (1 + self.drift_ppm / 1e6)
        return np.asarray(_spline(recorded)(np.clip(at, 0, len(recorded) - 1)) / self.gain)


def align(reference: Samples, recorded: Samples, rate_hz: float, drifts: bool = False) -> Alignment:
    """Align a recording (m,) with its reference (n,), both at `rate_hz`; all of the reference lies in the recording.

    Begins at the peak of the cross-correlation; from there the least squared difference over lag and gain, by Gauss and
    Newton. `drifts`: the recorder has a clock of its own, whose drift is fitted too. Steps that raise the difference,
    or leave the peak for its neighbours, are shortened or left out.

    Raises AlignmentError where the two have too little in common, and for a drift of more than MAX_DRIFT_PPM.
    """
    from scipy import signal

    if len(recorded) < len(reference):
        raise AlignmentError("the recording is shorter than the texture; let the sensor's program record {seconds}")
    correlation = signal.correlate(recorded, reference, mode="valid", method="fft")
    peak = int(np.argmax(np.abs(correlation)))
    part = recorded[peak : peak + len(reference)]
    power = float(np.sqrt(np.sum(np.square(reference)) * np.sum(np.square(part))))
    if not power or abs(correlation[peak]) < _MIN_CORRELATION * power:
        raise AlignmentError("the recording does not contain the texture; check the sensor and its sensitivity")
    low, high = _lobe(correlation, peak)
    spline = _spline(recorded)
    slope = spline.derivative()
    numbers = np.arange(len(reference), dtype=np.float64)
    middle = float(np.mean(numbers))

    def values_at(lag: float, stretch: float) -> tuple[Samples, Samples]:
        at = np.clip(lag + numbers + stretch * (numbers - middle), 0, len(recorded) - 1)
        return at, spline(at)

    def difference(values: Samples) -> float:
        factor = np.dot(values, reference) / np.dot(values, values)
        return float(np.sum(np.square(reference - factor * values)))

    lag, stretch = float(peak), 0.0
    at, values = values_at(lag, stretch)
    least = difference(values)
    for _ in range(_ITERATIONS):
        # reference = a values + b slopes + c slopes (numbers - middle), to first order around this lag and stretch.
        slopes = slope(at)
        terms = np.column_stack((values, slopes, slopes * (numbers - middle))[: 3 if drifts else 2])
        factor, *moved = np.linalg.lstsq(terms, reference, rcond=None)[0]
        shift, stretched = (*(np.array(moved) / factor), 0.0)[:2]
        for halving in range(_HALVINGS):
            trial = lag + shift / 2**halving, stretch + stretched / 2**halving
            if low <= trial[0] <= high:
                at, values = values_at(*trial)
                if (now := difference(values)) < least:
                    (lag, stretch), least = trial, now
                    break
        else:
            break
    if abs(1e6 * stretch) > MAX_DRIFT_PPM:
        raise AlignmentError(
            f"the recorder's clock seems to be off by {1e6 * stretch:+.0f} ppm, and none is by more than "
            f"{MAX_DRIFT_PPM:g}; correct the sample rate of the recording"
        )
    _, values = values_at(lag, stretch)
    # Over the power of the sent signal, which has no noise.
    gain = float(np.dot(values, reference) / np.sum(np.square(reference)))
    return Alignment((lag - stretch * middle) / rate_hz, gain, 1e6 * stretch)


def _lobe(correlation: Samples, peak: int) -> tuple[int, int]:
    """Return the lags below and above a peak between which the correlation keeps the peak's sign."""
    other = np.flatnonzero(np.sign(correlation) != np.sign(correlation[peak]))
    behind = int(np.searchsorted(other, peak))
    low = int(other[behind - 1]) if behind > 0 else -1
    return low, int(other[behind]) if behind < len(other) else len(correlation)


def _spline(recorded: Samples) -> "CubicSpline":
    """Return a function of time in samples that interpolates a recording (m,)."""
    from scipy import interpolate, signal

    fine = signal.resample(recorded, _OVERSAMPLING * len(recorded))
    return interpolate.CubicSpline(np.arange(len(fine)) / _OVERSAMPLING, fine)
