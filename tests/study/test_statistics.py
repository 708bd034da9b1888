"""Statistics of studies against published values, scipy, statsmodels and simulated decisions."""

import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.power import TTestPower

from vibrocast.errors import InputError
from vibrocast.study import statistics as own

# Hours of sleep gained by two drugs: Cushny and Peebles 1905, the example of Student, Biometrika 6(1), 1908.
SLEEP = (
    [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
    [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
)
# Ratings of two films: Lakens 2013, table 1.
FILMS = ([9, 7, 8, 9, 8, 9, 9, 10, 9, 9], [9, 6, 7, 8, 7, 9, 8, 8, 8, 7])
# Baseball 1987: A. Agresti, Categorical Data Analysis, 2nd edition, 2002, page 438. Wins of the row's team at home and
# on visits, against each column's.
WON_AT_HOME = [
    [0, 4, 4, 4, 6, 4, 6],
    [3, 0, 4, 4, 6, 6, 4],
    [2, 4, 0, 2, 4, 4, 6],
    [3, 5, 2, 0, 4, 4, 6],
    [5, 2, 3, 4, 0, 5, 6],
    [2, 3, 3, 4, 4, 0, 2],
    [2, 1, 1, 2, 1, 3, 0],
]
WON_ON_VISITS = [
    [0, 3, 5, 3, 1, 5, 5],
    [3, 0, 3, 1, 5, 3, 5],
    [2, 2, 0, 5, 3, 4, 6],
    [3, 3, 4, 0, 2, 3, 4],
    [1, 0, 3, 3, 0, 2, 6],
    [2, 1, 2, 2, 2, 0, 4],
    [0, 3, 0, 1, 0, 4, 0],
]


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def ends(interval: own.Interval) -> tuple[float, float, float]:
    """Return low end, value and high end of an interval that has all three."""
    assert interval.low is not None and interval.value is not None and interval.high is not None
    return interval.low, interval.value, interval.high


# ---- means and tests ----


def test_mean_interval_and_bootstrap_are_those_of_scipy() -> None:
    values = np.array(SLEEP[1])
    interval = own.mean_interval(values)
    expected = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert interval.value == pytest.approx(2.33)
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))
    interval = own.bootstrap(values, lambda each: float(np.median(each)))
    resampled = stats.bootstrap(
        (values,), np.median, method="percentile", n_resamples=5000, rng=np.random.default_rng(1)
    ).confidence_interval
    assert (interval.low, interval.high) == pytest.approx((resampled.low, resampled.high), abs=0.3)
    assert own.bootstrap(values, lambda each: float(np.median(each))) == interval


def test_paired_test_gives_the_examples_of_student_and_lakens() -> None:
    test = own.paired_test(*SLEEP)
    # As R's documentation of `sleep` has it.
    assert test.count == 10 and test.difference == pytest.approx(-1.58)
    assert test.t == pytest.approx(-4.0621, abs=5e-5)
    assert test.p == pytest.approx(0.002833, abs=5e-7)
    films = own.paired_test(*FILMS)
    assert films.t == pytest.approx(4.74, abs=0.005)
    # Cohen's d_z is 1.50; Hedges' correction for 10 people is 1 - 3 / 35.
    assert films.effect.value == pytest.approx(1.5 * (1 - 3 / 35))
    low, value, high = ends(films.effect)
    assert 0 < low < value < high


def test_holm_is_that_of_statsmodels_and_counts_only_tests_that_were_made() -> None:
    for p_values in ([0.01, 0.04, 0.03, 0.005], [0.2], [0.6, 0.6, 0.6], [0.0, 1.0, 0.5, 0.05, 0.05]):
        assert own.holm(p_values) == pytest.approx(list(multipletests(p_values, method="holm")[1]))
    assert own.holm([None, 0.02, None, 0.01]) == [None, 0.02, None, 0.02]
    assert own.holm([]) == []


# ---- sensitivity ----


