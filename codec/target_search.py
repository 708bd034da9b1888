"""Searches for the setting that meets a target SNR or bit rate."""

import bisect
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np

from vibrocast.codec.interface import CodecError, Setting, Signal, TargetUnreachable, number
from vibrocast.codec.source import Source, parts, peak_of
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
_STEPS_BETWEEN = 8
"""Steps from one rate point to the next, if the setting is a fraction."""
_GUIDED_TRIALS = 4
"""Trials that follow what is expected; then the search halves the steps that are left."""
_InExcerpt: TypeAlias = Callable[[Source], Callable[[Stream], float]]
_FEWEST_BITS = 1e-9
_Expected: TypeAlias = Callable[[float, Signal], float]
"""Returns the excess that an estimate of bits and errors leads to; see `codec.interface.Estimate`."""
_EXCERPT_SAMPLES = 1 << 15
"""In a long signal, a search begins in this many samples of each channel."""
_EXCERPT_RATE = math.log(1.02)
"""An excerpt takes 2 % more bits a sample than the whole, to which a codec adapts for longer: the median of signals."""


def channel_snrs_db(reference: Signal, decoded: Signal) -> list[float | None]:
    """Return the SNR in dB of each channel of two arrays (n, channels): 10 log10(sum x^2 / sum (x - y)^2).

    None if the reference is silent, infinity if both are equal.
    """
    if reference.shape != decoded.shape:
        raise ValueError(f"a reference of shape {reference.shape}, decoded {decoded.shape}")
    peaks = [peak_of(channel) for channel in reference.T]
    energy, noise = np.zeros(len(peaks)), np.zeros(len(peaks))
    scales = np.array([peak or 1.0 for peak in peaks])
    for part in parts(len(reference)):
        energy += np.sum(np.square(reference[part] / scales), axis=0)
        noise += np.sum(np.square((reference[part] - decoded[part]) / scales), axis=0)
    return [
        (10 * math.log10(signal / error) if error > 0 else math.inf) if peak > 0 else None
        for peak, signal, error in zip(peaks, energy.tolist(), noise.tolist(), strict=True)
    ]


def snr_db(reference: Signal, decoded: Signal) -> float | None:
    """Return the mean of `channel_snrs_db` over the channels that are not silent; None when every channel is silent."""
    ratios = [ratio for ratio in channel_snrs_db(reference, decoded) if ratio is not None]
    return _mean(ratios) if ratios else None


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
    if source.silent:
        return source.encode(_rate_points(source, setting)[0])
    heard = np.array([peak_of(channel) > 0 for channel in source.samples.T])
    powers = heard * np.square(source.format.rms)

    @cache  # decoding takes nearly half as long as coding
    def decoded_db(coded: Stream) -> list[float | None]:
        return channel_snrs_db(source.samples, coded.decode())

    def at_level(squared_errors: Sequence[float] | Signal, samples: int) -> list[float | None]:
        """Return the SNR of each channel by its error in some samples, at the level of the whole signal."""
        pairs = zip((samples * powers).tolist(), squared_errors, strict=True)
        return [10 * math.log10(energy / error) if energy > 0 and error > 0 else None for energy, error in pairs]

    def told_db(coded: Stream) -> list[float | None]:
        return at_level(coded.squared_errors or (), coded.samples)

    ratios_db: Callable[[Stream], list[float | None]] = decoded_db

    def excesses_db(coded: Stream) -> list[float]:
        """Return the excess of each channel over the target; 0 for silent ones, which have none."""
        return [0.0 if ratio is None else ratio - target_db for ratio in ratios_db(coded)]

    def in_excerpt(excerpt: Source) -> Callable[[Stream], float]:
        """Return the mean excess in an excerpt, which also shows whether the encoder is right: clipping misleads it."""

        def excess_db(coded: Stream) -> float:
            nonlocal ratios_db
            noise = (excerpt.samples - coded.decode()) / np.array(coded.header.gains)
            errors, told = np.sum(np.square(noise), axis=0), coded.squared_errors
            is_right = told is not None and np.allclose(errors[heard], np.array(told)[heard], _ERROR_TOLERANCE)
            ratios_db = told_db if is_right else decoded_db
            return _mean(at_level(errors, coded.samples)) - target_db

        return excess_db

    def expected_excess(bits: float, errors: Signal) -> float:
        return _mean(at_level(errors, 1)) - target_db

    if not setting and source.codec.step_range:
        found = _search(source, lambda coded: _mean(ratios_db(coded)) - target_db, _SNR, in_excerpt, expected_excess)
        best = _balance(source, found, excesses_db)
    elif _differs_by_channel(source, setting):
        best = _choose_for_each(source, setting, excesses_db)
    else:
        best = _choose(source, setting, lambda coded: min(excesses_db(coded)), _SNR, in_excerpt)
    least = excesses_db(best)
    if min(least) < -SNR_TOLERANCE_DB:
        raise TargetUnreachable(
            f"an SNR of {target_db:g} dB cannot be met; this signal reaches {target_db + min(least):.1f} dB "
            f"with {source.codec.name}: ask for less, or give another setting"
        )
    return best


