"""BD-rate: the mean difference in rate of two codecs at equal quality, in a fixed window or over all of it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import TypeAlias

import bjontegaard
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from vibrocast.evaluation.points import Point

MIN_POINTS = 4
"""Of each curve: as many as the field's reports of four rates have."""
ENOUGH_POINTS = 6
"""With fewer, a result is marked: one point decides much of the curve."""
MIN_OVERLAP = 0.2
"""Least part of a window that two curves must share."""
WINDOW_METHODS = ("pchip", "akima")  # the first is reported, the second checks it
OVERLAP_METHOD = "cubic"
"""The EVA paper's: one cubic polynomial of log10 rate for each curve, over all quality that both curves have."""
RESAMPLES = 2000
CONFIDENCE = 0.95

Curve: TypeAlias = Sequence[tuple[float, float]]
"""Bits per sample and quality of each point of one codec on one trace."""


@dataclass(frozen=True)
class Scale:
    """A quality that codecs are compared at: its field in Point, its name for people, and the window of BD-rate."""

    field: str
    label: str
    low: float
    high: float

    @property
    def name(self) -> str:
        """The name without a unit."""
        return self.label.split(",")[0]

    def curve(self, points: Iterable[Point]) -> list[tuple[float, float]]:
        """Return the rate and quality of the points that have this quality."""
        pairs = ((point.bits_per_sample, getattr(point, self.field)) for point in points)
        return [(bits, quality) for bits, quality in pairs if quality is not None]


# SNR from 5 to 20 dB: below, a decoded texture shares little with its original; above, the peers shape noise no more.
# The other windows span the qualities that go with that SNR on recorded textures, as far as each measure separates
# codecs. PSNR exceeds SNR by the crest factor of the recording, 10 to 18 dB and 13 in the middle. ST-SIM is about
# (1 - 10^(-SNR/10))^(1/3): 0.8 at 3 dB, 0.98 at 12.5 dB. All better qualities lie in the 0.02 above, where a step of
# 0.001 is worth more than the differences of codecs. SPQI: 0.1 is near 5 dB, 0.9 near 18 dB.
SCALES = (
    Scale("snr_db", "SNR, dB", 5, 20),
    Scale("psnr_db", "PSNR, dB", 18, 33),
    Scale("st_sim_2800", "ST-SIM (2800 Hz)", 0.8, 0.98),
    Scale("st_sim_8000", "ST-SIM (8000 Hz)", 0.8, 0.98),
    Scale("spqi", "SPQI", 0.1, 0.9),
)
SNR, PSNR, ST_SIM_2800, ST_SIM_8000, SPQI = SCALES


@dataclass(frozen=True)
class BdRate:
    """The rate of a codec relative to another's at equal quality: -50 is half the bits.

    `percent` by pchip and `akima_percent` as a check, over the quality from `low` to `high`: the part of the window
    where both codecs have points. `cubic_percent`: by OVERLAP_METHOD. `points`: of the envelope that has the fewer.
    """

    percent: float
    akima_percent: float
    cubic_percent: float
    low: float
    high: float
    points: int


@dataclass(frozen=True)
class Summary:
    """BD-rates over several traces, in percent.

    `interval_low`, `interval_high`: the 95 % interval of the mean by bootstrap over the traces, None for fewer than
    three. `low`, `high`: all qualities compared; `whole_window_traces` of the traces cover the window whole. `points`:
    of the envelope that has the fewest.
    """

    mean: float
    interval_low: float | None
    interval_high: float | None
    median: float
    lowest: float
    highest: float
    akima_mean: float
    cubic_mean: float
    traces: int
    low: float
    high: float
    whole_window_traces: int
    points: int


def monotone_envelope(curve: Curve) -> list[tuple[float, float]]:
    """Return, by rising rate, the points that no other equals or exceeds in quality at the same rate or below.

    Points without a finite quality are left out.
    """
    envelope: list[tuple[float, float]] = []
    # By the logarithm, which is interpolated: of rates that it makes equal, one point is kept.
    for bits, quality in sorted(curve, key=lambda point: (np.log2(point[0]), -point[1])):
        if math.isfinite(quality) and (not envelope or quality > envelope[-1][1]):
            envelope.append((bits, quality))
    return envelope


