"""Finds what makes a recording doubtful: a sensor at its limit, samples that stand still, nothing that touch feels."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from vibrocast.textures.filtering import HIGHPASS_HZ, is_vibration
from vibrocast.textures.recording import Recording

LIMIT_RUN = 3
"""So many samples in a row at the extreme are at a limit; fewer may be a peak."""
STILL_S = 0.02
"""Samples that stay equal for longer are a drop-out: noise alone moves the lowest bits of a sensor."""
LEAST_IN_BAND = 1e-3
"""Of the energy without the mean. A hand's movement of 3 m/s^2 hides a texture at the threshold, 0.1 m/s^2, so far."""

_LIMIT_PILE = 4  # times as many samples as at the next level; the top of a sine has 2.4 times as many
_LEVELS = 8
_LOOKED_AT = 10_000
_FINE_STEPS = 4  # in lowest bits: the usual change of a signal whose equal neighbours are no chance
_STILL_SAMPLES = 8
_REPEATED = 0.2  # of all samples
_AT_REST = 0.1  # of its range: the median of a signal without an offset is nearer to 0
_SHORTEST = 4  # a part of _BLOCK_S; less says nothing of the band
_TOUCH_HZ = 40.0  # the least rate of change that the receptors for texture answer to well
_BLOCK_S = 1.0


def doubts_of(recording: Recording) -> tuple[str, ...]:
    """Return sentences about samples at a limit, stretches of equal samples, and energy outside the band of touch."""
    return tuple(
        f"{recording.name}: {text}" for text in (*_at_limits(recording), *_still(recording), *_unfelt(recording))
    )


def _at_limits(recording: Recording) -> Iterator[str]:
    for channel, samples in enumerate(recording.samples.T, 1):
        for sign in (1.0, -1.0):
            limit = sign * float(np.max(sign * samples))
            at = samples == limit
            others = samples[~at]
            if len(np.unique(others[:_LOOKED_AT])) < _LEVELS:
                continue  # constant, or a signal that switches
            next_level = sign * float(np.max(sign * others))
            runs = [length for _, length in _runs(at) if length >= LIMIT_RUN]
            if len(runs) > 1 and np.count_nonzero(at) >= _LIMIT_PILE * np.count_nonzero(others == next_level):
                yield (
                    f"channel {channel} stays at {limit:.4g} {recording.unit} {len(runs)} times, for {sum(runs)} "
                    "samples: the sensor's limit? record with a wider range"
                )


def _still(recording: Recording) -> Iterator[str]:
    """Yield where all channels stand still, unless they rest at 0 or their numbers are too coarse to tell."""
    samples = recording.samples
    steps = np.abs(np.diff(samples, axis=0))
    moving = steps[steps > 0]
    if not len(moving) or np.median(moving) < _FINE_STEPS * np.min(moving):
        return
    low, high = np.min(samples, axis=0), np.max(samples, axis=0)
    equal = np.all(steps == 0, axis=1) & ~np.any((samples[1:] == low) | (samples[1:] == high), axis=1)
    if np.all(np.abs(np.median(samples, axis=0)) < _AT_REST * (high - low)):
        equal &= np.any(samples[1:] != 0, axis=1)  # silence is no drop-out
    least = max(_STILL_SAMPLES, STILL_S * recording.rate_hz)
    long = [(start, length) for start, length in _runs(equal) if length >= least]
    if long:
        start, length = max(long, key=lambda run: run[1])
        yield (
            f"{len(long)} stretch(es) of equal samples, the longest of {length / recording.rate_hz:.3g} s at "
            f"{start / recording.rate_hz:.3f} s: did the sensor drop out?"
        )
    elif np.mean(equal) > _REPEATED:
        yield f"{np.mean(equal):.0%} of the samples repeat the one before: was the sensor read faster than it measures?"


def _unfelt(recording: Recording) -> Iterator[str]:
    if recording.rate_hz < 2 * _TOUCH_HZ:
        yield (
            f"{recording.rate_hz:g} Hz hold nothing above {recording.rate_hz / 2:g} Hz, and textures are felt from "
            f"{_TOUCH_HZ:g} Hz on: record at a higher rate, or correct the unit of its times"
        )
        return
    samples = recording.samples
    block = int(_BLOCK_S * recording.rate_hz)
    if not is_vibration(recording.unit) or len(samples) < block // _SHORTEST:
        return
    moving = samples - np.mean(samples, axis=0)
    energy = float(np.mean(np.square(moving)))
    if energy == 0:
        if samples.any():
            yield "all samples are equal: nothing can be felt"
        return
    window = np.hanning(min(block, len(samples)))[:, None]
    frequencies_hz = np.fft.rfftfreq(len(window), 1 / recording.rate_hz)
    blocks = range(0, len(samples) - len(window) + 1, len(window))
    spectra = (np.fft.rfft(window * moving[start : start + len(window)], axis=0) for start in blocks)
    power = sum(np.mean(np.square(np.abs(spectrum)), axis=1) for spectrum in spectra)
    in_band = 2 * float(np.sum(power[frequencies_hz >= HIGHPASS_HZ])) / (len(blocks) * len(window) * np.sum(window**2))
    if in_band < LEAST_IN_BAND * energy:
        yield (
            f"only {100 * in_band / energy:.2g} % of the energy of its movement is above {HIGHPASS_HZ:g} Hz, where "
            "touch feels it: is this the vibration of a texture?"
        )


def _runs(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield start and length of each run of true flags (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    yield from zip(edges[::2].tolist(), (edges[1::2] - edges[::2]).tolist(), strict=True)
