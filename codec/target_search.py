"""Searches for the setting that meets a target SNR or bit rate."""

import bisect
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vibrocast.codec.interface import CodecError, Setting, Signal, TargetUnreachable
from vibrocast.codec.source import Source
from vibrocast.codec.stream import Stream

SNR_TOLERANCE_DB = 0.2
RATE_TOLERANCE = 0.02
_ERROR_TOLERANCE = 0.01
"""If the error in an excerpt differs from what the encoder tells by more, the search decodes each trial instead."""
_STEPS_PER_OCTAVE = 64
_DB_PER_OCTAVE = 20 * math.log10(2)
_RD_WEIGHTS = (1.0, 0.9, 0.8, 0.65, 0.5, 0.3, 0.0)
_BALANCING_TRIALS = 20
_STEP_BACK = 0.9
_NEIGHBOURS = 3
"""Settings tested on each side of the place where the excess changes its sign, because quality may fall on the way up.
"""
_GUIDED_TRIALS = 4
"""Trials that follow what is expected; then the search halves the steps that are left."""
_FEWEST_BITS = 1e-9
_EXCERPT_SAMPLES = 1 << 15
"""In a long signal, a search begins in this many samples of each channel."""
_EXCERPT_RATE = math.log(1.02)
"""An excerpt takes 2 % more bits a sample than the whole, to which a codec adapts for longer: the median of signals."""


class _Target(ABC):
    """A target of a search. The excess of a coded signal over it falls, on the whole, from fine settings to coarse.

    `low`, `high`: the excess that meets the target. `is_ceiling`: whether one above is on the wrong side; else one
    below is. `fall`: of the excess from one octave of steps to the next, about.
    """

    low: float
    high: float
    is_ceiling: bool
    fall: float

    @abstractmethod
    def excesses(self, source: Source, coded: Stream) -> list[float]:
        """Return the excess of each channel that counts. `source`: what was coded, the whole signal or an excerpt."""

    @abstractmethod
    def expected(self, bits: float, errors: Signal) -> float:
        """Return the mean excess that an estimate leads to; see `codec.interface.Estimate`."""

    def misses(self, excess: float) -> bool:
        """Return whether an excess lies on the wrong side of the target."""
        return excess > self.high if self.is_ceiling else excess < self.low

    def meets(self, excess: float, part: float = 1.0) -> bool:
        """Return whether an excess meets the target, within a part of the tolerance."""
        return part * self.low <= excess <= part * self.high

    def preference(self, excess: float) -> tuple[bool, float]:
        """Return the rank of an excess, less is better: not on the wrong side, then the nearest to zero."""
        return self.misses(excess), abs(excess)


class _SnrTarget(_Target):
    """An SNR in dB of every channel that is not silent."""

    low, high, is_ceiling = -SNR_TOLERANCE_DB, SNR_TOLERANCE_DB, False
    fall = 5.0

    def __init__(self, source: Source, target_db: float) -> None:
        self._whole, self._heard, self._target_db = source, source.heard, target_db
        self._powers: Signal = np.square(source.format.rms)[source.heard]
        self._told = False
        """Whether the errors are those that the encoder tells."""

    def excesses(self, source: Source, coded: Stream) -> list[float]:
        told = None if coded.squared_errors is None else np.array(coded.squared_errors)
        if told is not None and self._told and source is self._whole:
            return self._over(told / len(source.samples))
        errors = source.squared_errors(coded)
        if source is not self._whole:  # an excerpt shows whether the encoder is right: clipping misleads it
            self._told = told is not None and np.allclose(errors[self._heard], told[self._heard], _ERROR_TOLERANCE)
        return self._over(errors / len(source.samples))

    def expected(self, bits: float, errors: Signal) -> float:
        return _mean(self._over(errors))

    def _over(self, errors: Signal) -> list[float]:
        """Return the excess of the channels that are heard, by the mean squared error of each in full scales."""
        with np.errstate(divide="ignore"):
            ratios_db = 10 * np.log10(self._powers / errors[self._heard])
        return list(map(float, ratios_db - self._target_db))


