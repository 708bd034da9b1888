"""Height profiles coded once for every hand speed: the band worth coding and the pitch that follows from it."""

import math
from pathlib import Path
from typing import Any

from vibrocast import textures
from vibrocast.codec.encoding import Encoding, encode_recording
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, PROFILE_UNIT, StreamError

BAND_HZ = 400.0
"""What is worth coding at the slowest hand: up to here the DCT paper's display renders its textures."""
SLOWEST_MM_S = 10.0

# Parts of its rate: up to where a profile is rendered exactly, and without images (vibrocast/profile.h).
_EXACT_PART, _BAND_PART = 0.34, 0.435


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
    **quality: Any,
) -> Encoding:
    """Code a height profile (`recording_of`) as a spatial stream.

    The pitch is such that a hand at `slowest_mm_s` feels all up to `band_hz`, but no finer than the profile has it.
    `quality`: as `coding.encode` takes it, without a rate. Raises as that.
    """
    wanted = band_hz / (slowest_mm_s / 1000) / _EXACT_PART
    samples_per_metre = math.ceil(min(wanted, recording.rate_hz / 2 / _EXACT_PART))
    if samples_per_metre > MAX_RATE_HZ:
        slowest_possible = 1000 * band_hz / (_EXACT_PART * MAX_RATE_HZ)
        raise StreamError(
            f"{samples_per_metre} samples per metre, at most {MAX_RATE_HZ} fit a stream: ask for a slowest hand speed "
            f"of {slowest_possible:.3g} mm/s or more, or a narrower band"
        )
    narrow_hz = 2 * _BAND_PART * samples_per_metre
    if recording.rate_hz > narrow_hz:
        recording = textures.resample(recording, narrow_hz)
    return encode_recording(
        recording, stream_rate_hz=samples_per_metre, live=True, unit=PROFILE_UNIT, highpass_hz=None, **quality
    )
