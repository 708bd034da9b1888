"""Reads HJIF clips (ISO/IEC 23090-31), and renders what they and HMPG clips describe."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from vibrocast.textures.clips.documents import left_out, polyline, read_json
from vibrocast.textures.clips.synthesis import (
    MAX_FREQUENCY_HZ,
    MAX_PARTS,
    TRANSIENT_CYCLES,
    TRANSIENT_S,
    Channel,
    Clip,
    Part,
    transient,
)
from vibrocast.textures.recording import MAX_CHANNELS, Signal, TextureError

SPATIAL = ("Vibrotactile Texture", "Texture", "Stiffness", "Friction")
"""Modalities over position; all others are over time."""

Ticks = Annotated[int, Meta(ge=0, le=2**40)]
Values = Callable[[Signal], Signal]


class Keyframe(Struct):
    """A point of an effect; its position counts from the effect's."""

    relative_position: Ticks = 0
    amplitude_modulation: Annotated[float, Meta(ge=-1, le=1)] | None = None
    frequency_modulation: Annotated[float, Meta(ge=0, le=1e6)] | None = None


class Effect(Struct):
    """What a band plays at a position. A reference plays the effect of the same `id` in the perception's library."""

    effect_type: Literal["Basis", "Reference", "Composite"] = "Basis"
    position: Ticks = 0
    id: int = 0
    phase: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    base_signal: Literal["Sine", "Square", "Triangle", "SawToothUp", "SawToothDown"] = "Sine"
    keyframes: list[Keyframe] = []


class Band(Struct):
    """Effects of one kind. `curve_type`: of a Curve. The limits are frequencies in Hz."""

    band_type: Literal["Transient", "Curve", "VectorialWave", "WaveletWave"]
    curve_type: Literal["Unknown", "Cubic", "Linear", "Akima", "Bezier", "Bspline"] = "Unknown"
    lower_frequency_limit: float = 0.0
    upper_frequency_limit: float = MAX_FREQUENCY_HZ
    effects: Annotated[list[Effect], Meta(max_length=MAX_PARTS)] = []


class ClipChannel(Struct):
    """What one actuator plays, at least for `sample_count` samples at `frequency_sampling` Hz, if these are given."""

    gain: float = 1.0
    bands: list[Band] = []
    frequency_sampling: Annotated[float, Meta(ge=0)] = 0.0
    sample_count: Annotated[float, Meta(ge=0)] = 0.0


class Perception(Struct):
    """Channels of one modality, and effects for references. `tracks`: channels, in files before 2023."""

    perception_modality: str = "Vibrotactile"
    perception_unit_exponent: Annotated[int, Meta(ge=-128, le=127)] = 0
    effect_library: list[Effect] = []
    channels: list[ClipChannel] = []
    tracks: list[ClipChannel] = []


class Document(Struct):
    """What a clip describes. `timescale`: ticks per second of all positions."""

    perceptions: Annotated[list[Perception], Meta(max_length=MAX_CHANNELS)]
    timescale: Annotated[int, Meta(ge=1, le=2**32)] = 1000


def read(data: bytes) -> Clip:
    """Return what an HJIF file describes.

    Raises ValueError, TextureError, msgspec.DecodeError and RecursionError.
    """
    return clip_of(read_json(data, Document))


def clip_of(document: Document) -> Clip:
    """Return the clip of a document: a channel for each channel of each perception over time.

    Raises ValueError, and TextureError for a wavelet band.
    """
    skipped: set[str] = set()
    channels: list[Channel] = []
    parts = 0
    for perception in document.perceptions:
        if perception.perception_modality in SPATIAL:
            skipped.add(f"{perception.perception_modality} (over position)")
            continue
        library = {effect.id: effect for effect in perception.effect_library if effect.effect_type == "Basis"}
        for channel in perception.channels or perception.tracks:
            bands = []
            for band in channel.bands:
                bands.append(_parts(band, library, document.timescale, MAX_PARTS - parts, skipped))
                parts += len(bands[-1])
            gain = channel.gain * 10.0**perception.perception_unit_exponent
            least_s = channel.sample_count / channel.frequency_sampling if channel.frequency_sampling else 0.0
            channels.append(Channel(bands, gain, least_s))
    constants = f"a transient = {TRANSIENT_CYCLES} cycles in {1000 * TRANSIENT_S:g} ms, whatever its frequency"
    return Clip(channels, (constants, *left_out(skipped)))


