"""Reads AHAP, Apple's haptic and audio patterns: events, and parameters that change all events over time."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, field, json

from vibrocast.textures.clips.documents import Seconds, left_out, polyline, read_json
from vibrocast.textures.clips.synthesis import (
    MAX_PARTS,
    TRANSIENT_CYCLES,
    Channel,
    Clip,
    Envelope,
    Part,
    transient,
    wave,
)
from vibrocast.textures.recording import Signal

INTENSITY_EXPONENT = 2.0
"""The amplitude is the intensity to this power: Meta's Haptics SDK writes the root of the amplitude."""
LOWEST_HZ, HIGHEST_HZ = 65.0, 300.0
"""Of sharpness 0 and 1, linear between: the reference software of ISO/IEC 23090-31, and Interhaptics."""
DEFAULTS = {"HapticIntensity": 1.0, "HapticSharpness": 0.5}
"""Of an event that states none. Apple does not publish its own; most programs write these."""
MAX_EVENT_S, MAX_CURVE_POINTS = 30.0, 16
"""The longest event by Apple's documentation, and the points to which most programs split a curve."""
CONTROLS = {"HapticIntensityControl": 1.0, "HapticSharpnessControl": 0.0}
"""The dynamic parameters that are rendered, with their values before the first one: a factor, and a summand."""


class _Parameter(Struct, rename="pascal"):
    """A parameter of one event; in a pattern, of all events from `time` on."""

    parameter_value: float
    parameter_id: str = field(name="ParameterID")
    time: Seconds = 0.0


class _Event(Struct, rename="pascal"):
    event_type: str
    time: Seconds = 0.0
    event_duration: Seconds = 0.0
    duration: Seconds = 0.0  # the name in the text of Apple's article
    event_parameters: list[_Parameter] = []


class _Point(Struct, rename="pascal"):
    time: Seconds
    parameter_value: float


class _Curve(Struct, rename="pascal"):
    """Points with straight lines between them; their times count from `time`."""

    points: Annotated[list[_Point], Meta(min_length=1)] = field(name="ParameterCurveControlPoints")
    parameter_id: str = field(name="ParameterID")
    time: Seconds = 0.0


class _Entry(Struct, rename="pascal"):
    event: _Event | None = None
    parameter: _Parameter | None = None
    parameter_curve: _Curve | None = None


class _Document(Struct, rename="pascal"):
    pattern: Annotated[list[_Entry], Meta(max_length=MAX_PARTS)]
    version: Annotated[float, Meta(ge=1, lt=2)] = 1.0


class _Control:
    """The value of a dynamic parameter over time. Of several parameters and curves, the one that starts last counts."""

    def __init__(self, default: float, curves: Sequence[tuple[Signal, Signal]]) -> None:
        times, values = [np.zeros(1)], [np.full(1, default)]
        for next_times, next_values in sorted(curves, key=lambda curve: float(curve[0][0])):
            start_s = next_times[:1]
            kept = times[-1] < start_s
            last = np.interp(start_s, times[-1], values[-1])
            times[-1:] = [times[-1][kept], start_s, next_times]
            values[-1:] = [values[-1][kept], last, next_values]
        self._times, self._values = np.concatenate(times), np.concatenate(values)

    def __call__(self, times_s: Signal) -> Signal:
        values: Signal = np.interp(times_s, self._times, self._values)
        return values


