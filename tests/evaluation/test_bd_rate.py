"""Tests of BD-rate against its definition, on curves whose difference is known."""

import math
import random
from collections.abc import Callable, Sequence
from itertools import pairwise

import bjontegaard
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from vibrocast.evaluation.bd_rate import (
    SCALES,
    SNR,
    ST_SIM_2800,
    BdRate,
    Scale,
    bd_rate,
    bd_rates,
    bits_per_sample_at,
    monotone_envelope,
    quality_at,
    summary,
)
from vibrocast.evaluation.points import Point

COARSE = [2.0, 5.0, 8.0, 11.0, 14.0, 17.0, 20.0, 23.0]
FINE = [1.0 + 0.5 * index for index in range(50)]


def curve(qualities: Sequence[float], rate_factor: float = 1.0, db_per_bit: float = 6.0) -> list[tuple[float, float]]:
    """Return points of bits per sample = rate_factor * (1 + quality / db_per_bit)."""
    return [(rate_factor * (1 + quality / db_per_bit), quality) for quality in qualities]


@pytest.mark.parametrize("scale", SCALES, ids=lambda scale: scale.field)
@given(factor=st.floats(0.05, 20))
def test_a_constant_factor_of_rate_is_found_in_the_window_of_every_quality(scale: Scale, factor: float) -> None:
    qualities = np.linspace(scale.low - 0.05, scale.high + 0.01, 12)
    anchor = [(2**step, quality) for step, quality in enumerate(qualities)]
    result = bd_rate(anchor, [(factor * bits, quality) for bits, quality in anchor], scale)
    assert result is not None
    for percent in (result.percent, result.akima_percent, result.cubic_percent):
        assert percent == pytest.approx(100 * (factor - 1))
    assert (result.low, result.high) == (scale.low, scale.high)


def test_only_the_window_counts_four_points_are_enough_and_the_comparison_ends_where_a_curve_ends() -> None:
    anchor = curve(FINE)
    in_window = [(bits / (10 if snr_db < 4 else 2 if snr_db <= 21 else 1), snr_db) for bits, snr_db in anchor]
    short = curve([-1.0, 2.0, 5.0, 8.0, 11.0, 14.0])
    for one, other, ends, points in (
        (anchor, in_window, (5, 20), 50),
        (curve(COARSE), curve([4.0, 9.0, 15.0, 21.0], 0.5), (5, 20), 4),
        (short, curve([7.5, *FINE[20:]], 0.5), (7.5, 14), 6),
    ):
        result = bd_rate(one, other, SNR)
        assert result is not None and result.percent == pytest.approx(-50, abs=0.5)
        assert ((result.low, result.high), result.points) == (ends, points)


def definition(anchor: Callable[[float], float], test: Callable[[float], float], low: float, high: float) -> float:
    """BD-rate in percent of two curves, bits per sample over quality, by equations (4) to (6) of the EVA paper."""
    integral, _ = quad(lambda quality: math.log10(test(quality)) - math.log10(anchor(quality)), low, high)
    return 100 * (10 ** (integral / (high - low)) - 1)


def test_a_saturating_quality_and_a_curved_line_have_the_integral_of_the_definition() -> None:
    def bits(quality: float) -> float:
        return -math.log2(1 - quality)

    def bits_of_test(quality: float) -> float:
        return 0.8 * math.pow(bits(quality), 1.1)

    qualities = 1 - np.geomspace(0.5, 0.001, 60)
    result = bd_rate(
        [(bits(quality), quality) for quality in qualities],
        [(bits_of_test(quality), quality) for quality in qualities],
        ST_SIM_2800,
    )
    assert result is not None
    assert result.percent == pytest.approx(definition(bits, bits_of_test, 0.8, 0.98), abs=0.01)
    curved = bd_rate(curve(FINE, db_per_bit=6), curve(FINE, db_per_bit=4), SNR)
    expected = definition(lambda snr_db: 1 + snr_db / 6, lambda snr_db: 1 + snr_db / 4, 5, 20)
    assert curved is not None and curved.percent == pytest.approx(expected, abs=0.01)


def test_the_library_agrees_where_the_curves_end_at_the_window() -> None:
    snrs_db = [5.0, 8.0, 11.0, 14.0, 17.0, 20.0]
    anchor, test = curve(snrs_db), curve(snrs_db, 0.7, db_per_bit=5)
    rates = [[bits for bits, _ in points] for points in (anchor, test)]
    result = bd_rate(anchor, test, SNR)
    assert result is not None
    assert result.percent == pytest.approx(bjontegaard.bd_rate(rates[0], snrs_db, rates[1], snrs_db, "pchip"))
    assert result.akima_percent == pytest.approx(bjontegaard.bd_rate(rates[0], snrs_db, rates[1], snrs_db, "akima"))


def test_the_papers_method_is_one_cubic_over_the_whole_overlap() -> None:
    """Log rates that are cubic polynomials are fitted exactly, so the definition's integral is the expected figure."""

    def bits(snr_db: float) -> float:
        return 10 ** (-0.5 + 0.05 * snr_db + 1e-5 * (snr_db - 12) ** 3)

    def bits_of_test(snr_db: float) -> float:
        return 10 ** (-0.6 + 0.06 * snr_db - 2e-5 * (snr_db - 9) ** 3)

    anchor, test = ([(rate(snr_db), snr_db) for snr_db in FINE] for rate in (bits, bits_of_test))
    result = bd_rate(anchor[:-6], test[4:], SNR)
    assert result is not None
    low, high = FINE[4], FINE[-7]
    assert (low, high) == (3.0, 22.5)  # beyond the window on both sides
    assert result.cubic_percent == pytest.approx(definition(bits, bits_of_test, low, high))
    assert result.cubic_percent != pytest.approx(result.percent, abs=0.1)
    steep = bd_rate(curve(COARSE), [(1.0, 0.0), (1e9, 1e-6), (2e9, 24.9), (3e9, 25.0)], SNR)
    assert steep is not None and steep.cubic_percent == math.inf


