"""Step shapes: by how much the quantiser steps of a codec differ over frequency, for a purpose."""

import math
from collections.abc import Sequence

import numpy as np

from vibrocast.codec.interface import CodecError, Signal
from vibrocast.codec.threshold import MIN_HZ, read_threshold, skin_density, threshold_amplitude

PURPOSES = ("spqi", "threshold")
"""What a stream may be coded for, instead of its SNR: the error follows the signal, or the threshold of touch."""
NODES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""The frequencies of a shape, in parts of half the rate. Between them it is linear over frequency."""
FLAT = "flat"
_FRAME = 1024
_FRAMES_AT_ONCE = 1024
_SIGNAL_EXPONENT = 0.25
_SIGNAL_FLOOR_DB = 15.0
_MOST_OVER_250_HZ_DB = 22.5
_SLOW_HZ = 40.0
_SLOW_NODES_HZ = 50.0
_MOST_SLOW_DB = 24.0
_LIVE_SLOW_DB = 12.0
_DESIGN_SNR_DB = 10.0


def signal_shape(samples: Signal) -> tuple[float, ...]:
    """Return the shape for SPQI of a whole signal (n, channels), in octaves of the step at NODES, at least 0.

    Steps are proportional to P^(-1/4), where P is the power density: they are finer where the signal is strong. SPQI
    adds | |X|^2 - |Y|^2 | over the spectrum, about 2 |X| |X - Y|, so an error weighs in proportion to |X|. That alone
    would make steps proportional to 1 / |X|, at a high price in SNR: studies/perceptual.py shows what the root keeps.
    P counts as at least 15 dB below the strongest node. Channels count alike, at their own level.
    """
    power: Signal = np.zeros(len(NODES))
    for channel in samples.T:
        level = np.mean(np.square(channel))
        if level > 0:
            power += _power_at_nodes(channel) / level
    if not np.any(power):
        return (0.0,) * len(NODES)
    power = power + power.max() * 10 ** (-_SIGNAL_FLOOR_DB / 10)
    octaves = -_SIGNAL_EXPONENT * np.log2(power)
    return tuple((octaves - octaves.min()).tolist())


def _power_at_nodes(channel: Signal) -> Signal:
    """Return the power density of a channel (n,) around each node: means under triangles that reach to the next."""
    window = np.hanning(_FRAME + 1)[:-1]
    padded = np.pad(channel, (0, max(0, _FRAME - len(channel))))
    frames = np.lib.stride_tricks.sliding_window_view(padded, _FRAME)[:: _FRAME // 2]
    density: Signal = np.zeros(_FRAME // 2 + 1)
    for start in range(0, len(frames), _FRAMES_AT_ONCE):  # to limit memory for long signals
        density += np.sum(np.abs(np.fft.rfft(frames[start : start + _FRAMES_AT_ONCE] * window)) ** 2, axis=0)
    position = np.linspace(0, 1, len(density))
    triangles = np.stack([np.interp(position, NODES, row) for row in np.eye(len(NODES))])
    around: Signal = triangles @ density / np.sum(triangles, axis=1) / len(frames)
    return around


def threshold_shape(rate_hz: float, unit: str, samples: Signal | None = None) -> tuple[float, ...]:
    """Return the shape for touch, in octaves of the step at NODES, at least 0. Raises CodecError without a unit.

    Steps are proportional to the detection threshold in the stream's unit, so that the error at the skin lies equally
    far from it at all frequencies. They are at most 22.5 dB above the step at 250 Hz, so that strong vibration above
    400 Hz is kept. Below 50 Hz, where a displacement actuator lifts all noise, they are as much finer as the noise
    would exceed the recording there. `samples`: the signal (n, channels), None = a live stream's, not known yet, which
    gets 12 dB.
    """
    rows = read_threshold()
    nodes_hz = np.array(NODES) * rate_hz / 2
    nodes_hz[0] = nodes_hz[1] / 4  # the middle of the lowest bins
    nodes_hz = np.maximum(nodes_hz, MIN_HZ)
    level_db = 20 * np.log10(threshold_amplitude(rows, nodes_hz, unit))
    reference_db = 20 * np.log10(threshold_amplitude(rows, np.array([250.0]), unit))
    level_db = np.minimum(level_db, reference_db + _MOST_OVER_250_HZ_DB)
    finer_db = _LIVE_SLOW_DB if samples is None else _slow_excess_db(samples, rate_hz, unit, rows)
    level_db[nodes_hz < _SLOW_NODES_HZ] -= finer_db
    octaves = (level_db - level_db.min()) / (20 * math.log10(2))
    return tuple(octaves.tolist())


def _slow_excess_db(samples: Signal, rate_hz: float, unit: str, rows: Signal) -> float:
    """Return by how much noise in proportion to the threshold exceeds a signal below 40 Hz, 0 to 24 dB.

    Both count as displacement, in the channel where it is most. The weighted SNR at the skin is 10 dB then: the noise
    is a part of the squared threshold or, where that is more, all of the signal (reverse water-filling).
    """
    frequency_hz, density = skin_density(samples, rate_hz, unit)
    threshold_um = threshold_amplitude(rows, frequency_hz, "um")
    slow = frequency_hz < _SLOW_HZ
    worst = 0.0
    for channel in density.T:
        felt = np.sort(channel / np.square(threshold_um))
        # The noise if the signal is lost in the weakest bins, for each number of them; it rises with their number.
        noise = np.cumsum(felt) + felt * np.arange(len(felt) - 1, -1, -1)
        if not np.any(slow) or not noise[-1] > 0:
            continue
        part = float(np.interp(10 ** (-_DESIGN_SNR_DB / 10) * noise[-1], noise, felt))
        lost = part * np.sum(np.square(threshold_um[slow]))
        worst = max(worst, 10 * math.log10(lost / max(float(np.sum(channel[slow])), 1e-30 * lost)))
    return min(worst, _MOST_SLOW_DB)


def shape_for(purpose: str, samples: Signal | None, rate_hz: float, unit: str) -> tuple[float, ...]:
    """Return the shape for one of PURPOSES; `samples` (n, channels), None = a live stream's, not known yet.

    Raises CodecError for another purpose, for "threshold" without a physical unit, for "spqi" live.
    """
    if purpose not in PURPOSES:
        raise CodecError(f"a stream cannot be coded for {purpose!r}; choose one of {', '.join(PURPOSES)}")
    if purpose == "threshold":
        return threshold_shape(rate_hz, unit, samples)
    if samples is None:
        raise CodecError(
            "the shape for spqi follows the spectrum of the whole recording, which a live stream does not know; code "
            "it for threshold, or give the codec's parameter `shape`"
        )
    return signal_shape(samples)


def shape_text(octaves: Sequence[float]) -> str:
    """Return a shape as the value of a codec's parameter."""
    return "/".join(f"{each:.4g}" for each in octaves)


def parsed_shape(text: str) -> tuple[float, ...] | None:
    """Return the octaves of a parameter's value, None for FLAT. Raises CodecError."""
    if text == FLAT:
        return None
    try:
        octaves = tuple(float(each) for each in text.split("/"))
    except ValueError:
        octaves = ()
    if len(octaves) != len(NODES) or not all(math.isfinite(each) and 0 <= each <= 14 for each in octaves):
        raise CodecError(f"shape is {text!r}; write {FLAT}, or {len(NODES)} octaves from 0 to 14, divided by slashes")
    return octaves