class _RateTarget(_Target):
    """A rate of the whole file, which is never exceeded: the excess is the logarithm of rate over target."""

    low, high, is_ceiling = math.log1p(-RATE_TOLERANCE), 0.0, True
    fall = 0.6

    def __init__(self, source: Source, bits_per_second: float) -> None:
        self._whole, self._bits_per_second = source, bits_per_second

    def excesses(self, source: Source, coded: Stream) -> list[float]:
        excess = math.log(coded.bits_per_second / self._bits_per_second)
        return [excess if source is self._whole else excess - _EXCERPT_RATE]

    def expected(self, bits: float, errors: Signal) -> float:
        return math.log(max(bits, _FEWEST_BITS) * self._whole.format.rate_hz / self._bits_per_second)


@dataclass(frozen=True)
class _Trial:
    """A signal coded at one place of a search: a step code, or a number among settings.

    `excesses`: as from `_Target`. `surprise`: by how much their mean lies above what was expected.
    """

    coded: Stream
    place: int
    excesses: Sequence[float]
    rd_weight: float | None = None
    surprise: float = 0.0

    @property
    def mean(self) -> float:
        """The mean excess over the channels."""
        return _mean(self.excesses)

    @property
    def least(self) -> float:
        """The excess of the channel that has the least."""
        return min(self.excesses)

    @property
    def imbalance(self) -> tuple[bool, float]:
        """The rank among balanced channels, less is better: none below the tolerance, then the smallest excess."""
        return self.least < -SNR_TOLERANCE_DB, max(map(abs, self.excesses))


def _mean(excesses: Sequence[float]) -> float:
    """Return the mean without copies that are exact; infinity if all are."""
    finite = [excess for excess in excesses if math.isfinite(excess)]
    return sum(finite) / len(finite) if finite else math.inf


def encode_to_snr(source: Source, target_db: float, setting: Setting | None = None) -> Stream:
    """Code every channel at `target_db` of SNR, to within 0.2 dB; above it if no setting comes nearer.

    `setting`: the part of the codec's setting that is given, not searched for. A silent signal meets every target.
    Raises CodecError as `encode`, TargetUnreachable with the best SNR that this signal reaches.
    """
    if not math.isfinite(target_db):
        raise CodecError(f"an SNR of {target_db} dB cannot be met; ask for a finite number")
    if not source.codec.keeps_waveform:
        raise TargetUnreachable(
            f"an SNR of {target_db:g} dB cannot be met, because {source.codec.name} keeps no waveform; ask for a "
            "rate, or choose another codec"
        )
    if not source.heard:
        return source.encode(source.rate_points(setting or {})[0])
    target = _SnrTarget(source, target_db)
    best = _search(source, target, setting or {})
    if target.misses(best.least):
        raise TargetUnreachable(
            f"an SNR of {target_db:g} dB cannot be met; this signal reaches {target_db + best.least:.1f} dB "
            f"with {source.codec.name}: ask for less, or give another setting"
        )
    return best.coded


def encode_to_rate(source: Source, bits_per_second: float, setting: Setting | None = None) -> Stream:
    """Code at up to `bits_per_second`, never above, and within 2 % below it if a setting comes as near.

    The rate counts the bits of the whole .vct file. All channels have the same setting. `setting`: the part of it that
    is given, not searched for. Raises CodecError as `encode`, TargetUnreachable with the least rate that the signal
    takes.
    """
    if not (math.isfinite(bits_per_second) and bits_per_second > 0):
        raise CodecError(f"a rate of {bits_per_second} bit/s cannot be met; ask for a positive number")
    target = _RateTarget(source, bits_per_second)
    best = _search(source, target, setting or {})
    if target.misses(best.least):
        raise TargetUnreachable(
            f"a rate of {bits_per_second:.0f} bit/s cannot be met; this signal takes at least "
            f"{best.coded.bits_per_second:.0f} bit/s with {source.codec.name}: ask for more, code a longer signal, or "
            "choose another codec"
        )
    return best.coded


def _search(source: Source, target: _Target, setting: Setting) -> _Trial:
    """Return the trial that a target prefers, over the quantiser's steps or, if there are none, over rate points."""
    if source.codec.steps is not None and source.codec.steps.parameter not in setting:
        search = _StepSearch(source, target, source.codec.checked(setting))
        found = search.found()
        return search.balanced(found) if isinstance(target, _SnrTarget) and source.format.channels > 1 else found
    return _search_settings(source, target, setting)