def test_yes_no_sensitivity_and_the_log_linear_correction() -> None:
    # Hautus 1995: 0.5 more of each count, 1 more of each total.
    assert own.rates(50, 50, 5, 50) == pytest.approx((50.5 / 51, 5.5 / 51))
    assert own.sensitivity_yes_no(*own.rates(50, 50, 5, 50)) == pytest.approx(3.57, abs=0.01)
    # 18 of 20 and 4 of 20, corrected: z(18.5 / 21) = 1.1790 and z(4.5 / 21) = -0.7916 in a table of the normal curve.
    assert own.sensitivity("same_different", [[18, 20, 4, 20]], model="yes_no").value == pytest.approx(1.971, abs=2e-3)
    assert own.sensitivity("same_different", [[4, 20, 18, 20]], model="yes_no").value == pytest.approx(-1.971, abs=2e-3)


# Worked examples in the help texts of the Palamedes toolbox (Prins and Kingdom), PAL_SDT_1AFCsameDiff_DiffMod_PHFtoDP,
# PAL_SDT_1AFCsameDiff_IndMod_PHFtoDP and PAL_SDT_2AFCmatchSample_DiffMod_PHFtoDP.
@pytest.mark.parametrize(
    ("model", "hit_rate", "false_alarm_rate", "expected"),
    [
        ("differencing", 0.6, 0.1, 2.6837),
        ("differencing", 0.7, 0.1, 3.0675),
        ("differencing", 0.8, 0.5, 2.0629),
        ("independent", 0.6, 0.1, 2.2835),
        ("independent", 0.8, 0.1, 2.8342),
        ("independent", 0.9, 0.6, 1.7808),
    ],
)
def test_same_different_gives_published_values(
    model: own.Model, hit_rate: float, false_alarm_rate: float, expected: float
) -> None:
    assert own.sensitivity_same_different(hit_rate, false_alarm_rate, model) == pytest.approx(expected, abs=1e-4)


def test_abx_gives_published_values() -> None:
    for hit_rate, false_alarm_rate, expected in ((0.6, 0.1, 2.2063), (0.8, 0.1, 2.8010), (0.9, 0.6, 1.6940)):
        unbiased = float(stats.norm.cdf(own.sensitivity_yes_no(hit_rate, false_alarm_rate) / 2))
        assert own.sensitivity_abx(unbiased) == pytest.approx(expected, abs=1e-4)
    # PAL_SDT_2AFCmatchSample_IndMod_DPtoPHF: d' = 2.5 without bias gives 0.8639 hits.
    assert own.sensitivity_abx(0.8639, "independent") == pytest.approx(2.5, abs=1e-3)


def test_sensitivity_pools_counts_and_varies_over_participants() -> None:
    counts = [[15, 20], [17, 20], [12, 20], [18, 20]]
    interval = own.sensitivity("two_alternative", counts)
    assert interval.value == pytest.approx(math.sqrt(2) * stats.norm.ppf(62.5 / 81))
    low, value, high = ends(interval)
    assert low < value < high
    independent = own.sensitivity("abx", counts, model="independent").value
    differencing = own.sensitivity("abx", counts).value
    assert independent is not None and differencing is not None and independent < differencing


@pytest.mark.parametrize("method", ["two_alternative", "abx", "same_different"])
def test_perfect_and_hopeless_observers_have_a_finite_sensitivity(method: str) -> None:
    perfect = [[20, 20, 0, 20]] * 5 if method == "same_different" else [[20, 20]] * 5
    hopeless = [[0, 20, 20, 20]] * 5 if method == "same_different" else [[0, 20]] * 5
    high, low = own.sensitivity(method, perfect).value, own.sensitivity(method, hopeless).value
    assert high is not None and 2.5 < high < own.LARGEST_SENSITIVITY
    assert low is not None and low <= 0


def test_same_stimuli_have_no_sensitivity() -> None:
    right = np.random.default_rng(3).binomial(40, 0.5, 12)
    low, _, high = ends(own.sensitivity("two_alternative", np.column_stack([right, np.full(12, 40)])))
    assert low < 0 < high
    assert own.sensitivity("same_different", [[4, 20, 5, 20]] * 5).value == 0


# ---- planning ----