def _parts(band: Band, library: dict[int, Effect], timescale: int, most: int, skipped: set[str]) -> list[Part]:
    """Return the parts of a band, at most so many. Add to the names of what was left out."""
    if band.band_type == "WaveletWave":
        raise TextureError(
            "a wavelet band",
            "no patent rights are granted for its coding",
            "load the WAV file that it was made from, or code that again without a wavelet band",
        )
    parts: list[Part] = []
    referred: dict[int, list[Part]] = {}
    for effect in band.effects:
        if effect.effect_type == "Basis":
            own = _RENDERERS[band.band_type](effect, band, timescale)
        elif effect.effect_type == "Reference" and effect.id in library:
            if effect.id not in referred:
                referred[effect.id] = _RENDERERS[band.band_type](library[effect.id], band, timescale)
            own = referred[effect.id]
        else:
            skipped.add("Composite" if effect.effect_type == "Composite" else "Reference without an effect")
            continue
        if len(parts) + len(own) > most:
            raise ValueError(f"more than {MAX_PARTS} parts")
        start_s = effect.position / timescale
        parts += [replace(part, start_s=start_s + part.start_s, end_s=start_s + part.end_s) for part in own]
    return parts


def _transients(effect: Effect, band: Band, timescale: int) -> list[Part]:
    """Return a transient for each keyframe of an effect, their times from its start."""
    return [
        transient(each.relative_position / timescale, each.amplitude_modulation)
        for each in effect.keyframes
        if each.amplitude_modulation
    ]


def _vectorial_wave(effect: Effect, band: Band, timescale: int) -> list[Part]:
    """Return a base signal whose amplitude and frequency follow straight lines between the keyframes of an effect.

    As the reference software does, it limits to the band the mean frequency since the last keyframe.
    """
    amplitude = _line(effect, "amplitude_modulation", timescale) or (np.zeros(1), np.ones(1))
    times, frequencies_hz = _line(effect, "frequency_modulation", timescale) or (np.zeros(1), np.zeros(1))
    end_s = max((each.relative_position for each in effect.keyframes), default=0) / timescale
    times = np.concatenate([[0.0], times, [max(end_s, times[-1]) + 1]])  # constant before and after
    frequencies_hz = np.concatenate([frequencies_hz[:1], frequencies_hz, frequencies_hz[-1:]])
    lengths = np.diff(times)
    slopes = np.divide(np.diff(frequencies_hz), lengths, out=np.zeros_like(lengths), where=lengths > 0)
    before = np.concatenate([[0.0], np.cumsum((frequencies_hz[1:] + frequencies_hz[:-1]) / 2 * lengths)])
    before += effect.phase / (2 * np.pi)

    def values(times_s: Signal) -> Signal:
        segment = np.searchsorted(times, times_s, "right") - 1
        since_s = times_s - times[segment]
        mean_hz = frequencies_hz[segment] + slopes[segment] / 2 * since_s
        mean_hz = np.clip(mean_hz, band.lower_frequency_limit, band.upper_frequency_limit)
        cycles = before[segment] + mean_hz * since_s
        felt = np.interp(times_s, times, frequencies_hz) < MAX_FREQUENCY_HZ
        wave: Signal = np.interp(times_s, *amplitude) * _SIGNALS[effect.base_signal](cycles) * felt
        return wave

    return [Part(0.0, end_s, values)]


def _curve(effect: Effect, band: Band, timescale: int) -> list[Part]:
    """Return the curve through the amplitudes of an effect, which is itself the signal."""
    line = _line(effect, "amplitude_modulation", timescale)
    if line is None:
        return []
    times, amplitudes = line
    curve = _CURVES[band.curve_type](times - times[0], amplitudes)
    return [Part(times[0], times[-1], curve)]