class _StepSearch:
    """A search for the step of the quantiser: the same for all channels, then for each its own.

    A place is a step code, _STEPS_PER_OCTAVE to an octave. `given`: the part of the setting that is not searched for.
    """

    def __init__(self, source: Source, target: _Target, given: Setting) -> None:
        codec = source.codec
        assert codec.steps is not None, "its steps can be searched"
        self._source, self._target, self._given, self._name = source, target, given, codec.steps.parameter
        self._range = codec.steps.range(source.format)
        self._places = tuple(round(_STEPS_PER_OCTAVE * math.log2(limit)) for limit in self._range)
        searches_weight = "rd_weight" in codec.parameters and "rd_weight" not in given
        self._rd_weights: Sequence[float | None] = _RD_WEIGHTS if searches_weight else (None,)
        self._estimate = source.estimate(given)
        self._excerpt = source.excerpt(_EXCERPT_SAMPLES)

    def found(self, rd_weights: Sequence[float | None] | None = None) -> _Trial:
        """Return the trial, all channels at one step, whose mean excess is nearest zero.

        It lies on the wrong side only if every step does. The search begins where the codec's estimate meets the
        target; in a long signal, where that errs as it does in an excerpt.
        """
        guess = None
        if self._excerpt is not None:
            search = _StepSearch(self._excerpt, self._target, self._given)
            guess = self._proposal(search.found(self._rd_weights[:1]).surprise)
        elif self._estimate is not None:
            guess = self._proposal(0.0)
        best: _Trial | None = None
        # Rounding for the best rate makes the excess jump, most of all for signals of few coefficients. If the sign
        # changes in a jump, the search tests other weights of bits against error: their jumps lie elsewhere.
        for rd_weight in rd_weights or self._rd_weights:
            best = self._nearest(rd_weight, best.place if best else guess, guess is not None, best)
            if self._target.meets(best.mean) or self._target.misses(best.mean):
                break
        assert best is not None, "there is a weight to try"
        return best

    def _nearest(self, rd_weight: float | None, guess: int | None, is_guided: bool, best: _Trial | None) -> _Trial:
        """Return the best of an earlier trial and those at one weight, which end where one meets the target."""
        low, high = self._places
        above = below = math.nan  # excess next to the finest and the coarsest step that are left
        interpolates = False
        trials = 0
        while True:
            width = high - low
            place = (low + high) // 2
            if guess is not None:
                place = min(max(guess, low), high)
            elif interpolates:
                place = low + round(width * min(max(above / (above - below), 0.0), 1.0))
            trial = self._attempt(place, rd_weight)
            if best is None or self._target.preference(trial.mean) < self._target.preference(best.mean):
                best = trial
            if trial.mean > 0:
                low, above = place + 1, trial.mean
            else:
                high, below = place - 1, trial.mean
            if low > high or self._target.meets(best.mean, 1.0 if is_guided else 0.5):
                return best
            # Interpolation converges fast, unless one end stays where it is, or the excess jumps: then halve.
            trials += 1
            is_bracketed = math.isfinite(above - below)
            interpolates = rd_weight in (None, _RD_WEIGHTS[0]) and 2 * (high - low) <= width and is_bracketed
            follows = is_guided and trials <= _GUIDED_TRIALS and not (is_bracketed and trials > 1)
            guess = self._proposal(trial.surprise) if follows else None

    def _expected(self, place: int) -> float:
        """Return the mean excess that is expected at a step: by the codec's estimate or, without one, an even fall."""
        if self._estimate is None:
            return -self._target.fall * place / _STEPS_PER_OCTAVE
        return self._target.expected(*self._estimate(_step_of(place)))

    def _proposal(self, surprise: float) -> int:
        """Return the place whose expected excess, with a surprise added, meets the target."""
        low, high = self._places
        wanted = (self._target.low + self._target.high) / 2 - surprise
        return low + bisect.bisect_left(range(low, high), -wanted, key=lambda place: -self._expected(place))

    def _attempt(self, place: int, rd_weight: float | None, steps: tuple[float, ...] | None = None) -> _Trial:
        """Code at a place or, if they are given, at the steps of each channel."""
        step = _step_of(place) if steps is None else tuple(np.clip(steps, *self._range).tolist())
        weight = {} if rd_weight is None else {"rd_weight": rd_weight}
        coded = self._source.encode({**self._given, self._name: step, **weight})
        excesses = self._target.excesses(self._source, coded)
        return _Trial(coded, place, excesses, rd_weight, _mean(excesses) - self._expected(place))

    def balanced(self, found: _Trial) -> _Trial:
        """Bring every channel to the target, by its own step or by one; `found`: the result with one step for all."""
        best = last = found
        own = [_ChannelStep(_step_of(found.place)) for _ in self._source.format.gains]
        for trial in range(_BALANCING_TRIALS):
            if best.imbalance <= (False, SNR_TOLERANCE_DB / 2):
                return best
            for channel, excess in zip(self._source.heard, last.excesses, strict=True):
                if trial < _BALANCING_TRIALS // 2:
                    own[channel].move(excess)
                elif excess < -SNR_TOLERANCE_DB:  # at the edge of a jump: leave it
                    own[channel].step *= _STEP_BACK
                elif excess > SNR_TOLERANCE_DB:
                    own[channel].step *= _step_of(1)
            last = self._attempt(found.place, found.rd_weight, tuple(each.step for each in own))
            best = min(best, last, key=lambda each: each.imbalance)
        # With steps of their own, channels that the codec mixes move each other away; one step may bring all near.
        octaves = (max(found.excesses) + found.least) / 2 / _DB_PER_OCTAVE
        middle = found.place + round(octaves * _STEPS_PER_OCTAVE)
        near = sorted(range(middle - _NEIGHBOURS, middle + _NEIGHBOURS + 1), key=lambda place: abs(place - middle))
        for rd_weight, place in itertools.product(self._rd_weights[:3], near):
            if best.imbalance <= (False, SNR_TOLERANCE_DB):
                break
            best = min(best, self._attempt(place, rd_weight), key=lambda each: each.imbalance)
        return best


