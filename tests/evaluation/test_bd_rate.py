"""Tests of BD-rate against curves whose difference is known."""

import math
import random
from dataclasses import replace
from itertools import pairwise

import bjontegaard
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.bd_rate import BdRate, bd_rate, bd_rates, bits_per_sample_at, monotone_envelope, summary
from evaluation.points import Point
from tests.evaluation.curves import SAMPLES, curve

COARSE = [2.0, 5.0, 8.0, 11.0, 14.0, 17.0, 20.0, 23.0]
FINE = [1.0 + 0.5 * index for index in range(50)]


@given(factor=st.floats(0.05, 20), snrs_db=st.sampled_from([COARSE, FINE]))
def test_a_constant_factor_of_rate_is_found(factor: float, snrs_db: list[float]) -> None:
    result = bd_rate(curve(snrs_db), curve(snrs_db, factor))
    assert result is not None
    assert result.percent == pytest.approx(100 * (factor - 1), abs=0.01)
    assert result.akima_percent == pytest.approx(100 * (factor - 1), abs=0.01)
    assert (result.low_db, result.high_db) == (5, 20)


def test_half_the_rate_is_minus_fifty_percent_and_back_again_plus_hundred() -> None:
    there, back = bd_rate(curve(COARSE), curve(COARSE, 0.5)), bd_rate(curve(COARSE, 0.5), curve(COARSE))
    assert there is not None and back is not None
    assert there.percent == pytest.approx(-50, abs=0.01)
    assert back.percent == pytest.approx(100, abs=0.02)


def test_only_the_window_counts() -> None:
    anchor = curve(FINE)
    divisors = [10 if point.snr_db < 4 else 2 if point.snr_db <= 21 else 1 for point in anchor]
    test = [
        replace(point, bytes_total=point.bytes_total // divisor)
        for point, divisor in zip(anchor, divisors, strict=True)
    ]
    result = bd_rate(anchor, test)
    assert result is not None
    assert result.percent == pytest.approx(-50, abs=0.5)


def test_curves_of_unequal_steepness_have_the_mean_of_the_log_ratio() -> None:
    result = bd_rate(curve(FINE, db_per_bit=6), curve(FINE, db_per_bit=4))
    snr_db = np.linspace(5, 20, 10001)
    expected = 100 * (math.exp(np.mean(np.log((1 + snr_db / 4) / (1 + snr_db / 6)))) - 1)
    assert result is not None
    assert result.percent == pytest.approx(expected, abs=0.01)


def test_the_library_agrees_where_the_curves_end_at_the_window() -> None:
    snrs_db = [5.0, 8.0, 11.0, 14.0, 17.0, 20.0]
    anchor, test = curve(snrs_db), curve(snrs_db, 0.7, db_per_bit=5)
    rates = [[point.bits_per_sample for point in points] for points in (anchor, test)]
    expected = bjontegaard.bd_rate(rates[0], snrs_db, rates[1], snrs_db, "pchip")
    result = bd_rate(anchor, test)
    assert result is not None
    assert result.percent == pytest.approx(expected)


def test_comparison_ends_where_a_curve_ends() -> None:
    result = bd_rate(curve([-1.0, 2.0, 5.0, 8.0, 11.0, 14.0]), curve([7.5, *FINE[20:]], 0.5))
    assert result is not None
    assert (result.low_db, result.high_db) == (7.5, 14)
    assert result.percent == pytest.approx(-50, abs=0.5)


@pytest.mark.parametrize(
    "snrs_db",
    [
        [],
        [5.0, 10.0, 15.0, 18.0, 20.0],
        [21.0 + index for index in range(8)],
        [-5.0 + index for index in range(13)],
        [math.nan] * 8,
        [math.inf] * 8,
    ],
    ids=["nothing", "too few points", "above the window", "too little overlap", "NaN", "lossless"],
)
def test_curves_that_cannot_be_compared(snrs_db: list[float]) -> None:
    anchor = curve(COARSE)
    points = [Point("trace", "peer", "", SAMPLES, 1000 + index, snr_db) for index, snr_db in enumerate(snrs_db)]
    assert bd_rate(anchor, points) is None
    assert bd_rate(points, anchor) is None


def test_order_repetition_and_worse_points_do_not_matter() -> None:
    clean = curve(COARSE, 0.6)
    worse = [replace(point, snr_db=point.snr_db - 1, bytes_total=point.bytes_total + 1) for point in clean]
    points = [*clean, *clean, *worse]
    random.Random(0).shuffle(points)
    assert monotone_envelope(points) == clean
    assert bd_rate(curve(COARSE), points) == bd_rate(curve(COARSE), clean)


@given(st.lists(st.tuples(st.integers(1, 50), st.floats(-10, 40) | st.just(math.nan) | st.just(math.inf))))
def test_the_envelope_rises_and_covers_every_point(pairs: list[tuple[int, float]]) -> None:
    points = [Point("trace", "codec", "", 10, size, snr_db) for size, snr_db in pairs]
    envelope = monotone_envelope(points)
    for lower, upper in pairwise(envelope):
        assert lower.bytes_total < upper.bytes_total and lower.snr_db < upper.snr_db
    for point in points:
        if math.isfinite(point.snr_db):
            assert any(best.bytes_total <= point.bytes_total and best.snr_db >= point.snr_db for best in envelope)


def test_bits_per_sample_between_points() -> None:
    bits = bits_per_sample_at(curve(COARSE), np.array([1.0, 8.0, 12.0, 24.0]))
    np.testing.assert_allclose(bits, [np.nan, 1 + 8 / 6, 3, np.nan], rtol=0.01)
    assert np.isnan(bits_per_sample_at(curve(COARSE[:5]), np.array([8.0]))).all()


def test_traces_are_compared_one_by_one_and_summed_up() -> None:
    anchor = {name: curve(COARSE, trace=name) for name in ("a", "b", "c", "only here")}
    test = {name: curve(COARSE, factor, trace=name) for name, factor in (("a", 0.5), ("b", 0.6), ("c", 0.9))}
    test["d"] = curve(COARSE)
    rates = bd_rates(anchor, test)
    assert {name: round(rate.percent) for name, rate in rates.items()} == {"a": -50, "b": -40, "c": -10}
    result = summary(list(rates.values()))
    assert result.mean == pytest.approx(-100 / 3, abs=0.01)
    assert result.median == pytest.approx(-40, abs=0.01)
    assert (round(result.lowest), round(result.highest), result.traces) == (-50, -10, 3)


def test_a_summary_names_the_check() -> None:
    assert summary([BdRate(-50, -49, 5, 20), BdRate(-40, -41, 5, 20)]).akima_mean == -45
