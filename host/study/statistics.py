"""Statistics of listening studies: intervals, tests, effect sizes, sensitivities, power; each with its source."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrocast.host.study.trials import StudyError

Values = NDArray[np.float64]

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
    """Return finite numbers (n,). Raises StudyError for others."""
    array = np.asarray(values, np.float64)
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise StudyError(f"{name}: some values are no finite numbers; remove those rows")
    return array


def mean_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of independent values (n,) and Student's t interval; none for fewer than two."""
    from scipy import stats

    array = _finite(values, "values")
    if not len(array):
        return Interval(None, None, None)
    mean = float(np.mean(array))
    if len(array) < 2:
        return Interval(mean, None, None)
    width = float(stats.sem(array) * stats.t.ppf((1 + confidence) / 2, len(array) - 1))
    return Interval(mean, mean - width, mean + width)


def paired_test(values: ArrayLike, reference: ArrayLike, seed: int = 0) -> PairedTest:
    """Return the two-sided paired t-test of values against a reference, both (participants,).

    Without a spread of the differences, t is undefined: p is then 1 where all agree, and None otherwise.
    """
    from scipy import stats

    x, y = _finite(values, "values"), _finite(reference, "reference")
    if len(x) != len(y):
        raise StudyError(f"{len(x)} values against {len(y)}; a paired test needs both of every participant")
    differences = x - y
    count, mean = len(x), float(np.mean(x - y)) if len(x) else 0.0
    effect = effect_size(differences, seed)
    if count < 2 or np.ptp(differences) == 0:
        return PairedTest(count, mean, None, 1.0 if count >= 2 and mean == 0 else None, effect)
    result = stats.ttest_rel(x, y)
    return PairedTest(count, mean, float(result.statistic), float(result.pvalue), effect)


def effect_size(differences: ArrayLike, seed: int = 0) -> Interval:
    """Return Cohen's d_z of paired differences, mean over standard deviation, times Hedges' 1 - 3 / (4 n - 5).

    D. Lakens, "Calculating and reporting effect sizes", Frontiers in Psychology 4:863, 2013. The interval is a
    percentile bootstrap over participants.
    """
    array = _finite(differences, "differences")
    if len(array) < 3 or np.ptp(array) == 0:
        return Interval(None, None, None)
    return bootstrap(array, _hedges, seed)


def _hedges(differences: Values) -> float:
    deviation = float(np.std(differences, ddof=1))
    if deviation == 0:
        return math.nan
    return float(np.mean(differences)) / deviation * (1 - 3 / (4 * len(differences) - 5))


