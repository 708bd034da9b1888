"""Statistics of listening studies: intervals, tests, effect sizes, sensitivities, power; each with its source."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrocast.errors import InputError

Values = NDArray[np.float64]
Model = Literal["differencing", "independent", "yes_no"]
"""How an observer decides: by the difference of two stimuli, by classifying each, or as if each pair were one stimulus
with or without a signal."""

CONFIDENCE = 0.95
BOOTSTRAPS = 2000
LARGEST_SENSITIVITY = 8.0
"""Beyond any that a study can measure; a search for d' ends here."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval; None where the data give none."""

    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class PairedTest:
    """A paired t-test. `effect`: Cohen's d_z with Hedges' correction. `holm_p`: p after Holm's correction."""

    count: int
    difference: float
    t: float | None
    p: float | None
    effect: Interval
    holm_p: float | None = None


def _finite(values: ArrayLike, name: str) -> Values:
    """Return finite numbers (n,). Raises InputError for others."""
    array = np.asarray(values, np.float64)
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise InputError(f"{name}: some values are no finite numbers; remove those rows")
    return array


def mean_interval(values: ArrayLike) -> Interval:
    """Return the mean of independent values (n,) and Student's t interval; none for fewer than two."""
    from scipy import stats

    array = _finite(values, "values")
    if not len(array):
        return Interval(None, None, None)
    mean = float(np.mean(array))
    if len(array) < 2:
        return Interval(mean, None, None)
    width = float(stats.sem(array) * stats.t.ppf((1 + CONFIDENCE) / 2, len(array) - 1))
    return Interval(mean, mean - width, mean + width)


def paired_test(values: ArrayLike, reference: ArrayLike, seed: int = 0) -> PairedTest:
    """Return the two-sided paired t-test of values against a reference, both (participants,).

    t and p as from `t_test`.
    """
    x, y = _finite(values, "values"), _finite(reference, "reference")
    if len(x) != len(y):
        raise InputError(f"{len(x)} values against {len(y)}; a paired test needs both of every participant")
    differences = x - y
    count, mean = len(x), float(np.mean(x - y)) if len(x) else 0.0
    return PairedTest(count, mean, *t_test(differences), effect_size(differences, seed))


def t_test(differences: ArrayLike) -> tuple[float | None, float | None]:
    """Return t and the two-sided p of paired differences (participants,), with one degree of freedom less than those.

    Without a spread of the differences, t is undefined: p is then 1 where all agree, and None otherwise.
    """
    from scipy import stats

    array = _finite(differences, "differences")
    if len(array) < 2 or not _spreads(array):
        return None, 1.0 if len(array) >= 2 and not np.any(array) else None
    result = stats.ttest_1samp(array, 0.0)
    return float(result.statistic), float(result.pvalue)


def effect_size(differences: ArrayLike, seed: int = 0) -> Interval:
    """Return Cohen's d_z of paired differences, mean over standard deviation, times Hedges' 1 - 3 / (4 n - 5).

    D. Lakens, "Calculating and reporting effect sizes", Frontiers in Psychology 4:863, 2013. The interval is a
    percentile bootstrap over participants.
    """
    array = _finite(differences, "differences")
    if len(array) < 3 or not _spreads(array):
        return Interval(None, None, None)
    return bootstrap(array, _hedges, seed)


def _spreads(values: Values) -> bool:
    """Return whether values differ by more than rounding, such as 1.1 - 1 and 2.1 - 2 do not."""
    return bool(len(values)) and bool(np.ptp(values) > 1e-12 * np.max(np.abs(values), initial=1.0))


def _hedges(differences: Values) -> float:
    if not _spreads(differences):
        return math.nan
    return float(np.mean(differences) / np.std(differences, ddof=1)) * (1 - 3 / (4 * len(differences) - 5))