def _mean(ratios_db: Sequence[float | None]) -> float:
    """Return the mean over the channels that are heard; infinity where none is."""
    heard = [ratio for ratio in ratios_db if ratio is not None]
    return sum(heard) / len(heard) if heard else math.inf


def _balance(source: Source, found: "_Found", excesses_db: Callable[[Stream], list[float]]) -> Stream:
    """Bring every channel to the target, by its own step or by one."""
    best, least = found.coded, excesses_db(found.coded)
    balanced = [_ChannelStep(found.step) for _ in least]
    excesses = least
    for trial in range(_BALANCING_TRIALS if len(least) > 1 else 0):
        if _imbalance(least) <= (False, SNR_TOLERANCE_DB / 2):
            break
        for channel, excess in zip(balanced, excesses, strict=True):
            if trial < _BALANCING_TRIALS // 2:
                channel.move(excess)
            elif excess < -SNR_TOLERANCE_DB:  # at the edge of a jump: leave it
                channel.step *= _STEP_BACK
            elif excess > SNR_TOLERANCE_DB:
                channel.step *= 2 ** (1 / _STEPS_PER_OCTAVE)
        coded = source.encode(_setting(source, tuple(channel.step for channel in balanced), found.rd_weight))
        excesses = excesses_db(coded)
        if _imbalance(excesses) < _imbalance(least):
            best, least = coded, excesses
    if len(least) > 1 and _imbalance(least) > (False, SNR_TOLERANCE_DB):
        # With steps of their own, channels that the codec mixes move each other away; one step may bring all near.
        excesses = excesses_db(found.coded)
        middle = found.exponent + round((max(excesses) + min(excesses)) / 2 / _DB_PER_OCTAVE * _STEPS_PER_OCTAVE)
        near = sorted(range(middle - _NEIGHBOURS, middle + _NEIGHBOURS + 1), key=lambda code: abs(code - middle))
        rd_weights = _RD_WEIGHTS[:3] if "rd_weight" in source.codec.parameters else _RD_WEIGHTS[:1]
        for rd_weight, exponent in itertools.product(rd_weights, near):
            coded = source.encode(_setting(source, _step_of(exponent), rd_weight))
            excesses = excesses_db(coded)
            if _imbalance(excesses) < _imbalance(least):
                best, least = coded, excesses
            if _imbalance(least) <= (False, SNR_TOLERANCE_DB):
                break
    return best