@dataclass
class _ChannelStep:
    """The step of one channel, if each has its own: it lies between a step that is enough and one too coarse."""

    step: float
    enough: float = 0.0
    too_coarse: float = math.inf

    def move(self, excess_db: float) -> None:
        """Choose the next step to test, from the channel's excess over its target at this one: 6 dB an octave."""
        if excess_db >= 0:
            self.enough = max(self.enough, self.step)
        else:
            self.too_coarse = min(self.too_coarse, self.step)
        if self.enough >= self.too_coarse:  # the other channels have moved the limit: find it again
            self.enough, self.too_coarse = 0.0, math.inf
        if abs(excess_db) <= SNR_TOLERANCE_DB / 2:
            return
        target = self.step * 2 ** (excess_db / _DB_PER_OCTAVE)
        if not self.enough < target < self.too_coarse:
            bracketed = self.enough > 0 and math.isfinite(self.too_coarse)
            target = math.sqrt(self.enough * self.too_coarse) if bracketed else self.step / 2
        self.step = target


def _step_of(place: int) -> float:
    return float(2 ** (place / _STEPS_PER_OCTAVE))


class _Trials(dict[int, _Trial]):
    """A signal coded at each of several settings, when it is asked for."""

    def __init__(self, source: Source, target: _Target, every: list[Setting]) -> None:
        super().__init__()
        self._source, self._target, self._every = source, target, every

    def __missing__(self, place: int) -> _Trial:
        coded = self._source.encode(self._every[place])
        self[place] = _Trial(coded, place, self._target.excesses(self._source, coded))
        return self[place]

    def preferred(self, places: Iterable[int]) -> int:
        """Return the place that the target prefers."""
        return min(places, key=lambda place: self._target.preference(self[place].least))


def _search_settings(source: Source, target: _Target, given: Setting) -> _Trial:
    """Return the trial that a target prefers next to where the excess, which rises on the whole, changes its sign.

    If none there is good enough, among all rate points. In a long signal, an excerpt tells where that is, and whether
    the next setting may be better.
    """
    every = source.settings(given)
    excerpt = source.excerpt(_EXCERPT_SAMPLES)
    trials, places = _Trials(excerpt or source, target, every), range(len(every))
    crossing = bisect.bisect_left(places, 0.0, key=lambda place: trials[place].least)
    best = trials.preferred(places[max(0, crossing - _NEIGHBOURS) : crossing + _NEIGHBOURS])
    if target.misses(trials[best].least):
        best = trials.preferred(map(every.index, source.rate_points(given)))
    if excerpt is None:
        return trials[best]
    whole, place = _Trials(source, target, every), best
    while place in places and place not in whole and not target.meets(excess := whole[place].least):
        following = place + (1 if excess < target.low else -1)
        if {place, following} <= trials.keys():
            expected = excess + trials[following].least - trials[place].least
            if target.preference(excess) <= target.preference(expected):
                break
        place = following
    return whole[whole.preferred(tuple(whole))]
