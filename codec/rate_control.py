"""Coding to an asked quality or rate: searches for the quantiser steps that meet an SNR or a bit rate."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from codec import mdct
from codec.coding import LARGEST_STEP, SMALLEST_STEP, Progress, Source, decode, parts, peak_of
from codec.interface import CodecError, CodedSignal, Signal

SNR_TOLERANCE_DB = 0.2
RATE_TOLERANCE = 0.02
_STEPS_PER_OCTAVE = 64
_DB_PER_OCTAVE = 20 * math.log10(2)
_THRIFTS = (1.0, 0.9, 0.8, 0.65, 0.5, 0.3, 0.0)
_BALANCING_TRIALS = 20
_STEP_BACK = 0.9


def channel_snrs_db(reference: Signal, decoded: Signal) -> list[float | None]:
    """Signal-to-noise ratio in dB of each channel of two arrays (n, channels): 10 log10(sum x^2 / sum (x - y)^2).

    None where the reference is silent, infinity where both are equal.
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
        for peak, signal, error in zip(peaks, energy, noise, strict=True)
    ]


def snr_db(reference: Signal, decoded: Signal) -> float | None:
    """Return the mean of `channel_snrs_db` over the channels that are not silent; None when every channel is silent."""
    ratios = [ratio for ratio in channel_snrs_db(reference, decoded) if ratio is not None]
    return sum(ratios) / len(ratios) if ratios else None


def encode_to_snr(
    samples: Signal,
    rate_hz: int,
    target_db: float,
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
    progress: Progress | None = None,
) -> CodedSignal:
    """Code every channel at `target_db` of SNR, to within 0.2 dB; above it where no step comes nearer.

    Raises CodecError as `encode`, and when `target_db` is out of reach, with the best that there is. A silent signal
    meets every target.
    """
    if not math.isfinite(target_db):
        raise CodecError(f"an SNR of {target_db} dB cannot be met; ask for a finite number")
    source = Source(samples, rate_hz, codec, live, tables, progress)
    channels = len(source.gains)
    if source.silent:
        return source.encode([1.0] * channels)

    def excesses_db(coded: CodedSignal) -> list[float]:
        """Excess of each channel over the target; 0 for silent ones, which have none."""
        ratios = channel_snrs_db(source.samples, decode(coded, tables))
        return [0.0 if ratio is None else ratio - target_db for ratio in ratios]

    def mean_excess(coded: CodedSignal) -> float:
        ratio = snr_db(source.samples, decode(coded, tables))
        return math.inf if ratio is None else ratio - target_db

    found = _search(source, mean_excess, SNR_TOLERANCE_DB, side=1)
    best, least = found.coded, excesses_db(found.coded)
    balanced = [_ChannelStep(found.step) for _ in least]
    excesses = least
    for trial in range(_BALANCING_TRIALS if channels > 1 else 0):
        if _imbalance(least) <= (False, SNR_TOLERANCE_DB / 2):
            break
        for channel, excess in zip(balanced, excesses, strict=True):
            if trial < _BALANCING_TRIALS // 2:
                channel.move(excess)
            elif excess < -SNR_TOLERANCE_DB:  # at the edge of a jump: leave it
                channel.step *= _STEP_BACK
        coded = source.encode([channel.step for channel in balanced], found.thrift)
        excesses = excesses_db(coded)
        if _imbalance(excesses) < _imbalance(least):
            best, least = coded, excesses
    if min(least) < -SNR_TOLERANCE_DB:
        raise CodecError(
            f"an SNR of {target_db:g} dB cannot be met; this signal reaches {target_db + min(least):.1f} dB "
            "(16-bit samples set the limit)"
        )
    return best


def _imbalance(excesses_db: list[float]) -> tuple[bool, float]:
    """Order by which the steps of channels are chosen: none below the tolerance first, then the smallest excess."""
    return min(excesses_db) < -SNR_TOLERANCE_DB, max(map(abs, excesses_db))