def bootstrap(rows: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], float], seed: int = 0) -> Interval:
    """Return a statistic of rows (participants, ...) and its percentile interval over BOOTSTRAPS resamples of the rows.

    B. Efron and R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13. Resamples without a value do not
    count.
    """
    value = statistic(rows) if len(rows) else math.nan
    if not math.isfinite(value) or len(rows) < 2:
        return Interval(value if math.isfinite(value) else None, None, None)
    random = np.random.default_rng(seed)
    drawn = [statistic(rows[random.integers(len(rows), size=len(rows))]) for _ in range(BOOTSTRAPS)]
    finite = [each for each in drawn if math.isfinite(each)]
    if len(finite) < BOOTSTRAPS // 2:
        return Interval(value, None, None)
    low, high = np.quantile(finite, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p values corrected for the number of tests; None stays and does not count.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.
    Raises InputError for a p outside 0 to 1.
    """
    from statsmodels.stats.multitest import multipletests

    if any(p is not None and not 0 <= p <= 1 for p in p_values):
        raise InputError("a p value lies outside 0 to 1; correct p values of tests")
    known = [p for p in p_values if p is not None]
    corrected = iter(multipletests(known, method="holm")[1].tolist() if known else ())
    return [None if p is None else next(corrected) for p in p_values]


# ---- sensitivity ----


def rates(hits: float, signals: float, false_alarms: float, noises: float) -> tuple[float, float]:
    """Return hit and false alarm rates with the log-linear correction: 0.5 more of each count, 1 more of each total.

    M. J. Hautus, "Corrections for extreme proportions and their biasing effects on estimated values of d'", Behavior
    Research Methods 27(1), 1995. So a rate is never 0 or 1.
    """
    return (hits + 0.5) / (signals + 1), (false_alarms + 0.5) / (noises + 1)


def _rate(value: float) -> float:
    """Return a rate. Raises InputError for one that is not between 0 and 1: its d' would be infinite."""
    if not 0 < value < 1:
        raise InputError(f"a rate of {value} gives no d'; correct the counts with `rates` first")
    return float(value)


def sensitivity_yes_no(hit_rate: float, false_alarm_rate: float) -> float:
    """Return d' = z(H) - z(F). Macmillan and Creelman, Detection Theory, 2nd edition, 2005, chapter 1."""
    from scipy.special import ndtri

    return float(ndtri(_rate(hit_rate)) - ndtri(_rate(false_alarm_rate)))


def sensitivity_two_alternative(correct_rate: float) -> float:
    """Return d' = sqrt(2) z(p) for two-alternative forced choice. Macmillan and Creelman 2005, chapter 7."""
    from scipy.special import ndtri

    return float(math.sqrt(2) * ndtri(_rate(correct_rate)))


def sensitivity_same_different(hit_rate: float, false_alarm_rate: float, model: Model = "differencing") -> float:
    """Return d' of same-different trials; 0 where H <= F. Macmillan and Creelman 2005, chapter 9.

    By the differencing model, the observer compares the difference with a criterion k: F = 2 Phi(-k / sqrt(2)),
    H = Phi((d' - k) / sqrt(2)) + Phi((-d' - k) / sqrt(2)). By independent observation, the observer classifies each of
    the two: d' = 2 z((1 + sqrt(2 p - 1)) / 2) with p = Phi((z(H) - z(F)) / 2). "yes_no" is z(H) - z(F) itself, also
    below 0. It takes the pair for one stimulus, and is smaller than the others.
    """
    from scipy.special import ndtr, ndtri

    z_difference = sensitivity_yes_no(hit_rate, false_alarm_rate)
    if model == "yes_no":
        return z_difference
    if z_difference <= 0:
        return 0.0
    if model == "independent":
        return min(LARGEST_SENSITIVITY, 2 * float(ndtri((1 + math.sqrt(2 * ndtr(z_difference / 2) - 1)) / 2)))
    criterion = -math.sqrt(2) * float(ndtri(false_alarm_rate / 2))

    def hits(sensitivity: float) -> float:
        below, above = -sensitivity - criterion, sensitivity - criterion
        return float(ndtr(above / math.sqrt(2)) + ndtr(below / math.sqrt(2)))

    return _sensitivity_at(hits, hit_rate)


def sensitivity_abx(correct_rate: float, model: Model = "differencing") -> float:
    """Return d' of ABX trials of an unbiased observer; 0 at chance and below. Macmillan and Creelman 2005, chapter 9.

    By the differencing model, p = Phi(d' / sqrt(2)) Phi(d' / sqrt(6)) + Phi(-d' / sqrt(2)) Phi(-d' / sqrt(6)). By
    independent observation, it has d' / 2 in place of d' / sqrt(6).
    """
    from scipy.special import ndtr

    divisor = math.sqrt(6) if model == "differencing" else 2.0

    def correct(sensitivity: float) -> float:
        order, match = sensitivity / math.sqrt(2), sensitivity / divisor
        return float(ndtr(order) * ndtr(match) + ndtr(-order) * ndtr(-match))

    return 0.0 if _rate(correct_rate) <= 0.5 else _sensitivity_at(correct, correct_rate)


def _sensitivity_at(rate_of: Callable[[float], float], rate: float) -> float:
    """Return the d' from 0 to LARGEST_SENSITIVITY that gives a rate; rates rise with d'."""
    from scipy.optimize import brentq

    if rate_of(LARGEST_SENSITIVITY) <= rate:
        return LARGEST_SENSITIVITY
    return float(brentq(lambda sensitivity: rate_of(sensitivity) - rate, 0.0, LARGEST_SENSITIVITY))


def sensitivity(method: str, counts: ArrayLike, model: Model = "differencing") -> Interval:
    """Return d' of a method, and its bootstrap interval over participants.

    `counts`: (participants, 4): hits, trials that differ, false alarms, trials that are the same; (participants, 2) of
    forced choice and ABX: correct answers, trials. Counts are pooled over participants, with the log-linear correction.
    Where sensitivities differ, the pooled one lies below their mean (Macmillan and Creelman 2005, chapter 13).
    `model`: of same-different and ABX trials; "differencing" where stimuli rove from trial to trial, "independent"
    where they stay the same; "yes_no" of same-different trials alone. Raises InputError.
    """
    if model == "yes_no" and method != "same_different":
        raise InputError(f"{method}: z(H) - z(F) is of same-different trials; choose another model")
    table = np.asarray(counts, np.float64)
    columns = 4 if method == "same_different" else 2
    if table.ndim != 2 or table.shape[1] != columns or not np.all(np.isfinite(table)) or np.any(table < 0):
        raise InputError(f"{method}: counts must be {columns} for each participant; give another table")
    if np.any(table[:, ::2] > table[:, 1::2]):
        raise InputError(f"{method}: more answers than trials; give another table")

    def pooled(rows: NDArray[np.float64]) -> float:
        total = rows.sum(axis=0)
        if np.any(total[1::2] == 0):
            return math.nan
        if method == "same_different":
            return sensitivity_same_different(*rates(*total), model)
        rate = (total[0] + 0.5) / (total[1] + 1)
        return sensitivity_abx(rate, model) if method == "abx" else sensitivity_two_alternative(rate)

    return bootstrap(table, pooled)


# ---- planning ----


def power_of_paired_test(effect: float, count: int, alpha: float = 0.05) -> float:
    """Return the power of the two-sided paired t-test to find an effect d_z with `count` participants.

    By the noncentral t distribution: J. Cohen, Statistical Power Analysis for the Behavioral Sciences, 1988, 2.2.
    """
    from scipy import stats

    if count < 2:
        return 0.0
    critical = stats.t.ppf(1 - alpha / 2, count - 1)
    shift = abs(effect) * math.sqrt(count)
    near = float(stats.nct.sf(critical, count - 1, shift))
    far = float(stats.nct.cdf(-critical, count - 1, shift))
    # scipy has no value far out: there the near tail holds everything, and the far one nothing.
    return (near if math.isfinite(near) else 1.0) + (far if math.isfinite(far) else 0.0)


def detectable_effect(count: int, power: float = 0.8, alpha: float = 0.05) -> float | None:
    """Return the smallest effect d_z that a paired t-test finds with this power; None for fewer than three people."""
    from scipy.optimize import brentq

    if count < 3:
        return None
    return float(brentq(lambda effect: power_of_paired_test(effect, count, alpha) - power, 1e-6, 50.0))


def participants_needed(effect: float, power: float = 0.8, alpha: float = 0.05, most: int = 100) -> int | None:
    """Return how many participants a paired t-test needs to find an effect d_z; None for more than `most`."""
    return next((count for count in range(2, most + 1) if power_of_paired_test(effect, count, alpha) >= power), None)


# ---- models of several conditions ----


def bradley_terry(wins: ArrayLike, added: float = 0.5) -> Values:
    """Return the strength of each item in log units, with mean 0, from wins (..., items, items): [i, j] = i over j.

    The iteration of D. R. Hunter, "MM algorithms for generalized Bradley-Terry models", Annals of Statistics 32(1),
    2004, on all tables at once. `added` wins count each way for every pair that met. So an item that always wins has a
    finite strength. An item that met no other has 0. Raises InputError.
    """
    table = np.array(wins, np.float64)
    if (
        table.ndim < 2
        or table.shape[-2] != table.shape[-1]
        or not table.size
        or not np.all(np.isfinite(table))
        or np.any(table < 0)
    ):
        raise InputError("wins must be a square table of counts; give another table")
    table *= 1 - np.eye(table.shape[-1])
    met = table + np.swapaxes(table, -1, -2)
    table = np.where(met > 0, table + added, 0.0)
    met = table + np.swapaxes(table, -1, -2)
    strengths = np.ones(table.shape[:-1])
    for _ in range(10_000):
        divisor = np.sum(met / (strengths[..., :, None] + strengths[..., None, :]), axis=-1)
        updated = table.sum(axis=-1) / np.where(divisor > 0, divisor, 1.0)
        updated = np.where(updated > 0, updated, 1.0)
        updated /= np.exp(np.mean(np.log(updated), axis=-1, keepdims=True))
        if np.max(np.abs(np.log(updated / strengths))) < 1e-10:
            break
        strengths = updated
    return np.asarray(np.log(updated))


class Effect(NamedTuple):
    """The effect of a condition in a linear mixed model."""

    difference: float
    standard_error: float
    p: float


def mixed_model(
    ratings: ArrayLike, conditions: Sequence[str], participants: Sequence[object], reference: str
) -> dict[str, Effect] | None:
    """Fit rating ~ condition + (1 | participant) by REML with statsmodels; None where the data determine no fit.

    Returns the effect of each condition; participants are random intercepts. N. M. Laird and J. H. Ware,
    "Random-effects models for longitudinal data", Biometrics 38(4), 1982. Raises InputError.
    """
    import warnings

    import statsmodels.api as sm

    values = _finite(ratings, "ratings")
    if not len(values) == len(conditions) == len(participants):
        raise InputError(f"{len(values)} ratings, {len(conditions)} conditions; a model needs both of every answer")
    others = [name for name in dict.fromkeys(conditions) if name != reference]
    groups = [str(each) for each in participants]
    if reference not in conditions or not others or len(set(groups)) < 2 or not _spreads(values):
        return None
    names = np.array(conditions)
    design = np.column_stack([np.ones(len(values)), *(names == name for name in others)]).astype(np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the numbers of a fit show that it lies at the edge of its range
        try:
            fit = sm.MixedLM(values, design, groups).fit(reml=True)
        except (np.linalg.LinAlgError, ValueError):
            return None
    effects = {
        name: Effect(float(fit.fe_params[place]), float(fit.bse_fe[place]), float(fit.pvalues[place]))
        for place, name in enumerate(others, 1)
    }
    return effects if all(math.isfinite(number) for each in effects.values() for number in each) else None


@dataclass(frozen=True)
class Correlation:
    """Pearson's r and Spearman's rho with their intervals; None where a variable does not vary."""

    count: int
    pearson: Interval
    spearman: Interval


def correlation(x: ArrayLike, y: ArrayLike) -> Correlation:
    """Return how two variables (n,) go together.

    The interval of r is Fisher's: tanh(atanh r +- z / sqrt(n - 3)). R. A. Fisher, Metron 1, 1921. That of rho has the
    standard error sqrt((1 + rho^2 / 2) / (n - 3)): D. G. Bonett and T. A. Wright, "Sample size requirements for
    estimating Pearson, Kendall and Spearman correlations", Psychometrika 65(1), 2000. Raises InputError.
    """
    from scipy import stats

    first, second = _finite(x, "x"), _finite(y, "y")
    count = len(first)
    if count != len(second):
        raise InputError(f"{count} values against {len(second)}; a correlation needs pairs")
    if count < 3 or not _spreads(first) or not _spreads(second):
        nothing = Interval(None, None, None)
        return Correlation(count, nothing, nothing)
    r = float(stats.pearsonr(first, second).statistic)
    rho = float(stats.spearmanr(first, second).statistic)
    return Correlation(count, _fisher(r, count, 1.0), _fisher(rho, count, 1 + rho**2 / 2))


def _fisher(coefficient: float, count: int, variance: float) -> Interval:
    """Return a correlation with the interval of its Fisher transform; `variance`: times count - 3."""
    from scipy.special import ndtri

    if count < 4 or abs(coefficient) >= 1 - 1e-12:
        return Interval(coefficient, None, None)
    width = float(ndtri((1 + CONFIDENCE) / 2)) * math.sqrt(variance / (count - 3))
    middle = math.atanh(coefficient)
    return Interval(coefficient, math.tanh(middle - width), math.tanh(middle + width))


HIDDEN_REFERENCE_LEAST = 90
HIDDEN_REFERENCE_MOST_MISSED = 0.15


def is_reliable(hidden_reference_ratings: ArrayLike) -> bool:
    """Return whether a participant of a MUSHRA study counts: the hidden reference below 90 in at most 15 % of trials.

    ITU-R BS.1534-3, post-screening of listeners. Its second rule, about the mid anchor, is left out: an anchor of touch
    may well be hard to tell.
    """
    ratings = _finite(hidden_reference_ratings, "ratings")
    return bool(not len(ratings) or np.mean(ratings < HIDDEN_REFERENCE_LEAST) <= HIDDEN_REFERENCE_MOST_MISSED)
