"""Staircases: rules, and how well they find the known thresholds of simulated answers."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from vibrocast.study.staircases import LAPSE_RATE, Bayesian, Staircase, TransformedUpDown
from vibrocast.study.statistics import Interval

LOWEST_DB, HIGHEST_DB = -60.0, 0.0


def up_down(down: int = 2, reversals: int = 12) -> TransformedUpDown:
    return TransformedUpDown(down, 0.0, (8.0, 4.0, 2.0), LOWEST_DB, HIGHEST_DB, reversals)


def bayesian(enough_db: float = 0.0) -> Bayesian:
    return Bayesian(LOWEST_DB, HIGHEST_DB, 80, enough_db)


def run(staircase: Staircase, middle_db: float, slope_per_db: float, seed: int) -> tuple[Interval, float, int]:
    """Let an observer with a logistic psychometric function answer.

    Returns the estimate, the level at which the observer reaches the staircase's target, and the number of trials.
    """
    random = np.random.default_rng(seed)
    trials = 0
    while not staircase.done and trials < 300:
        rising = 1 / (1 + math.exp(-4 * slope_per_db * (staircase.level() - middle_db)))
        staircase.update(bool(random.random() < 0.5 + (0.5 - LAPSE_RATE) * rising))
        trials += 1
    part = (staircase.target - 0.5) / (0.5 - LAPSE_RATE)
    return staircase.threshold(), middle_db + math.log(part / (1 - part)) / (4 * slope_per_db), trials


def errors(make: Callable[[], Staircase], slope_per_db: float, runs: int) -> tuple[list[float], float]:
    """Return the errors of thresholds in dB, and which part of the intervals holds the threshold."""
    found, held = [], 0
    for number in range(runs):
        estimate, threshold_db, _ = run(make(), -45 + 30 * number / runs, slope_per_db, number)
        assert estimate.value is not None and estimate.low is not None and estimate.high is not None
        found.append(estimate.value - threshold_db)
        held += estimate.low <= threshold_db <= estimate.high
    return found, held / runs


@pytest.mark.parametrize(("down", "target"), [(1, 0.5), (2, 0.707), (3, 0.794), (4, 0.841)])
def test_targets_are_those_of_levitt(down: int, target: float) -> None:
    # Levitt 1971, table I.
    assert up_down(down).target == pytest.approx(target, abs=5e-4)


def test_two_down_one_up_follows_its_rule() -> None:
    staircase = TransformedUpDown(2, 0.0, (4.0, 2.0), -20.0, 0.0, reversals=4)
    levels = []
    for correct in (True, True, True, True, False, True, True, False, True, True):
        levels.append(staircase.level())
        staircase.update(correct)
    # Down by 4 dB after two right answers; from the first reversal on by 2 dB.
    assert levels == [0, 0, -4, -4, -8, -6, -6, -8, -6, -6]
    assert staircase.reversals == 4 and staircase.done
    # The reversals at the last step are -6, -8, -6; an even number of them, the last ones, counts.
    assert staircase.threshold().value == -7


@pytest.mark.parametrize("down", [2, 3])
@pytest.mark.parametrize("slope_per_db", [0.15, 0.3])
def test_transformed_up_down_finds_the_level_of_its_target(down: int, slope_per_db: float) -> None:
    found, _ = errors(lambda: up_down(down), slope_per_db, 80)
    assert abs(np.mean(found)) < 1.0
    assert np.std(found) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("slope_per_db", [0.07, 0.3])
def test_bayesian_staircase_finds_thresholds_and_knows_how_well(slope_per_db: float) -> None:
    found, held = errors(bayesian, slope_per_db, 75)
    assert abs(np.mean(found)) < 0.8
    assert np.std(found) < 2.0
    assert held >= 0.85  # of 400 runs, 93 to 98 %


def test_bayesian_staircase_moves_towards_the_threshold_and_ends_once_its_interval_is_narrow() -> None:
    staircase = bayesian()
    first_db = staircase.level()
    staircase.update(True)
    assert staircase.level() < first_db
    for _ in range(6):
        staircase.update(False)
    assert staircase.level() > first_db
    assert staircase.reversals == 1
    estimate, _, trials = run(bayesian(enough_db=6.0), -30, 0.3, 1)
    assert estimate.low is not None and estimate.high is not None
    assert trials < 80 and estimate.high - estimate.low <= 6.0


@pytest.mark.parametrize("make", [up_down, bayesian])
@pytest.mark.parametrize("correct", [True, False])
def test_answers_that_are_all_the_same_do_no_harm(make: Callable[[], Staircase], correct: bool) -> None:
    staircase = make()
    for _ in range(80):
        assert LOWEST_DB <= staircase.level() <= HIGHEST_DB
        staircase.update(correct)
    assert staircase.reversals == 0
    value = staircase.threshold().value
    if isinstance(staircase, Bayesian):
        assert value is not None and abs(value - (LOWEST_DB if correct else HIGHEST_DB)) < 10
    else:
        assert value is None