def _setting(source: Source, step: float | tuple[float, ...], rd_weight: float) -> Setting:
    """Return the setting of one step or of each channel's, with a weight of bits against error if there is one."""
    assert source.codec.step_parameter and source.codec.step_range, "its steps can be searched"
    weight = {"rd_weight": rd_weight} if "rd_weight" in source.codec.parameters else {}
    low, high = source.codec.step_range(source.format)
    within = tuple(min(max(each, low), high) for each in step) if isinstance(step, tuple) else step
    return {source.codec.step_parameter: within, **weight}


def _imbalance(excesses_db: list[float]) -> tuple[bool, float]:
    """Return the rank of a result, less is better: no channel below the tolerance, then the smallest excess."""
    return min(excesses_db) < -SNR_TOLERANCE_DB, max(map(abs, excesses_db))


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


def encode_to_rate(
    source: Source,
    bits_per_second: float,
    setting: Setting | None = None,
) -> Stream:
    """Code at up to `bits_per_second`, never above, and within 2 % below it if a setting comes as near.

    The rate counts the bits of the whole .vct file. All channels have the same setting. `setting`: the part of it that
    is given, not searched for. Raises CodecError as `encode`, TargetUnreachable with the least rate that the signal
    takes.
    """
    if not (math.isfinite(bits_per_second) and bits_per_second > 0):
        raise CodecError(f"a rate of {bits_per_second} bit/s cannot be met; ask for a positive number")

    def excess(coded: Stream) -> float:
        return math.log(coded.bits_per_second) - math.log(bits_per_second)

    def expected_excess(bits: float, errors: Signal) -> float:
        return math.log(max(bits, _FEWEST_BITS) * source.format.rate_hz / bits_per_second)

    def in_excerpt(excerpt: Source) -> Callable[[Stream], float]:
        return lambda coded: excess(coded) - _EXCERPT_RATE

    if not setting and source.codec.step_range:
        best = _search(source, excess, _RATE, in_excerpt, expected_excess).coded
    else:
        best = _choose(source, setting, excess, _RATE, in_excerpt)
    if _RATE.misses(excess(best)):
        raise TargetUnreachable(
            f"a rate of {bits_per_second:.0f} bit/s cannot be met; this signal takes at least "
            f"{best.bits_per_second:.0f} bit/s with {source.codec.name}: ask for more, code a longer signal, or choose "
            "another codec"
        )
    return best


def _differs_by_channel(source: Source, setting: Setting | None) -> bool:
    """Return whether there are several channels, and every parameter left to search may differ between them."""
    rate_point_set = next(iter(source.codec.rate_point_sets.values()))
    varied = {name for rate_point in rate_point_set for name in rate_point} - set(setting or {})
    return source.format.channels > 1 and all(source.codec.parameters[name].per_channel for name in varied)


def settings(source: Source, setting: Setting | None = None) -> list[Setting]:
    """Return the settings that a search for a quality tests, the coarsest first.

    They are the rate points of the codec's first set, and steps between them. `setting`: the part of the codec's
    setting that is given, not searched for. Raises CodecError.
    """
    return _steps_between(source, _rate_points(source, setting))[0]


def _rate_points(source: Source, setting: Setting | None) -> list[Setting]:
    """Return the rate points of the codec's first set, with the given part of a setting in place of theirs.

    Leaves out those that the model rejects. If it rejects all, returns all: the first one then raises the error.
    """
    rate_point_set = next(iter(source.codec.rate_point_sets.values()))
    rate_points: list[Setting] = []
    for rate_point in ({**rate_point, **source.codec.checked(setting or {})} for rate_point in rate_point_set):
        if rate_point not in rate_points:
            rate_points.append(rate_point)
    return [rate_point for rate_point in rate_points if source.takes(rate_point)] or rate_points


