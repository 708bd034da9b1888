"""The format of a live signal before it comes: rate, unit, full scales and expected levels."""

from collections.abc import Sequence

import numpy as np

from vibrocast import textures
from vibrocast.codec.interface import SignalFormat
from vibrocast.codec.registry import gain_for

# Assumed RMS value of a source, relative to its full scale, if nothing is known of it.
EXPECTED_RMS = 0.2


def live_format(
    rate_hz: int, unit: str, full_scales: Sequence[float], rms: Sequence[float] | None = None
) -> SignalFormat:
    """Return the format of a live source before its samples come.

    `full_scales`: the largest expected magnitude of each channel, in `unit`. `rms`: RMS values in `unit`; None =
    EXPECTED_RMS of full scale. Raises CodecError for a full scale that cannot be coded.
    """
    gains = tuple(gain_for(full_scale) for full_scale in full_scales)
    if rms is None:
        return SignalFormat(rate_hz, unit, gains, (EXPECTED_RMS,) * len(gains))
    relative = tuple(value / gain or 1.0 for value, gain in zip(rms, gains, strict=True))
    return SignalFormat(rate_hz, unit, gains, relative)


def recording_format(recording: textures.Recording) -> SignalFormat:
    """Return the format of a recording that is played live. Raises CodecError if it cannot be coded."""
    samples = recording.samples
    peaks = np.max(np.abs(samples), axis=0, initial=0.0)
    rms = np.sqrt(np.mean(np.square(samples), axis=0))
    return live_format(round(recording.rate_hz), recording.unit, peaks.tolist(), rms.tolist())