def read(data: bytes) -> Clip:
    """Return what an AHAP file describes. Raises ValueError, msgspec.DecodeError and RecursionError."""
    entries = read_json(data, _Document).pattern
    curves: dict[str, list[tuple[Signal, Signal]]] = {name: [] for name in CONTROLS}
    skipped = set()
    for entry in entries:
        if entry.parameter is not None:
            name, line = entry.parameter.parameter_id, [(entry.parameter.time, entry.parameter.parameter_value)]
        elif entry.parameter_curve is not None:
            curve = entry.parameter_curve
            name, line = curve.parameter_id, [(curve.time + each.time, each.parameter_value) for each in curve.points]
        else:
            continue
        if name in curves:
            curves[name].append(polyline(line, name))
        else:
            skipped.add(name)
    controls = {name: _Control(default, curves[name]) for name, default in CONTROLS.items()}
    parts = []
    for event in filter(None, (entry.event for entry in entries)):
        if event.event_type in ("HapticTransient", "HapticContinuous"):
            # A parameter of 0 is the default of all that are not rendered, but of `Sustained`, which is 1.
            skipped |= {
                each.parameter_id
                for each in event.event_parameters
                if each.parameter_id not in DEFAULTS and each.parameter_value != (each.parameter_id == "Sustained")
            }
            parts.append(_part(event, *controls.values()))
            if event.event_type == "HapticContinuous" and parts[-1].end_s == event.time:
                skipped.add("HapticContinuous without EventDuration")
        else:
            skipped.add(event.event_type)
    constants = (
        f"amplitude = intensity ^ {INTENSITY_EXPONENT:g}; sharpness 0 to 1 = {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz",
        f"a transient = {TRANSIENT_CYCLES} cycles; without parameters, intensity {DEFAULTS['HapticIntensity']:g} and "
        f"sharpness {DEFAULTS['HapticSharpness']:g}",
    )
    return Clip([Channel([parts])], (*constants, *left_out(skipped)))


def write(envelope: Envelope) -> bytes:
    """Return an AHAP file of an envelope, whose frequencies are between LOWEST_HZ and HIGHEST_HZ."""
    intensities = envelope.amplitudes ** (1 / INTENSITY_EXPONENT)
    sharpnesses = (envelope.frequencies_hz - LOWEST_HZ) / (HIGHEST_HZ - LOWEST_HZ)
    times_s = envelope.times_s.tolist()
    neutral = [{"ParameterID": name, "ParameterValue": value} for name, value in zip(DEFAULTS, (1, 0), strict=True)]
    event = {"EventType": "HapticContinuous", "EventParameters": neutral}
    pattern: list[dict[str, Any]] = [
        {"Event": {**event, "Time": start_s, "EventDuration": min(times_s[-1] - start_s, MAX_EVENT_S)}}
        for start_s in np.arange(0, times_s[-1], MAX_EVENT_S).tolist()
    ]
    for name, values in zip(CONTROLS, (intensities, sharpnesses), strict=True):
        for first in range(0, len(values) - 1, MAX_CURVE_POINTS - 1):
            part = slice(first, first + MAX_CURVE_POINTS)
            start_s = times_s[first]
            points = [
                {"Time": round(time_s - start_s, 6), "ParameterValue": round(value, 4)}
                for time_s, value in zip(times_s[part], values[part].tolist(), strict=True)
            ]
            curve = {"ParameterID": name, "Time": start_s, "ParameterCurveControlPoints": points}
            pattern.append({"ParameterCurve": curve})
    return json.encode({"Version": 1.0, "Pattern": pattern})


def _part(event: _Event, intensity_control: _Control, sharpness_control: _Control) -> Part:
    """Return a haptic event. Values out of range become the nearest in range, as Apple says."""
    own = DEFAULTS | {each.parameter_id: each.parameter_value for each in event.event_parameters}
    intensity, sharpness = (min(max(own[name], 0.0), 1.0) for name in DEFAULTS)

    def amplitudes(times_s: Signal) -> Signal:
        controlled: Signal = np.clip(intensity * intensity_control(event.time + times_s), 0, 1) ** INTENSITY_EXPONENT
        return controlled

    def frequencies_hz(sharpnesses: Signal) -> Signal:
        in_hertz: Signal = LOWEST_HZ + (HIGHEST_HZ - LOWEST_HZ) * np.clip(sharpnesses, 0, 1)
        return in_hertz

    if event.event_type == "HapticTransient":  # only its intensity is controlled
        (amplitude,), (frequency_hz,) = amplitudes(np.zeros(1)), frequencies_hz(np.array([sharpness]))
        return transient(event.time, amplitude, TRANSIENT_CYCLES / frequency_hz)

    def values(times_s: Signal) -> Signal:
        sharpnesses = sharpness + sharpness_control(event.time + times_s)
        return wave(times_s, amplitudes(times_s), frequencies_hz(sharpnesses))

    return Part(event.time, event.time + (event.event_duration or event.duration), values)