def _steps_between(source: Source, rate_points: list[Setting]) -> tuple[list[Setting], int]:
    """Return the rate points with settings between them, and the number of steps from one rate point to the next.

    There is nothing between them if a parameter that varies is no fraction.
    """
    parameters = source.codec.parameters
    varied = {name for low, high in itertools.pairwise(rate_points) for name in low if low[name] != high[name]}
    if not varied or not all(parameters[name].fractional for name in varied):
        return rate_points, 1
    finer: list[Setting] = []
    for low, high in itertools.pairwise(rate_points):
        for step in range(_STEPS_BETWEEN):
            part = step / _STEPS_BETWEEN
            between = {name: (1 - part) * number(low, name) + part * number(high, name) for name in varied}
            finer.append({**low, **between})
    return [*finer, rate_points[-1]], _STEPS_BETWEEN


def _choose(
    source: Source,
    setting: Setting | None,
    excess: Callable[[Stream], float],
    goal: "_Goal",
    in_excerpt: _InExcerpt,
) -> Stream:
    """Code where the excess changes its sign; at every rate point if no setting there is good enough.

    The excess rises on the whole from rate point to rate point. Returns the result that the goal prefers. In a long
    signal, an excerpt tells where that is, and whether the next setting may be better.
    """
    settings, steps = _steps_between(source, _rate_points(source, setting))
    excerpt = source.excerpt(_EXCERPT_SAMPLES)
    index, trials = _best_of(excerpt or source, settings, steps, in_excerpt(excerpt) if excerpt else excess, goal)
    if excerpt is None:
        return trials[index][0]
    tried: dict[int, tuple[Stream, float]] = {}
    while index in range(len(settings)) and index not in tried:
        coded = source.encode(settings[index])
        found = excess(coded)
        tried[index] = coded, found
        following = index + (1 if found < goal.low else -1)
        is_known = {index, following} <= trials.keys()
        if goal.meets(found) or (is_known and goal.suffices(found, trials[following][1] - trials[index][1])):
            break
        index = following
    return min(tried.values(), key=lambda each: goal.preference(each[1]))[0]


def _best_of(
    source: Source, settings: list[Setting], steps: int, excess: Callable[[Stream], float], goal: "_Goal"
) -> tuple[int, dict[int, tuple[Stream, float]]]:
    """Return the setting that the goal prefers near the change of sign, or among rate points, and what was coded."""
    tried: dict[int, tuple[Stream, float]] = {}

    def excess_at(index: int) -> float:
        if index not in tried:
            coded = source.encode(settings[index])
            tried[index] = coded, excess(coded)
        return tried[index][1]

    def preference(index: int) -> tuple[bool, float]:
        return goal.preference(excess_at(index))

    every = range(len(settings))
    crossing = bisect.bisect_left(every, 0.0, key=excess_at)
    best = min(every[max(0, crossing - _NEIGHBOURS) : crossing + _NEIGHBOURS], key=preference)
    if preference(best)[0]:
        best = min(every[::steps], key=preference)
    return best, tried


def _choose_for_each(source: Source, setting: Setting | None, excesses_db: Callable[[Stream], list[float]]) -> Stream:
    """Code each channel at the coarsest setting that brings it to the target.

    Finds it with all channels at the same setting first. Then makes it finer for a channel that falls short next to the
    others.
    """
    settings, _ = _steps_between(source, _rate_points(source, setting))
    varied = {name for name in settings[0] if settings[0][name] != settings[-1][name]}
    tried: dict[tuple[int, ...], tuple[Stream, list[float]]] = {}

    def attempt(indices: tuple[int, ...]) -> list[float]:
        if indices not in tried:
            each = {name: tuple(number(settings[index], name) for index in indices) for name in varied}
            coded = source.encode({**settings[0], **each})
            tried[indices] = coded, excesses_db(coded)
        return tried[indices][1]

    channels, last = source.format.channels, len(settings) - 1

    def enough(channel: int) -> int:
        indices = range(last)
        return bisect.bisect_left(indices, 0.0, key=lambda index: attempt((index,) * channels)[channel])

    chosen = tuple(map(enough, range(channels)))
    for _ in range(_BALANCING_TRIALS):
        excesses = attempt(chosen)
        if min(excesses) >= -SNR_TOLERANCE_DB:
            break
        short = [excess < -SNR_TOLERANCE_DB for excess in excesses]
        chosen = tuple(min(index + more, last) for index, more in zip(chosen, short, strict=True))
    attempt(chosen)
    return tried[chosen][0]


