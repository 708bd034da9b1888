"""Adaptive staircases: each proposes the level of the next trial from the answers so far, and estimates a threshold."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from vibrocast.study.statistics import Interval

LAPSE_RATE = 0.02
"""Part of the answers that have nothing to do with the stimulus. Wichmann and Hill, "The psychometric function I",
Perception & Psychophysics 63(8), 2001, find 0 to 5 %."""
GUESS_RATE = 0.5
"""Of two intervals, one of which is to be found."""
CREDIBLE = 0.95
_GRID = 81
_SLOPES_PER_DB = (0.05, 0.1, 0.2, 0.4)
"""Parts of the range of answers per dB at the threshold. Watson and Pelli 1983 take a Weibull function of slope 3.5,
which is 0.15 per dB."""
_ENOUGH_DB = 4.0
_MIN_TRIALS = 20


class TransformedUpDown:
    """Lowers the level after `down` correct answers in a row, and raises it after each wrong one.

    It converges where 0.5 ** (1 / down) of the answers are correct: 70.7 % for 2 down. H. Levitt, "Transformed up-down
    methods in psychoacoustics", JASA 49(2B), 1971, table I. `steps`: the next one from each reversal on; the last one
    stays.
    """

    def __init__(
        self, down: int, start: float, steps: Sequence[float], lowest: float, highest: float, reversals: int
    ) -> None:
        self._down, self._steps, self._lowest, self._highest = down, tuple(steps), lowest, highest
        self._wanted = reversals
        self._level, self._streak, self._direction = start, 0, 0
        self._turns: list[float] = []

    @property
    def target(self) -> float:
        """The part of correct answers at the level to which it converges."""
        return float(0.5 ** (1 / self._down))

    @property
    def reversals(self) -> int:
        """How often the direction has changed."""
        return len(self._turns)

    @property
    def done(self) -> bool:
        """Whether there are enough reversals."""
        return len(self._turns) >= self._wanted

    def level(self) -> float:
        """Return the level of the next trial."""
        return self._level

    def update(self, correct: bool) -> None:
        """Take in the answer to the trial at `level`."""
        self._streak = self._streak + 1 if correct else 0
        if correct and self._streak < self._down:
            return
        self._streak = 0
        direction = -1 if correct else 1
        if self._direction and direction != self._direction:
            self._turns.append(self._level)
        self._direction = direction
        step = self._steps[min(len(self._turns), len(self._steps) - 1)]
        self._level = min(self._highest, max(self._lowest, self._level + direction * step))

    def threshold(self) -> Interval:
        """Return the mean of the last reversals at the last step, an even number of them, and their t interval.

        The mean of peaks and valleys is Levitt's "mid-run estimate". The interval takes reversals as independent, and
        they are not. So it is too narrow: of simulated observers, 59 to 90 % have their threshold within.
        """
        from scipy import stats

        settled = self._turns[len(self._steps) - 1 :]
        settled = settled[len(settled) % 2 :]
        if len(settled) < 2:
            return Interval(None, None, None)
        mean, error = float(np.mean(settled)), float(stats.sem(settled))
        width = error * float(stats.t.ppf((1 + CREDIBLE) / 2, len(settled) - 1))
        return Interval(mean, mean - width, mean + width)


class Bayesian:
    """Proposes the level whose answer is expected to tell most, from a posterior over threshold and slope.

    The psychometric function is logistic in dB, between GUESS_RATE and 1 - LAPSE_RATE; its threshold is where half of
    that range is reached. A. B. Watson and D. G. Pelli, "QUEST", Perception & Psychophysics 33(2), 1983; the level of
    least expected entropy: L. L. Kontsevich and C. W. Tyler, "Bayesian adaptive estimation of psychometric slope and
    threshold", Vision Research 39, 1999, and A. B. Watson, "QUEST+", Journal of Vision 17(3):10, 2017. The prior is
    uniform over thresholds from `lowest` to `highest` and over _SLOPES_PER_DB. It ends after `max_trials`, or once the
    credible interval spans at most `enough_db`.
    """

    def __init__(self, lowest: float, highest: float, max_trials: int, enough_db: float = _ENOUGH_DB) -> None:
        self._levels = np.linspace(lowest, highest, _GRID)
        self._max_trials, self._enough_db = max_trials, enough_db
        slopes = np.array(_SLOPES_PER_DB)
        # (levels, thresholds, slopes): probability of a correct answer.
        distance = self._levels[:, None, None] - self._levels[None, :, None]
        rising = 1 / (1 + np.exp(-4 * slopes * distance))
        self._correct = GUESS_RATE + (1 - GUESS_RATE - LAPSE_RATE) * rising
        self._posterior = np.full((_GRID, len(slopes)), 1 / (_GRID * len(slopes)))
        self._next: int | None = None  # place of the next level, once it is computed
        self._answers = 0
        self._last: bool | None = None
        self.reversals = 0
        """How often a correct answer followed a wrong one, or the other way round."""

    @property
    def done(self) -> bool:
        """Whether the credible interval is narrow enough, or the trials are used up."""
        if self._answers >= self._max_trials:
            return True
        estimate = self.threshold()
        if self._answers < _MIN_TRIALS or estimate.low is None or estimate.high is None:
            return False
        return estimate.high - estimate.low <= self._enough_db

    def level(self) -> float:
        """Return the level of the next trial: that of the least expected entropy of the posterior."""
        return float(self._levels[self._most_informative()])

    @property
    def target(self) -> float:
        """The part of correct answers at the threshold."""
        return GUESS_RATE + (1 - GUESS_RATE - LAPSE_RATE) / 2

    def _most_informative(self) -> int:
        if self._next is not None:
            return self._next
        joint = self._correct * self._posterior
        right = joint.sum(axis=(1, 2))
        wrong = 1 - right
        entropy = right * _entropy(joint / right[:, None, None])
        entropy += wrong * _entropy((self._posterior - joint) / wrong[:, None, None])
        self._next = int(np.argmin(entropy))
        return self._next

    def update(self, correct: bool) -> None:
        """Take in the answer to the trial at `level`."""
        likelihood = self._correct[self._most_informative()]
        posterior = self._posterior * (likelihood if correct else 1 - likelihood)
        self._posterior = posterior / posterior.sum()
        self._next = None
        self._answers += 1
        self.reversals += int(self._last is not None and correct != self._last)
        self._last = correct

    def threshold(self) -> Interval:
        """Return the mean of the posterior and its credible interval."""
        weights = self._posterior.sum(axis=1)
        cumulative = np.cumsum(weights)
        low, high = np.searchsorted(cumulative, [(1 - CREDIBLE) / 2, (1 + CREDIBLE) / 2])
        low, high = (int(min(each, _GRID - 1)) for each in (low, high))
        return Interval(float(weights @ self._levels), float(self._levels[low]), float(self._levels[high]))


Staircase: TypeAlias = TransformedUpDown | Bayesian


def _entropy(posteriors: np.ndarray) -> np.ndarray:
    """Return the entropy in nat of each distribution (levels, thresholds, slopes)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(posteriors > 0, posteriors * np.log(posteriors), 0.0)
    return np.asarray(-terms.sum(axis=(1, 2)))