@pytest.mark.parametrize(
    "snrs_db",
    [
        [],
        [5.0, 12.0, 20.0],
        [21.0 + index for index in range(8)],
        [-5.0 + index for index in range(13)],
        [math.nan] * 8,
        [math.inf] * 8,
        [12.0] * 8,
    ],
    ids=["nothing", "too few points", "above the window", "too little overlap", "NaN", "lossless", "one quality"],
)
def test_curves_that_cannot_be_compared(snrs_db: list[float]) -> None:
    points = [(1 + 0.1 * index, snr_db) for index, snr_db in enumerate(snrs_db)]
    assert bd_rate(curve(COARSE), points, SNR) is None
    assert bd_rate(points, curve(COARSE), SNR) is None


def test_order_repetition_and_worse_points_do_not_matter() -> None:
    clean = curve(COARSE, 0.6)
    points = [*clean, *clean, *((bits + 0.01, snr_db - 1) for bits, snr_db in clean)]
    random.Random(0).shuffle(points)
    assert monotone_envelope(points) == clean
    assert bd_rate(curve(COARSE), points, SNR) == bd_rate(curve(COARSE), clean, SNR)
    rounded = [(math.nextafter(8.0, 0), 1.0), (8.0, 2.0), (16.0, 3.0)]
    assert monotone_envelope(rounded) == rounded[1:]
    assert quality_at(rounded, 8.0) == 2
    without = [Point("a", "b", "", 8, 2, 5.0, spqi=None), Point("a", "b", "", 8, 4, None, spqi=0.5)]
    assert SNR.curve(without) == [(2.0, 5.0)]


@given(st.lists(st.tuples(st.integers(1, 50), st.floats(-10, 40) | st.sampled_from([math.nan, math.inf, -math.inf]))))
def test_the_envelope_rises_and_covers_every_point(points: list[tuple[float, float]]) -> None:
    envelope = monotone_envelope(points)
    for lower, upper in pairwise(envelope):
        assert lower[0] < upper[0] and lower[1] < upper[1]
    for bits, quality in points:
        if math.isfinite(quality):
            assert any(best[0] <= bits and best[1] >= quality for best in envelope)


def test_between_points_and_never_outside() -> None:
    np.testing.assert_allclose(
        bits_per_sample_at(curve(COARSE), [1.0, 8.0, 12.0, 24.0]), [np.nan, 1 + 8 / 6, 3, np.nan], rtol=0.01
    )
    np.testing.assert_allclose(quality_at(curve(COARSE), [1.0, 1 + 8 / 6, 3, 9.0]), [np.nan, 8, 12, np.nan], rtol=0.01)
    for too_short in ([], curve([8.0])):
        assert np.isnan(bits_per_sample_at(too_short, [8.0])).all()
        assert np.isnan(quality_at(too_short, [1 + 8 / 6])).all()


def test_recordings_are_compared_one_by_one_and_summed_up() -> None:
    anchor = {name: curve(COARSE) for name in ("a", "b", "c", "only here")}
    test = {name: curve(COARSE, factor) for name, factor in (("a", 0.5), ("b", 0.6), ("c", 0.9), ("only there", 1))}
    rates = bd_rates(anchor, test, SNR)
    assert {name: round(rate.percent) for name, rate in rates.items()} == {"a": -50, "b": -40, "c": -10}
    result = summary(list(rates.values()), SNR)
    assert result.mean == pytest.approx(-100 / 3)
    assert result.median == pytest.approx(-40)
    assert (round(result.lowest), round(result.highest), result.traces) == (-50, -10, 3)
    assert (result.low, result.high, result.whole_window_traces) == (5, 20, 3)
    some = summary(
        [BdRate(-50, -49, -43, 5, 19, 8), BdRate(-40, -41, -41, 6, 20, 5), BdRate(-42, -42, -42, 5, 20, 9)], SNR
    )
    assert (some.akima_mean, some.cubic_mean, some.points) == (-44, -42, 5)
    assert (some.low, some.high, some.whole_window_traces) == (5, 20, 1)


def test_the_interval_of_the_mean_holds_it_and_shrinks_with_the_recordings() -> None:
    values = np.random.default_rng(1).normal(-40, 10, 400)
    few, many = (
        summary([BdRate(value, value, value, 5, 20, 8) for value in values[:count]], SNR) for count in (10, 400)
    )
    for result in (few, many):
        assert result.interval_low is not None and result.interval_high is not None
        assert result.interval_low < result.mean < result.interval_high
    # 1.96 standard errors of the mean each way.
    assert many.interval_high is not None
    assert many.interval_high - many.mean == pytest.approx(1.96 * np.std(values) / 20, rel=0.1)
    assert summary([BdRate(-50, -49, -48, 5, 20, 8), BdRate(-40, -41, -42, 5, 20, 8)], SNR).interval_low is None