@dataclass(frozen=True)
class _Goal:
    """The excess over a target that meets it: from `low` to `high`.

    `ceiling`: an excess above `high` is on the wrong side; otherwise one below `low` is. The other side is second best.
    `per_octave`: by about how much the excess falls with an octave of steps. `doubt`: the part by which a difference of
    two excesses may be another in an excerpt.
    """

    low: float
    high: float
    ceiling: bool
    per_octave: float
    doubt: float

    def misses(self, excess: float) -> bool:
        """Return whether an excess lies on the wrong side."""
        return excess > self.high if self.ceiling else excess < self.low

    def meets(self, excess: float, part: float = 1.0) -> bool:
        """Return whether an excess meets the target, within a part of the tolerance."""
        return part * self.low <= excess <= part * self.high

    def preference(self, excess: float) -> tuple[bool, float]:
        """Return the rank of an excess, less is better: not on the wrong side, then the nearest to zero."""
        return self.misses(excess), abs(excess)

    def suffices(self, found: float, difference: float) -> bool:
        """Return whether an excess is good enough, and none that differs by about this can be preferred."""
        others = [found + part * difference for part in (1 - self.doubt, 1, 1 + self.doubt)]
        return not self.misses(found) and all(self.preference(found) <= self.preference(other) for other in others)


_SNR = _Goal(-SNR_TOLERANCE_DB, SNR_TOLERANCE_DB, ceiling=False, per_octave=5.0, doubt=1 / 8)
_RATE = _Goal(math.log1p(-RATE_TOLERANCE), 0.0, ceiling=True, per_octave=0.6, doubt=1 / 3)
"""A rate is never exceeded: the excess is the logarithm of rate over target."""


@dataclass(frozen=True)
class _Found:
    """The result of a search: the coded signal, its excess, the one expected, the step code and rd_weight."""

    coded: Stream
    excess: float
    expected: float
    exponent: int
    rd_weight: float

    @property
    def step(self) -> float:
        """The step of its code."""
        return _step_of(self.exponent)


def _step_of(code: int) -> float:
    """Return the step of a step code."""
    return float(2 ** (code / _STEPS_PER_OCTAVE))


