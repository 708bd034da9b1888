"""BD-rate: the mean difference in rate of two codecs at equal SNR, within a fixed window."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import bjontegaard
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from evaluation.points import Point

WINDOW_DB = (5.0, 20.0)
MIN_POINTS = 6
MIN_OVERLAP_DB = 3.0
METHODS = ("pchip", "akima")  # the first is reported, the second checks it


@dataclass(frozen=True)
class BdRate:
    """The rate of a codec relative to another's at equal SNR: -50 is half the bits.

    `percent` by pchip and `akima_percent` as a check, over the SNR from `low_db` to `high_db`: the part of WINDOW_DB
    where both codecs have points.
    """

    percent: float
    akima_percent: float
    low_db: float
    high_db: float


@dataclass(frozen=True)
class Summary:
    """BD-rates over several traces, in percent."""

    mean: float
    median: float
    lowest: float
    highest: float
    akima_mean: float
    traces: int


def monotone_envelope(points: Sequence[Point]) -> list[Point]:
    """Return, by rising rate, the points that no other equals or exceeds in SNR at the same rate or below.

    Points without a finite SNR are left out.
    """
    envelope: list[Point] = []
    finite = [point for point in points if point.snr_db is not None and math.isfinite(point.snr_db)]
    for point in sorted(finite, key=lambda point: (point.bits_per_sample, -point.snr_db)):
        if not envelope or point.snr_db > envelope[-1].snr_db:
            envelope.append(point)
    return envelope


def bd_rate(anchor: Sequence[Point], test: Sequence[Point]) -> BdRate | None:
    """Return the BD-rate of `test` relative to `anchor`, two curves of one trace.

    10^(mean over SNR of log10 rate_test - log10 rate_anchor) - 1: G. Bjontegaard, VCEG-M33 (2001), with the
    interpolation of C. Herglotz et al., "The Bjontegaard Bible" (2024), on the monotone envelopes. None where either
    envelope has fewer than MIN_POINTS, or they share less than MIN_OVERLAP_DB of WINDOW_DB.
    """
    curves = monotone_envelope(anchor), monotone_envelope(test)
    if min(map(len, curves)) < MIN_POINTS:
        return None
    low_db = max(WINDOW_DB[0], *(curve[0].snr_db for curve in curves))
    high_db = min(WINDOW_DB[1], *(curve[-1].snr_db for curve in curves))
    if high_db - low_db < MIN_OVERLAP_DB:
        return None
    percent, akima_percent = (_percent(*curves, low_db, high_db, method) for method in METHODS)
    return BdRate(percent, akima_percent, low_db, high_db)


def bits_per_sample_at(points: Sequence[Point], snr_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bits per sample at each SNR, by pchip of the log rate; NaN outside the curve or below MIN_POINTS."""
    envelope = monotone_envelope(points)
    if len(envelope) < MIN_POINTS:
        return np.full(len(snr_db), np.nan)
    log_rate = PchipInterpolator(*_snr_and_log_rate(envelope), extrapolate=False)
    return np.asarray(10 ** log_rate(snr_db))


def bd_rates(anchor: Mapping[str, Sequence[Point]], test: Mapping[str, Sequence[Point]]) -> dict[str, BdRate]:
    """Return the BD-rate of every trace where `test` and `anchor`, curves by trace, can be compared."""
    compared = {trace: bd_rate(anchor[trace], test[trace]) for trace in test if trace in anchor}
    return {trace: rate for trace, rate in compared.items() if rate is not None}


def summary(rates: Sequence[BdRate]) -> Summary:
    """Return mean, median and spread of at least one BD-rate."""
    percents = [rate.percent for rate in rates]
    akima_mean = fmean(rate.akima_percent for rate in rates)
    return Summary(fmean(percents), median(percents), min(percents), max(percents), akima_mean, len(percents))


def _percent(anchor: list[Point], test: list[Point], low_db: float, high_db: float, method: str) -> float:
    (anchor_snr_db, anchor_log_rate), (test_snr_db, test_log_rate) = map(_snr_and_log_rate, (anchor, test))
    # The library integrates over the whole overlap; its interpolators serve for the window within.
    _, anchor_curve, test_curve = bjontegaard.bd_rate(
        10**anchor_log_rate,
        anchor_snr_db,
        10**test_log_rate,
        test_snr_db,
        method,
        require_matching_points=False,
        interpolators=True,
        min_overlap=0,
    )
    difference = float(test_curve.integrate(low_db, high_db) - anchor_curve.integrate(low_db, high_db))
    return 100 * (10 ** (difference / (high_db - low_db)) - 1)


def _snr_and_log_rate(envelope: Sequence[Point]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    snr_db = np.array([point.snr_db for point in envelope])
    return snr_db, np.log10([point.bits_per_sample for point in envelope])