@pytest.mark.parametrize("count", [3, 10, 30])
@pytest.mark.parametrize("alpha", [0.05, 0.01])
def test_power_is_that_of_statsmodels(count: int, alpha: float) -> None:
    other = TTestPower()
    for effect in (0.0, 0.3, 0.8, 1.5, -0.8):
        expected = other.power(effect, count, alpha)
        if np.isfinite(expected):  # statsmodels has none where scipy has none
            assert own.power_of_paired_test(effect, count, alpha) == pytest.approx(expected, abs=1e-6)
    least = own.detectable_effect(count, 0.8, alpha)
    assert least is not None
    assert own.power_of_paired_test(least, count, alpha) == pytest.approx(0.8)
    if count > 3:  # statsmodels errs where scipy has no far tail
        assert least == pytest.approx(other.solve_power(nobs=count, alpha=alpha, power=0.8), rel=1e-4)


def test_power_of_three_people_agrees_with_simulated_studies() -> None:
    drawn = np.random.default_rng(1).normal(7.3, 1.0, (50_000, 3))
    found = np.mean(stats.ttest_1samp(drawn, 0, axis=1).pvalue < 0.01)
    assert own.power_of_paired_test(7.3, 3, 0.01) == pytest.approx(found, abs=0.01)


def test_the_needed_participants_are_the_fewest_with_enough_power() -> None:
    needed = own.participants_needed(0.8)
    assert needed is not None
    assert own.power_of_paired_test(0.8, needed) >= 0.8 > own.power_of_paired_test(0.8, needed - 1)
    assert own.participants_needed(0.1) is None


# ---- models ----


def test_bradley_terry_gives_agrestis_example() -> None:
    wins = np.array(WON_AT_HOME) + np.array(WON_ON_VISITS)
    assert np.all((wins + wins.T)[~np.eye(7, dtype=bool)] == 13)
    strengths = own.bradley_terry(wins, added=0)
    # Agresti 2002, section 10.6; to four digits in the documentation of the R package BradleyTerry2.
    expected = [1.5814, 1.4364, 1.2945, 1.2476, 1.1077, 0.6839, 0.0]
    assert strengths - strengths[-1] == pytest.approx(expected, abs=6e-5)
    assert np.mean(strengths) == pytest.approx(0)


def test_bradley_terry_of_an_item_that_always_wins_is_finite() -> None:
    strengths = own.bradley_terry([[0, 10, 0], [0, 0, 0], [0, 0, 0]])
    assert strengths[0] == pytest.approx(-strengths[1])
    assert np.exp(strengths[0] - strengths[1]) == pytest.approx(10.5 / 0.5)
    assert strengths[2] == pytest.approx(0, abs=1e-6)
    assert own.bradley_terry(np.zeros((3, 3))) == pytest.approx([0, 0, 0])


def test_mixed_model_of_balanced_ratings_is_the_analysis_of_variance() -> None:
    random, conditions = np.random.default_rng(2), ["reference", "fine", "coarse"] * 12
    table = random.normal(0, 2, (12, 1)) + np.array([0.0, 0.5, 1.5]) + random.normal(0, 1, (12, 3))
    fit = own.mixed_model(table.ravel(), conditions, list(np.repeat(range(12), 3)), "reference")
    assert fit is not None
    residual = table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()
    variance = np.sum(residual**2) / (11 * 2)
    for place, name in ((1, "fine"), (2, "coarse")):
        difference, error, p = fit[name]
        assert difference == pytest.approx(np.mean(table[:, place] - table[:, 0]), abs=1e-6)
        assert error == pytest.approx(math.sqrt(2 * variance / 12), rel=1e-3)
        assert p == pytest.approx(2 * stats.norm.sf(abs(difference / error)), abs=1e-6)


def test_correlations_are_those_of_scipy() -> None:
    result = own.correlation(*SLEEP)
    expected = stats.pearsonr(*SLEEP)
    interval = expected.confidence_interval(0.95)
    assert result.pearson.value == pytest.approx(expected.statistic)
    assert (result.pearson.low, result.pearson.high) == pytest.approx((interval.low, interval.high))
    rho = stats.spearmanr(*SLEEP).statistic
    assert result.spearman.value == pytest.approx(rho)
    width = 1.959964 * math.sqrt((1 + rho**2 / 2) / 7)
    expected_ends = (math.tanh(math.atanh(rho) - width), math.tanh(math.atanh(rho) + width))
    assert (result.spearman.low, result.spearman.high) == pytest.approx(expected_ends)


# ---- degenerate ratings ----