def _search(
    source: Source,
    excess: Callable[[Stream], float],
    goal: _Goal,
    in_excerpt: _InExcerpt | None = None,
    expected: _Expected | None = None,
    rd_weights: Sequence[float] = _RD_WEIGHTS,
) -> _Found:
    """Find the step, the same for all channels, whose `excess` is nearest zero; on the whole it falls with the step.

    The codec must have a `step_range`. The result, which the goal prefers, lies on its wrong side only if every step
    does. `in_excerpt`: returns the excess in an excerpt; in a long signal the search begins there. `expected`: returns
    the excess of a codec's estimate. The search begins where it is zero, or errs as in an excerpt.
    """
    best: _Found | None = None
    step_range = source.codec.step_range
    assert step_range is not None, "its steps can be searched"
    finest, coarsest = (round(_STEPS_PER_OCTAVE * math.log2(limit)) for limit in step_range(source.format))
    excerpt = source.excerpt(_EXCERPT_SAMPLES) if in_excerpt is not None else None
    estimate = source.estimate() if expected is not None else None
    aim = _Aim(goal, None if expected is None or estimate is None else lambda code: expected(*estimate(_step_of(code))))
    guess = aim.first(finest, coarsest)
    if in_excerpt is not None and excerpt is not None:
        excess_in_excerpt = in_excerpt(excerpt)
        begun = _search(excerpt, excess_in_excerpt, goal, None, expected, _RD_WEIGHTS[:1])
        if guess is None:
            aim.fall = max(_fall(excerpt, begun, excess_in_excerpt), aim.fall / 4)
        guess = aim.next(begun.exponent, begun.excess + aim.expected(begun.exponent) - begun.expected, finest, coarsest)
    is_guided = guess is not None

    # Rounding for the best rate makes the excess jump, most of all for signals of few coefficients. If the sign changes
    # in a jump, the search tests other weights of bits against error: their jumps lie elsewhere.
    for rd_weight in rd_weights if "rd_weight" in source.codec.parameters else rd_weights[:1]:
        low, high = finest, coarsest
        above = below = math.nan  # excess next to the finest and the coarsest step that are left
        interpolates = False
        trials = 0
        guess = guess if best is None else best.exponent
        while low <= high:
            width = high - low
            exponent = (low + high) // 2
            if guess is not None:
                exponent = min(max(guess, low), high)
            elif interpolates:
                exponent = low + round(width * min(max(above / (above - below), 0.0), 1.0))
            coded = source.encode(_setting(source, _step_of(exponent), rd_weight))
            found = _Found(coded, excess(coded), aim.expected(exponent), exponent, rd_weight)
            if best is None or goal.preference(found.excess) < goal.preference(best.excess):
                best = found
            if goal.meets(best.excess, part=1.0 if is_guided else 0.5):
                return best
            if found.excess > 0:
                low, above = exponent + 1, found.excess
            else:
                high, below = exponent - 1, found.excess
            trials += 1
            # Interpolation converges fast, unless one end stays where it is, or the excess jumps: then halve.
            is_bracketed = math.isfinite(above - below)
            guess = None
            if is_guided and low <= high and trials <= _GUIDED_TRIALS and not (is_bracketed and trials > 1):
                guess = aim.next(exponent, found.excess, low, high)
            halved = 2 * (high - low) <= width
            interpolates = rd_weight == _RD_WEIGHTS[0] and halved and is_bracketed
        if best is not None and (goal.meets(best.excess) or goal.misses(best.excess)):
            break
    assert best is not None, "there is a step to try"
    return best


def _fall(source: Source, found: _Found, excess: Callable[[Stream], float]) -> float:
    """Return by how much the excess falls from one step code to the next, measured over half an octave."""
    codes = _STEPS_PER_OCTAVE // 2
    coarser = source.encode(_setting(source, _step_of(found.exponent + codes), found.rd_weight))
    return (found.excess - excess(coarser)) / codes


class _Aim:
    """Chooses step codes by the way that the excess falls with them: as expected, or evenly.

    `fall`: from one code to the next, where nothing else is expected.
    """

    def __init__(self, goal: _Goal, expected: Callable[[int], float] | None) -> None:
        self._middle = (goal.low + goal.high) / 2
        self._expected = expected
        self.fall = goal.per_octave / _STEPS_PER_OCTAVE

    def expected(self, code: int) -> float:
        """Return the excess that is expected at a code; 0 where nothing is."""
        return 0.0 if self._expected is None else self._expected(code)

    def first(self, low: int, high: int) -> int | None:
        """Return the code to begin with, from `low` to `high`; None where nothing is expected."""
        return None if self._expected is None else self._where(self._middle, low, high)

    def next(self, code: int, excess: float, low: int, high: int) -> int:
        """Return the code, from `low` to `high`, that should meet the goal, from the excess at another."""
        if self._expected is None or not math.isfinite(excess):
            return round(min(max(code + (excess - self._middle) / self.fall, low), high))
        return self._where(self.expected(code) - excess + self._middle, low, high)

    def _where(self, value: float, low: int, high: int) -> int:
        """Return the code where the expected excess, which falls, comes down to a value."""
        return low + bisect.bisect_left(range(low, high), -value, key=lambda code: -self.expected(code))