def bd_rate(anchor: Curve, test: Curve, scale: Scale) -> BdRate | None:
    """Return the BD-rate of `test` relative to `anchor`, two curves of one trace.

    10^(mean over quality of log10 rate_test - log10 rate_anchor) - 1, the mean being the integral over the qualities
    that both have, divided by their range: equations (4) to (6) of the EVA paper, after G. Bjontegaard, VCEG-M33
    (2001). Interpolated as in C. Herglotz et al., "The Bjontegaard Bible" (2024), on the monotone envelopes; by
    OVERLAP_METHOD as in VCEG-M33 and the EVA paper. None where either envelope has fewer than MIN_POINTS, or they share
    less than MIN_OVERLAP of the scale's window.
    """
    curves = monotone_envelope(anchor), monotone_envelope(test)
    points = min(map(len, curves))
    if points < MIN_POINTS:
        return None
    overlap = max(curve[0][1] for curve in curves), min(curve[-1][1] for curve in curves)
    low, high = max(scale.low, overlap[0]), min(scale.high, overlap[1])
    if high - low < MIN_OVERLAP * (scale.high - scale.low):
        return None
    percent, akima_percent = (_percent(*curves, low, high, method) for method in WINDOW_METHODS)
    return BdRate(percent, akima_percent, _percent(*curves, *overlap, OVERLAP_METHOD), low, high, points)


def bits_per_sample_at(curve: Curve, qualities: ArrayLike) -> NDArray[np.float64]:
    """Return bits per sample at each quality, by pchip of the log rate on the envelope; NaN outside of it."""
    bits, quality = _columns(monotone_envelope(curve))
    return np.asarray(np.exp2(_interpolated(quality, np.log2(bits), np.asarray(qualities, np.float64))))


def fewest_bits(curve: Curve, quality: float) -> float:
    """Return the bits per sample at which a curve reaches a quality, or of its cheapest better point; else infinity."""
    bits = float(bits_per_sample_at(curve, quality))
    return bits if math.isfinite(bits) else min((bits for bits, value in curve if value >= quality), default=math.inf)


def quality_at(curve: Curve, bits_per_sample: ArrayLike) -> NDArray[np.float64]:
    """Return the quality at each rate, by pchip over the log rate on the envelope; NaN outside of it."""
    bits, quality = _columns(monotone_envelope(curve))
    return _interpolated(np.log2(bits), quality, np.log2(np.asarray(bits_per_sample, np.float64)))


def bd_rates(anchor: Mapping[str, Curve], test: Mapping[str, Curve], scale: Scale) -> dict[str, BdRate]:
    """Return the BD-rate of every trace where `test` and `anchor`, curves by trace, can be compared."""
    compared = {trace: bd_rate(anchor[trace], test[trace], scale) for trace in test if trace in anchor}
    return {trace: rate for trace, rate in compared.items() if rate is not None}


def summary(rates: Sequence[BdRate], scale: Scale) -> Summary:
    """Return mean, median and spread of at least one BD-rate."""
    percents = [rate.percent for rate in rates]
    interval_low, interval_high = _interval_of_mean(percents) if len(rates) > 2 else (None, None)
    return Summary(
        fmean(percents),
        interval_low,
        interval_high,
        median(percents),
        min(percents),
        max(percents),
        fmean(rate.akima_percent for rate in rates),
        fmean(rate.cubic_percent for rate in rates),
        len(rates),
        min(rate.low for rate in rates),
        max(rate.high for rate in rates),
        sum((rate.low, rate.high) == (scale.low, scale.high) for rate in rates),
        min(rate.points for rate in rates),
    )


def _interval_of_mean(values: Sequence[float]) -> tuple[float, float]:
    """Percentile bootstrap of B. Efron, "Bootstrap methods: another look at the jackknife" (1979)."""
    means = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _percent(anchor: Curve, test: Curve, low: float, high: float, method: str) -> float:
    """Return the BD-rate from one quality to another, in percent; `method`: of bjontegaard, between points or a fit.

    Infinite where a fit leaves the range of floating point.
    """
    with np.errstate(over="ignore"):
        # The library integrates over the whole overlap; its interpolators serve for the window within.
        _, anchor_curve, test_curve = bjontegaard.bd_rate(
            *_columns(anchor), *_columns(test), method, require_matching_points=False, interpolators=True, min_overlap=0
        )
        difference = test_curve.integrate(low, high) - anchor_curve.integrate(low, high)
        return float(100 * (np.power(10.0, difference / (high - low)) - 1))


def _columns(curve: Curve) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    table = np.array(curve, np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _interpolated(x: NDArray[np.float64], y: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(x) < 2:
        return np.full(at.shape, np.nan)
    return np.asarray(PchipInterpolator(x, y, extrapolate=False)(at))