@dataclass
class _ChannelStep:
    """The step of one channel among several that each need their own: between what is enough and what is too coarse."""

    step: float
    enough: float = 0.0
    too_coarse: float = math.inf

    def move(self, excess_db: float) -> None:
        """Choose the next step to try, from the channel's excess over its target at this one: 6 dB an octave."""
        if excess_db >= 0:
            self.enough = max(self.enough, self.step)
        else:
            self.too_coarse = min(self.too_coarse, self.step)
        if self.enough >= self.too_coarse:  # the other channels have moved the limit: find it again
            self.enough, self.too_coarse = 0.0, math.inf
        if abs(excess_db) <= SNR_TOLERANCE_DB / 2:
            return
        wanted = self.step * 2 ** (excess_db / _DB_PER_OCTAVE)
        if not self.enough < wanted < self.too_coarse:
            bracketed = self.enough > 0 and math.isfinite(self.too_coarse)
            wanted = math.sqrt(self.enough * self.too_coarse) if bracketed else self.step / 2
        self.step = wanted


def encode_to_rate(
    samples: Signal,
    rate_hz: int,
    bits_per_second: float,
    size_bytes: Callable[[CodedSignal], int],
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
    progress: Progress | None = None,
) -> CodedSignal:
    """Code at `bits_per_second`, to within 2 %; below it where no step comes nearer.

    `size_bytes` counts a coded signal's bytes. All channels have the same step relative to their RMS values. Raises
    CodecError as `encode`, and when `bits_per_second` is below the least that the signal takes, with that rate.
    """
    if not (math.isfinite(bits_per_second) and bits_per_second > 0):
        raise CodecError(f"a rate of {bits_per_second} bit/s cannot be met; ask for a positive number")
    source = Source(samples, rate_hz, codec, live, tables, progress)

    def rate(coded: CodedSignal) -> float:
        return size_bytes(coded) * 8 * rate_hz / coded.samples

    def excess(coded: CodedSignal) -> float:
        return math.log(rate(coded)) - math.log(bits_per_second)

    found = _search(source, excess, math.log1p(RATE_TOLERANCE), side=-1)
    if found.excess > math.log1p(RATE_TOLERANCE):
        raise CodecError(
            f"a rate of {bits_per_second:.0f} bit/s cannot be met; this signal takes at least "
            f"{rate(found.coded):.0f} bit/s, most of it headers: ask for more, or code a longer signal"
        )
    return found.coded


@dataclass(frozen=True)
class _Found:
    """What a search found: the coded signal, its excess, and the step and thrift that made it."""

    coded: CodedSignal
    excess: float
    step: float
    thrift: float


def _search(source: Source, excess: Callable[[CodedSignal], float], tolerance: float, side: int) -> _Found:
    """Find the step, the same for all channels, whose `excess` is nearest zero; on the whole it falls with the step.

    `side`: +1 when an excess above the tolerance is better than none, -1 when one below is. What is found lies beyond
    the tolerance on the other side only where every step does.
    """
    best: _Found | None = None

    def preference(found: _Found) -> tuple[bool, float]:
        return side * found.excess < -tolerance, abs(found.excess)

    # Rounding for the best rate makes the excess jump, most of all in signals of few coefficients, and the sign may
    # change in a jump: then other weights of bits against error, whose jumps lie elsewhere, are tried.
    for thrift in _THRIFTS:
        finest = round(_STEPS_PER_OCTAVE * math.log2(SMALLEST_STEP))
        coarsest = round(_STEPS_PER_OCTAVE * math.log2(LARGEST_STEP / min(source.rms)))
        above = below = math.nan  # excess beside the finest and the coarsest step that are left
        interpolates = False
        while finest <= coarsest:
            width = coarsest - finest
            exponent = (finest + coarsest) // 2
            if interpolates:
                exponent = finest + round(width * min(max(above / (above - below), 0.0), 1.0))
            step = 2 ** (exponent / _STEPS_PER_OCTAVE)
            coded = source.encode([step] * len(source.gains), thrift)
            found = _Found(coded, excess(coded), step, thrift)
            if best is None or preference(found) < preference(best):
                best = found
            if abs(best.excess) <= tolerance / 2:
                return best
            if found.excess > 0:
                finest, above = exponent + 1, found.excess
            else:
                coarsest, below = exponent - 1, found.excess
            # Straight lines lead there soon, unless one end stays where it is, or the excess jumps: then halve.
            halved = 2 * (coarsest - finest) <= width
            interpolates = thrift == _THRIFTS[0] and halved and math.isfinite(above - below)
        if best is not None and (abs(best.excess) <= tolerance or side * best.excess < -tolerance):
            break
    assert best is not None, "there is a step to try"
    return best
