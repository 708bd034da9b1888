"""Height profiles coded once for every hand speed: the band worth coding and the pitch that follows from it."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast import textures
from vibrocast.codec.encoding import Encoding, encode_recording
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, PROFILE_UNIT, StreamError

BAND_HZ = 400.0
"""What is worth coding at the slowest hand: up to here the DCT paper's display renders its textures."""
SLOWEST_MM_S = 10.0

# Parts of its rate: up to where a profile is rendered exactly, and without images (vibrocast/profile.h).
_EXACT_PART, _BAND_PART = 0.34, 0.435
# The period of a rendered profile is a multiple of a power of two, at most this one (vibrocast/profile.h).
_PERIOD_SAMPLES = 128
_CROSSFADE_PART = 16


def recording_of(path: Path, **choices: Any) -> textures.Recording:
    """Read a height profile as `textures.load` does, form removed: um, its rate in samples per metre.

    Raises TextureError.
    """
    if choices.get("hand_speed_mm_s") is not None:
        raise textures.TextureError(
            f"{path}: a spatial stream is coded for every hand speed; leave out hand_speed_mm_s"
        )
    # A hand at 1 m/s passes as many samples in a second as there are in a metre.
    recording = textures.load(path, **{**choices, "hand_speed_mm_s": 1000.0})
    if recording.unit != "um":
        raise textures.TextureError(f"{path}: in {recording.unit}; a spatial stream needs a height profile")
    return recording


def encode(
    recording: textures.Recording,
    slowest_mm_s: float = SLOWEST_MM_S,
    band_hz: float = BAND_HZ,
    crossfade: bool = False,
    **quality: Any,
) -> Encoding:
    """Code a height profile (`recording_of`) as a spatial stream.

    The pitch is such that a hand at `slowest_mm_s` feels all up to `band_hz`, but no finer than the profile needs. It
    divides the profile's length, so every controller repeats the whole of it. `crossfade`: the end fades into the
    beginning over a sixteenth of the length, and the rest repeats. `quality`: as `coding.encode` takes it, without a
    rate. Raises as that.
    """
    if crossfade:
        recording = _crossfaded(recording)
    wanted = band_hz / (slowest_mm_s / 1000) / _EXACT_PART
    samples_per_metre = math.ceil(min(wanted, recording.rate_hz / 2 / _EXACT_PART))
    if samples_per_metre > MAX_RATE_HZ:
        slowest_possible = 1000 * band_hz / (_EXACT_PART * MAX_RATE_HZ)
        raise StreamError(
            f"{samples_per_metre} samples per metre, at most {MAX_RATE_HZ} fit a stream: ask for a slowest hand speed "
            f"of {slowest_possible:.3g} mm/s or more, or a narrower band"
        )
    most = math.floor(recording.seconds * MAX_RATE_HZ / _PERIOD_SAMPLES)
    if most < 1:
        raise StreamError(
            f"{1000 * recording.seconds:.3g} mm are too short to repeat; give a profile of at least "
            f"{1000 * _PERIOD_SAMPLES / MAX_RATE_HZ:g} mm"
        )
    periods = min(most, math.ceil(recording.seconds * samples_per_metre / _PERIOD_SAMPLES))
    recording = _resampled(recording, periods * _PERIOD_SAMPLES)
    return encode_recording(
        recording,
        stream_rate_hz=round(recording.rate_hz),
        live=True,
        unit=PROFILE_UNIT,
        highpass_hz=None,
        **quality,
    )


def _crossfaded(recording: textures.Recording) -> textures.Recording:
    """Return a profile whose end fades into its beginning, so that it repeats without a step."""
    faded = max(1, len(recording.samples) // _CROSSFADE_PART)
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(faded) + 0.5) / faded)[:, None]
    samples = recording.samples[:-faded].copy()
    samples[:faded] = rise * samples[:faded] + (1 - rise) * recording.samples[-faded:]
    return replace(recording, samples=samples)


def _resampled(recording: textures.Recording, samples: int) -> textures.Recording:
    """Return a profile of the same length in other samples, band-limited so that no image of it is rendered.

    Its cosine series is the same up to there, so the ends keep their heights. Samples per metre are rounded.
    """
    from scipy.fft import dct, idct

    series = dct(recording.samples, axis=0, norm="ortho")[: round(2 * _BAND_PART * samples)]
    heights = idct(series, n=samples, axis=0, norm="ortho") * math.sqrt(samples / len(recording.samples))
    return replace(recording, samples=heights, rate_hz=float(round(samples / recording.seconds)))