def bootstrap(rows: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], float], seed: int = 0) -> Interval:
    """Return a statistic of rows (participants, ...) and its percentile interval over BOOTSTRAPS resamples of the rows.

    B. Efron and R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13. Resamples without a value do not
    count.
    """
    value = statistic(rows)
    random = np.random.default_rng(seed)
    drawn = [statistic(rows[random.integers(len(rows), size=len(rows))]) for _ in range(BOOTSTRAPS)]
    finite = [each for each in drawn if math.isfinite(each)]
    if not math.isfinite(value) or len(rows) < 2 or len(finite) < BOOTSTRAPS // 2:
        return Interval(value if math.isfinite(value) else None, None, None)
    low, high = np.quantile(finite, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p values corrected for the number of tests; None stays and does not count.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.
    """
    known = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, place) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        corrected[place] = largest
    return corrected


# ---- sensitivity ----


def rates(hits: float, signals: float, false_alarms: float, noises: float) -> tuple[float, float]:
    """Return hit and false alarm rates with the log-linear correction: 0.5 more of each count, 1 more of each total.

    M. J. Hautus, "Corrections for extreme proportions and their biasing effects on estimated values of d'", Behavior
    Research Methods 27(1), 1995. So a rate is never 0 or 1.
    """
    return (hits + 0.5) / (signals + 1), (false_alarms + 0.5) / (noises + 1)


def sensitivity_yes_no(hit_rate: float, false_alarm_rate: float) -> float:
    """Return d' = z(H) - z(F). Macmillan and Creelman, Detection Theory, 2nd edition, 2005, chapter 1."""
    from scipy.special import ndtri

    return float(ndtri(hit_rate) - ndtri(false_alarm_rate))


def sensitivity_two_alternative(correct_rate: float) -> float:
    """Return d' = sqrt(2) z(p) for two-alternative forced choice. Macmillan and Creelman 2005, chapter 7."""
    from scipy.special import ndtri

    return float(math.sqrt(2) * ndtri(correct_rate))


def sensitivity_same_different(hit_rate: float, false_alarm_rate: float) -> float:
    """Return d' of same-different trials, where the observer compares the difference with a criterion k.

    The differencing model: F = 2 Phi(-k / sqrt(2)), H = Phi((d' - k) / sqrt(2)) + Phi((-d' - k) / sqrt(2)). Macmillan
    and Creelman 2005, chapter 9. 0 where H <= F.
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr, ndtri

    if hit_rate <= false_alarm_rate:
        return 0.0
    criterion = -math.sqrt(2) * float(ndtri(false_alarm_rate / 2))

    def excess(sensitivity: float) -> float:
        below, above = -sensitivity - criterion, sensitivity - criterion
        return float(ndtr(above / math.sqrt(2)) + ndtr(below / math.sqrt(2))) - hit_rate

    if excess(LARGEST_SENSITIVITY) <= 0:
        return LARGEST_SENSITIVITY
    return float(brentq(excess, 0.0, LARGEST_SENSITIVITY))


def correct_rate_abx(sensitivity: float) -> float:
    """Return the part of correct answers in ABX by the differencing model, for an unbiased observer.

    p = Phi(d' / sqrt(2)) Phi(d' / sqrt(6)) + Phi(-d' / sqrt(2)) Phi(-d' / sqrt(6)). Macmillan and Creelman 2005,
    chapter 9.
    """
    from scipy.special import ndtr

    two, six = sensitivity / math.sqrt(2), sensitivity / math.sqrt(6)
    return float(ndtr(two) * ndtr(six) + ndtr(-two) * ndtr(-six))


def sensitivity_abx(correct_rate: float) -> float:
    """Return d' of ABX trials by the differencing model; 0 at chance and below."""
    from scipy.optimize import brentq

    if correct_rate <= 0.5:
        return 0.0
    if correct_rate >= correct_rate_abx(LARGEST_SENSITIVITY):
        return LARGEST_SENSITIVITY
    return float(brentq(lambda each: correct_rate_abx(each) - correct_rate, 0.0, LARGEST_SENSITIVITY))


def sensitivity(method: str, counts: ArrayLike, seed: int = 0) -> Interval:
    """Return d' of a method, and its bootstrap interval over participants.

    `counts`: (participants, 4): hits, trials that differ, false alarms, trials that are the same; (participants, 2) of
    forced choice and ABX: correct answers, trials. Counts are pooled over participants, with the log-linear correction.
    """
    table = np.asarray(counts, np.float64)
    columns = 4 if method == "same_different" else 2
    if table.ndim != 2 or table.shape[1] != columns or not np.all(np.isfinite(table)) or np.any(table < 0):
        raise StudyError(f"{method}: counts must be {columns} for each participant; give another table")

    def pooled(rows: NDArray[np.float64]) -> float:
        total = rows.sum(axis=0)
        if method == "same_different":
            if total[1] == 0 or total[3] == 0:
                return math.nan
            return sensitivity_same_different(*rates(*total))
        if total[1] == 0:
            return math.nan
        rate = (total[0] + 0.5) / (total[1] + 1)
        return sensitivity_abx(rate) if method == "abx" else sensitivity_two_alternative(rate)

    return bootstrap(table, pooled, seed)


# ---- planning ----


def power_of_paired_test(effect: float, count: int, alpha: float = 0.05) -> float:
    """Return the power of the two-sided paired t-test to find an effect d_z with `count` participants.

    By the noncentral t distribution: J. Cohen, Statistical Power Analysis for the Behavioral Sciences, 1988, 2.2.
    """
    from scipy import stats

    if count < 2:
        return 0.0
    critical = stats.t.ppf(1 - alpha / 2, count - 1)
    shift = effect * math.sqrt(count)
    power = float(stats.nct.sf(critical, count - 1, shift) + stats.nct.cdf(-critical, count - 1, shift))
    return power if math.isfinite(power) else 1.0  # scipy has no value far out, where nothing is missed


def detectable_effect(count: int, power: float = 0.8, alpha: float = 0.05) -> float | None:
    """Return the smallest effect d_z that a paired t-test finds with this power; None for fewer than three people."""
    from scipy.optimize import brentq

    if count < 3:
        return None
    return float(brentq(lambda effect: power_of_paired_test(effect, count, alpha) - power, 1e-6, 50.0))


def participants_for(effect: float, power: float = 0.8, alpha: float = 0.05, most: int = 1000) -> int | None:
    """Return how many participants a paired t-test needs to find an effect; None for more than `most`."""
    counts = range(2, most + 1)
    return next((count for count in counts if power_of_paired_test(effect, count, alpha) >= power), None)


# ---- models of several conditions ----


def bradley_terry(wins: ArrayLike) -> Values:
    """Return the strength of each item in log units, with mean 0, from wins (items, items): [i, j] = i over j.

    The iteration of D. R. Hunter, "MM algorithms for generalized Bradley-Terry models", Annals of Statistics 32(1),
    2004. Half a win each way is added to every pair that met, so that an item that always wins has a
    finite strength.
    """
    table = np.asarray(wins, np.float64)
    if table.ndim != 2 or table.shape[0] != table.shape[1] or not np.all(np.isfinite(table)) or np.any(table < 0):
        raise StudyError("wins must be a square table of counts; give another table")
    met = table + table.T
    table = np.where(met > 0, table + 0.5, 0.0)
    met = table + table.T
    strengths = np.ones(len(table))
    for _ in range(10_000):
        divisor = np.sum(met / (strengths[:, None] + strengths[None, :]), axis=1)
        updated = table.sum(axis=1) / np.where(divisor > 0, divisor, 1.0)
        updated = np.where(updated > 0, updated, 1.0)
        updated /= np.exp(np.mean(np.log(updated)))
        if np.max(np.abs(np.log(updated / strengths))) < 1e-10:
            break
        strengths = updated
    return np.asarray(np.log(updated))


@dataclass(frozen=True)
class MixedModel:
    """A linear mixed model of ratings: each condition against the reference, participants as random intercepts.

    `effects`: by condition, difference, standard error and p. `participant_sd`, `residual_sd`: standard deviations.
    """

    effects: Mapping[str, tuple[float, float, float]]
    participant_sd: float
    residual_sd: float


def mixed_model(
    ratings: ArrayLike, conditions: Sequence[str], participants: Sequence[object], reference: str
) -> MixedModel | None:
    """Fit rating ~ condition + (1 | participant) by REML with statsmodels; None where the data determine no fit."""
    import warnings

    import statsmodels.api as sm

    values = _finite(ratings, "ratings")
    others = [name for name in dict.fromkeys(conditions) if name != reference]
    groups = [str(each) for each in participants]
    if reference not in conditions or not others or len(set(groups)) < 2 or np.ptp(values) == 0:
        return None
    names = np.array(conditions)
    design = np.column_stack([np.ones(len(values)), *(names == name for name in others)]).astype(np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fit at the edge of its range is told by its numbers
        try:
            fit = sm.MixedLM(values, design, groups).fit(reml=True)
        except (np.linalg.LinAlgError, ValueError):
            return None
    effects = {
        name: (float(fit.fe_params[place]), float(fit.bse_fe[place]), float(fit.pvalues[place]))
        for place, name in enumerate(others, 1)
    }
    if not all(math.isfinite(number) for each in effects.values() for number in each):
        return None
    spread = math.sqrt(max(0.0, float(np.asarray(fit.cov_re).ravel()[0])))
    return MixedModel(effects, spread, math.sqrt(float(fit.scale)))


@dataclass(frozen=True)
class Correlation:
    """Pearson's r with Fisher's interval, and Spearman's rho; None where a variable does not vary."""

    count: int
    pearson: Interval
    spearman: float | None


def correlation(x: ArrayLike, y: ArrayLike) -> Correlation:
    """Return how two variables (n,) go together.

    The interval is Fisher's: tanh(atanh r +- z / sqrt(n - 3)). R. A. Fisher, Metron 1, 1921.
    """
    from scipy import stats
    from scipy.special import ndtri

    first, second = _finite(x, "x"), _finite(y, "y")
    count = len(first)
    if count != len(second):
        raise StudyError(f"{count} values against {len(second)}; a correlation needs pairs")
    if count < 3 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return Correlation(count, Interval(None, None, None), None)
    r = float(stats.pearsonr(first, second).statistic)
    rho = float(stats.spearmanr(first, second).statistic)
    if count < 4 or abs(r) >= 1:
        return Correlation(count, Interval(r, None, None), rho)
    width = float(ndtri((1 + CONFIDENCE) / 2)) / math.sqrt(count - 3)
    return Correlation(count, Interval(r, math.tanh(math.atanh(r) - width), math.tanh(math.atanh(r) + width)), rho)


HIDDEN_REFERENCE_LEAST = 90
HIDDEN_REFERENCE_MOST_MISSED = 0.15


def is_reliable(hidden_reference_ratings: ArrayLike) -> bool:
    """Return whether a participant of a MUSHRA study counts: the hidden reference below 90 in at most 15 % of trials.

    ITU-R BS.1534-3, post-screening of listeners.
    """
    ratings = _finite(hidden_reference_ratings, "ratings")
    return bool(not len(ratings) or np.mean(ratings < HIDDEN_REFERENCE_LEAST) <= HIDDEN_REFERENCE_MOST_MISSED)
