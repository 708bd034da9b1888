"""Aligns a recording with the sent signal: lag, gain and drift of the recorder's clock, to fractions of a sample."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float64]

# Cubic splines interpolate the recording between this many points per sample.
_OVERSAMPLING = 8
_ITERATIONS = 12
_MIN_CORRELATION = 0.1


class AlignmentError(ValueError):
    """A recording without the sent signal; the message says what to do."""


@dataclass(frozen=True)
class Alignment:
    """How a recording lies over its reference.

    `lag_s`: from the recording's first sample to where the reference begins in it. `gain`: recorded over sent, negative
    for a sensor the other way round. `drift_ppm`: how much faster the recorder's clock runs. `aligned`: the recording
    at the reference's samples, float64 (n,), divided by the gain.
    """

    lag_s: float
    gain: float
    drift_ppm: float
    aligned: Samples


def align(reference: Samples, recorded: Samples, rate_hz: float) -> Alignment:
    """Align a recording (m,) with its reference (n,), both at `rate_hz`, m >= n.

    Begins at the peak of the cross-correlation; from there the least squared difference over lag, drift and gain, by
    Gauss and Newton. Raises AlignmentError where the two have too little in common.
    """
    from scipy import interpolate, signal

    if len(recorded) < len(reference):
        raise AlignmentError("the recording is shorter than the texture; let the sensor's program record {seconds}")
    correlation = signal.correlate(recorded, reference, mode="full", method="fft")
    peak = int(np.argmax(np.abs(correlation)))
    sample = float(peak - (len(reference) - 1))
    first = max(0, round(sample))
    part = recorded[first : first + len(reference)]
    power = float(np.sqrt(np.sum(np.square(reference)) * np.sum(np.square(part))))
    if not power or abs(correlation[peak]) < _MIN_CORRELATION * power:
        raise AlignmentError("the recording does not contain the texture; check the sensor and its sensitivity")
    fine = signal.resample(recorded, _OVERSAMPLING * len(recorded))
    spline = interpolate.CubicSpline(np.arange(len(fine)) / _OVERSAMPLING, fine)
    slope = spline.derivative()
    numbers = np.arange(len(reference), dtype=np.float64)
    centred = numbers - np.mean(numbers)
    stretch = 0.0
    for _ in range(_ITERATIONS):
        at = np.clip(sample + numbers + stretch * centred, 0, len(recorded) - 1)
        values, slopes = spline(at), slope(at)
        # reference = a values + b slopes + c slopes centred, to first order around this lag and stretch.
        terms = np.column_stack((values, slopes, slopes * centred))
        (factor, shift, stretched), *_ = np.linalg.lstsq(terms, reference, rcond=None)
        sample += shift / factor
        stretch += stretched / factor
    values = spline(np.clip(sample + numbers + stretch * centred, 0, len(recorded) - 1))
    # Over the power of the sent signal, which has no noise.
    gain = float(np.sum(values * reference) / np.sum(np.square(reference)))
    return Alignment(
        lag_s=(sample - stretch * float(np.mean(numbers))) / rate_hz,
        gain=gain,
        drift_ppm=1e6 * stretch,
        aligned=values / gain,
    )