def test_too_few_people_or_trials_and_no_spread_give_none() -> None:
    nothing = own.Interval(None, None, None)
    assert own.sensitivity("abx", np.zeros((0, 2))) == nothing
    assert own.sensitivity("abx", [[0, 0], [0, 0]]) == nothing
    assert own.sensitivity("same_different", [[3, 4, 0, 0]] * 3) == nothing
    one = own.sensitivity("abx", [[8, 10]])
    assert one.value is not None and one.low is None and one.high is None
    assert own.mean_interval([]) == nothing
    assert own.mean_interval([2.0]) == own.Interval(2.0, None, None)
    for first, second, expected in (
        ([], [], (0, None, None)),
        ([1.0], [0.0], (1, None, None)),
        ([1, 2, 3], [1, 2, 3], (3, None, 1.0)),
        ([2, 3, 4], [1, 2, 3], (3, None, None)),
        ([1.1, 2.1, 3.1], [1, 2, 3], (3, None, None)),
    ):
        test = own.paired_test(first, second)
        assert (test.count, test.t, test.p) == expected
        assert test.effect.value is None
    two = own.paired_test([1.0, 2.0], [0.0, 0.5])
    assert two.p is not None and two.effect.value is None
    assert own.power_of_paired_test(2.0, 1) == 0 and own.power_of_paired_test(100.0, 10) == 1
    assert own.detectable_effect(2) is None
    for values, conditions, people in (
        ([], [], []),
        ([1, 2], ["a", "b"], [1, 1]),
        ([1, 1, 1, 1], ["a", "b"] * 2, [1, 1, 2, 2]),
        ([1, 2, 3, 4], ["b", "c"] * 2, [1, 1, 2, 2]),
        ([0, 1, 0, 1], ["a", "b"] * 2, [1, 1, 2, 2]),
    ):
        assert own.mixed_model(values, conditions, people, "a") is None
    assert own.correlation([], []).pearson == own.correlation([1, 2, 3], [5, 5, 5]).spearman == nothing
    assert own.correlation([1, 2, 3], [1, 2, 4]).pearson.low is None
    line = own.correlation([1, 2, 3, 4, 5], [2, 4, 6, 8, 10])
    assert line.pearson.value == pytest.approx(1) and line.pearson.low is None


DAMAGED: list[tuple[Callable[..., object], tuple[object, ...], str]] = [
    *(
        (own.sensitivity, ("abx", counts), "another table")
        for counts in ([[1, 2, 3]], [[math.nan, 2]], [[-1, 2]], [[3, 2]], [], [1, 2])
    ),
    (partial(own.sensitivity, model="yes_no"), ("abx", [[4, 20]]), "same-different"),
    *((own.sensitivity_two_alternative, (rate,), "gives no d'") for rate in (0.0, 1.0, math.nan)),
    *((own.sensitivity_abx, (rate,), "gives no d'") for rate in (0.0, 1.0, math.nan)),
    *((own.sensitivity_same_different, (rate, 0.5), "gives no d'") for rate in (0.0, 1.0, math.nan)),
    *((own.bradley_terry, (wins,), "wins") for wins in ([1, 2], [[1, 2]], [[0, math.nan], [1, 0]], [[0, -1], [1, 0]])),
    (own.bradley_terry, (np.zeros((0, 0)),), "wins"),
    *((own.mean_interval, (each,), "remove those rows") for each in ([1.0, math.nan], [1.0, math.inf], [[1.0], [2.0]])),
    (own.paired_test, ([1, 2], [1]), "needs both"),
    (own.holm, ([0.1, math.nan],), "p value"),
    (own.mixed_model, ([1, math.nan], ["a", "b"], [1, 2], "a"), "remove those rows"),
    (own.mixed_model, ([1, 2, 3], ["a", "b"], [1, 2], "a"), "needs both"),
    (own.correlation, ([1, math.nan, 3], [1, 2, 3]), "remove those rows"),
    (own.correlation, ([1, 2], [1, 2, 3]), "needs pairs"),
]


@pytest.mark.parametrize(("called", "arguments", "message"), DAMAGED)
def test_damaged_values_are_rejected(
    called: Callable[..., object], arguments: tuple[object, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        called(*arguments)


def test_post_screening_of_mushra() -> None:
    assert own.is_reliable([100] * 17 + [80] * 3)
    assert not own.is_reliable([100] * 16 + [80] * 4)
    assert own.is_reliable([90] * 20) and own.is_reliable([])
