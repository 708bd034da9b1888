"""Computes the signal of a clip: the sum of its parts, each a vibration between two times."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vibrocast.memory import shortage
from vibrocast.textures.recording import MAX_CHANNELS, Contents, Signal, unusable

RATE_HZ = 8000.0
"""Of a clip's signal, unless you give another: that of the reference software of ISO/IEC 23090-31."""
MIN_RATE_HZ, MAX_RATE_HZ = 2000.0, 200_000.0
MAX_FREQUENCY_HZ = 1000.0
"""Waves from it on are left out: touch does not reach it, and a rate of MIN_RATE_HZ does not hold it."""
TRANSIENT_CYCLES, TRANSIENT_S = 2, 0.022
"""Of a sine, in the reference software of ISO/IEC 23090-31. Meta's Haptics SDK has as many cycles."""
MAX_SECONDS = 600.0
MAX_PARTS = 20_000
MAX_SUM_SECONDS = 3600.0
"""Of the durations of all parts together: it limits the work that a short file can cause."""


@dataclass(frozen=True)
class Part:
    """A part of one channel, from `start_s` up to `end_s`.

    `values` returns its samples (n,) for n > 0 rising times in s after `start_s`.
    """

    start_s: float
    end_s: float
    values: Callable[[Signal], Signal]


@dataclass(frozen=True)
class Channel:
    """The parts of a channel by band, and its least duration.

    The sum is limited to -1 to 1 after each band, then multiplied by `gain` and limited again.
    """

    bands: Sequence[Sequence[Part]]
    gain: float = 1.0
    least_s: float = 0.0


@dataclass(frozen=True)
class Clip:
    """What a clip describes. `notes`: the constants that its format leaves open, and what was left out, for people."""

    channels: Sequence[Channel]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Envelope:
    """A vibration of one channel: straight lines between amplitudes, 0 to 1, and frequencies at times (n,)."""

    times_s: Signal
    amplitudes: Signal
    frequencies_hz: Signal


def rendered(clip: Clip, rate_hz: float, path: Path) -> Contents:
    """Return the signal of a clip at a rate. Raises TextureError if there is none, or if it takes too long."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise unusable(
            path, f"a clip, and {rate_hz:g} Hz", f"give {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz, or nothing", "rate_hz"
        )
    if len(clip.channels) > MAX_CHANNELS:
        raise unusable(path, f"a clip of {len(clip.channels)} channels", f"give one of at most {MAX_CHANNELS}")
    parts = [part for channel in clip.channels for band in channel.bands for part in band]
    if not any(part.end_s > 0 for part in parts):
        raise unusable(path, "a clip without a vibration", "give another file")
    if min(part.start_s for part in parts) < 0:
        raise unusable(path, "a part begins before the clip", "correct its time")
    end_s = max(*(part.end_s for part in parts), *(channel.least_s for channel in clip.channels))
    sum_s = sum(part.end_s - part.start_s for part in parts)
    if end_s > MAX_SECONDS or sum_s > MAX_SUM_SECONDS or len(parts) > MAX_PARTS:
        raise unusable(
            path,
            f"a clip of {end_s:.3g} s with {len(parts)} parts of {sum_s:.3g} s together",
            f"give one of at most {MAX_SECONDS:g} s, with {MAX_PARTS} parts of {MAX_SUM_SECONDS:g} s together",
        )
    samples = _first_sample(end_s, rate_hz)
    if lack := shortage(8 * samples * (len(clip.channels) + 2)):
        raise unusable(path, f"its signal {lack}", "")
    signal = np.zeros((samples, len(clip.channels)))
    for column, channel in zip(signal.T, clip.channels, strict=True):
        for band in channel.bands:
            spans = [(_first_sample(part.start_s, rate_hz), _first_sample(part.end_s, rate_hz)) for part in band]
            for part, (first, end) in zip(band, spans, strict=True):
                if first < end:
                    since_start: Signal = np.arange(first, end) - np.float64(part.start_s * rate_hz)
                    column[first:end] += part.values(np.maximum(since_start, 0) / rate_hz)
            for first, end in spans:
                np.clip(column[first:end], -1, 1, out=column[first:end])
        np.clip(column * channel.gain, -1, 1, out=column)
    return Contents(signal, rate_hz, "drive", notes=(f"rendered at {rate_hz:g} Hz", *clip.notes))


def _first_sample(time_s: float, rate_hz: float) -> int:
    """Return the first sample at or after a time. Files round times, to a microsecond for instance."""
    return math.ceil(time_s * rate_hz - 0.01)


def wave(times_s: Signal, amplitudes: Signal, frequencies_hz: Signal) -> Signal:
    """Return a sine (n,) whose amplitude and frequency are given at each time (n,); its phase at time 0 is 0."""
    steps = (frequencies_hz[1:] + frequencies_hz[:-1]) / 2 * np.diff(times_s)
    cycles = np.cumsum(np.concatenate([frequencies_hz[:1] * times_s[:1], steps]))
    sine: Signal = amplitudes * np.sin(2 * np.pi * cycles) * (frequencies_hz < MAX_FREQUENCY_HZ)
    return sine


def transient(start_s: float, amplitude: float, duration_s: float = TRANSIENT_S) -> Part:
    """Return TRANSIENT_CYCLES of a sine."""
    radians_per_s = 2 * np.pi * TRANSIENT_CYCLES / duration_s
    return Part(start_s, start_s + duration_s, lambda times_s: amplitude * np.sin(radians_per_s * times_s))