def _line(effect: Effect, name: str, timescale: int) -> tuple[Signal, Signal] | None:
    """Return times in s and values of the keyframes of an effect that have this value; None if none has it."""
    points = [
        (each.relative_position / timescale, value)
        for each in effect.keyframes
        if (value := getattr(each, name)) is not None
    ]
    return polyline(points, "keyframes") if points else None


def _linear(times: Signal, amplitudes: Signal) -> Values:
    return lambda times_s: np.interp(times_s, times, amplitudes)


def _cubic(times: Signal, amplitudes: Signal) -> Values:
    """Return the curve of third order from point to point that is level at each."""

    def values(times_s: Signal) -> Signal:
        place = np.interp(times_s, times, np.arange(len(times)))
        first = place.astype(np.intp)
        since = place - first
        following = amplitudes[np.minimum(first + 1, len(times) - 1)]
        curve: Signal = amplitudes[first] + (following - amplitudes[first]) * (3 - 2 * since) * since**2
        return curve

    return values


def _akima(times: Signal, amplitudes: Signal) -> Values:
    """Return the curve of H. Akima, "A new method of interpolation and smooth curve fitting", 1970."""
    if len(times) < 3:
        return _linear(times, amplitudes)
    from scipy.interpolate import Akima1DInterpolator

    return Akima1DInterpolator(times, amplitudes, extrapolate=True)


def _bezier(times: Signal, amplitudes: Signal) -> Values:
    """Return Bezier curves of second order: of the points 0, 1 and 2, then 2, 3 and 4, and so on."""
    last = len(times) - 1
    starts, middles, ends = (np.minimum(np.arange(offset, last + offset, 2), last) for offset in range(3))

    def values(times_s: Signal) -> Signal:
        piece = np.maximum(np.searchsorted(times[starts], times_s, "right") - 1, 0)
        first, middle, end = starts[piece], middles[piece], ends[piece]
        # The parameter u of time (1 - u)^2 t0 + 2 u (1 - u) t1 + u^2 t2; this root of it needs no division by 0.
        since_s, slope = times_s - times[first], times[middle] - times[first]
        bend = times[first] - 2 * times[middle] + times[end]
        divisor = slope + np.sqrt(np.maximum(slope**2 + bend * since_s, 0))
        u = np.divide(since_s, divisor, out=np.zeros_like(since_s), where=divisor > 0)
        curve: Signal = (1 - u) ** 2 * amplitudes[first] + 2 * u * (1 - u) * amplitudes[middle] + u**2 * amplitudes[end]
        return curve

    return values


def _b_spline(times: Signal, amplitudes: Signal) -> Values:
    """Return the uniform B-spline of second order that begins and ends at the outer points.

    It consists of Bezier curves that meet in the middle between the inner points.
    """
    times, amplitudes = (
        np.insert(points, range(2, len(points) - 1), (points[1:-2] + points[2:-1]) / 2)
        for points in (times, amplitudes)
    )
    return _bezier(times, amplitudes)


_SIGNALS: dict[str, Values] = {
    "Sine": lambda cycles: np.sin(2 * np.pi * cycles),
    "Square": lambda cycles: np.where(cycles % 1 < 0.5, 1.0, -1.0),
    "Triangle": lambda cycles: 1 - 4 * np.abs((cycles + 0.25) % 1 - 0.5),
    "SawToothUp": lambda cycles: 2 * ((cycles + 0.5) % 1) - 1,
    "SawToothDown": lambda cycles: 1 - 2 * ((cycles + 0.5) % 1),
}
_CURVES = {
    "Unknown": _cubic,
    "Cubic": _cubic,
    "Linear": _linear,
    "Akima": _akima,
    "Bezier": _bezier,
    "Bspline": _b_spline,
}
_RENDERERS = {"Transient": _transients, "Curve": _curve, "VectorialWave": _vectorial_wave}
