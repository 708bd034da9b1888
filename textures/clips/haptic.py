"""Reads `.haptic` clips of version 1 (Lofelt, now Meta): envelopes of amplitude and frequency, with emphases."""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct, json

from vibrocast.textures.clips.documents import Seconds, Unit, polyline, read_json
from vibrocast.textures.clips.synthesis import MAX_PARTS, Channel, Clip, Envelope, Part, wave
from vibrocast.textures.recording import Signal, TextureError

FREQUENCY_HZ = (20, 250)
"""Of the numbers 0 and 1 in a clip, linear between. All constants are those of the generic PCM device in the
configuration files of Meta's Haptics SDK."""
EMPHASIS_HZ, EMPHASIS_S = (55, 130), (0.027, 0.020)
"""Of an emphasis of frequency 0 and 1: a sine, which this frequency mixes with a square wave."""
DUCKING = 0.5
"""The factor of the continuous vibration during an emphasis."""
MISSING_FREQUENCY = 0.5
"""Of a clip without an envelope of frequency: the format's specification."""


class _Emphasis(Struct):
    amplitude: Unit
    frequency: Unit


class _AmplitudePoint(Struct):
    time: Seconds
    amplitude: Unit
    emphasis: _Emphasis | None = None


class _FrequencyPoint(Struct):
    time: Seconds
    frequency: Unit


class _Envelopes(Struct):
    amplitude: Annotated[list[_AmplitudePoint], Meta(min_length=2, max_length=MAX_PARTS)]
    frequency: list[_FrequencyPoint] = []


class _Continuous(Struct):
    envelopes: _Envelopes


class _Signals(Struct):
    continuous: _Continuous


class _Version(Struct):
    major: int
    minor: int = 0


class _Versioned(Struct):
    version: _Version


class _Document(_Versioned):
    signals: _Signals


def read(data: bytes) -> Clip:
    """Return what a `.haptic` file of version 1 describes.

    Raises ValueError, TextureError, msgspec.DecodeError and RecursionError.
    """
    version = read_json(data, _Versioned).version
    if version.major != 1:
        raise TextureError(
            f"version {version.major} of the format, and only 1 is known",
            action="open it in Meta Haptics Studio, and export it again",
        )
    envelopes = read_json(data, _Document).signals.continuous.envelopes
    amplitude = polyline(((each.time, each.amplitude) for each in envelopes.amplitude), "amplitude")
    frequency = polyline(
        [(each.time, each.frequency) for each in envelopes.frequency] or [(0, MISSING_FREQUENCY)], "frequency"
    )
    end_s = envelopes.amplitude[-1].time
    emphases = _emphases(envelopes.amplitude, end_s)
    starts, ends = (np.array([getattr(part, name) for part in emphases]) for name in ("start_s", "end_s"))

    def values(times_s: Signal) -> Signal:
        before = np.searchsorted(starts, times_s, "right") - 1
        ducked = (before >= 0) & (times_s < np.append(ends, 0.0)[before])
        amplitudes = np.interp(times_s, *amplitude) * np.where(ducked, DUCKING, 1.0)
        return wave(times_s, amplitudes, np.interp(np.interp(times_s, *frequency), (0, 1), FREQUENCY_HZ))

    weak = any(each.emphasis and each.emphasis.amplitude < each.amplitude for each in envelopes.amplitude)
    notes = (
        f"as on a generic PCM device: frequency 0 to 1 = {_range(FREQUENCY_HZ)} Hz",
        f"an emphasis of frequency 0 to 1 = {_range(EMPHASIS_HZ)} Hz, sine to square wave, for "
        f"{_range(EMPHASIS_S, 1000)} ms; the rest is multiplied by {DUCKING:g} meanwhile",
        *(("an emphasis is weaker than the vibration at its time",) if weak else ()),
        *((f"version 1.{version.minor} is read as 1.0",) if version.minor else ()),
    )
    return Clip([Channel([[Part(0.0, end_s, values), *emphases]])], notes)


def write(envelope: Envelope) -> bytes:
    """Return a `.haptic` file of an envelope, whose frequencies are in the range of FREQUENCY_HZ."""
    points = zip(envelope.times_s.tolist(), envelope.amplitudes.tolist(), strict=True)
    numbers = np.interp(envelope.frequencies_hz, FREQUENCY_HZ, (0, 1))
    amplitude = [_AmplitudePoint(round(time_s, 6), round(value, 4)) for time_s, value in points]
    frequency = [
        _FrequencyPoint(each.time, round(value, 4)) for each, value in zip(amplitude, numbers.tolist(), strict=True)
    ]
    return json.encode(_Document(_Version(1), _Signals(_Continuous(_Envelopes(amplitude, frequency)))))


def _emphases(points: list[_AmplitudePoint], end_s: float) -> list[Part]:
    """Return the emphases. Each ends where the next one begins, and with the clip."""
    emphasised = [(point.time, point.emphasis) for point in points if point.emphasis is not None]
    limits_s = [*(time_s for time_s, _ in emphasised[1:]), end_s]
    return [_emphasis(time_s, limit_s, each) for (time_s, each), limit_s in zip(emphasised, limits_s, strict=False)]


def _emphasis(start_s: float, limit_s: float, emphasis: _Emphasis) -> Part:
    square = emphasis.frequency
    frequency_hz, duration_s = (float(np.interp(square, (0, 1), pair)) for pair in (EMPHASIS_HZ, EMPHASIS_S))

    def values(times_s: Signal) -> Signal:
        sine = np.sin(2 * np.pi * frequency_hz * times_s)
        mixed: Signal = emphasis.amplitude * ((1 - square) * sine + square * np.where(sine >= 0, 1, -1))
        return mixed

    return Part(start_s, min(start_s + duration_s, limit_s), values)


def _range(pair: tuple[float, float], factor: float = 1) -> str:
    return f"{factor * pair[0]:g} to {factor * pair[1]:g}"
