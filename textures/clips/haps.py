"""Reads `.haps` clips of version 5 (Interhaptics, Razer): melodies of notes."""

from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, field

from vibrocast.textures.clips.documents import Seconds, left_out, polyline, read_json
from vibrocast.textures.clips.synthesis import (
    MAX_PARTS,
    TRANSIENT_CYCLES,
    TRANSIENT_S,
    Channel,
    Clip,
    Part,
    transient,
    wave,
)
from vibrocast.textures.recording import Signal, TextureError

VERSION = "5"
MISSING_HZ = 182.5
"""Of a note without frequencies: the middle of the usual range, 65 to 300 Hz."""

Gain = Annotated[float, Meta(ge=0)]


def _key(name: str) -> str:
    """Return the key of a field: m_startingPoint for starting_point."""
    first, *others = name.split("_")
    return "m_" + first + "".join(map(str.capitalize, others))


class _Keyframe(Struct, rename=_key):
    value: float
    time: Seconds = 0.0
    in_slope: float = 0.0
    out_slope: float = 0.0


class _Modulation(Struct, rename=_key):
    keyframes: list[_Keyframe] = []


class _Effect(Struct, rename=_key):
    """Without a modulation of the amplitude, it is a transient."""

    amplitude_modulation: _Modulation | None = None
    frequency_modulation: _Modulation = field(default_factory=_Modulation)


class _Note(Struct, rename=_key):
    haptic_effect: _Effect
    starting_point: Seconds = 0.0
    length: Seconds = 0.0
    gain: Gain = 1.0


class _Melody(Struct, rename=_key):
    notes: Annotated[list[_Note], Meta(max_length=MAX_PARTS)] = []
    mute: int = 0
    gain: Gain = 1.0


class _Vibration(Struct, rename=_key):
    melodies: list[_Melody] = []
    gain: Gain = 1.0
    loop: int = 0


class _Unread(Struct, rename=_key):
    """A perception that is no vibration over time."""

    melodies: list[dict[str, Any]] = []


class _Document(Struct, rename=_key):
    version: str
    vibration: _Vibration
    stiffness: _Unread = field(default_factory=_Unread)
    texture: _Unread = field(default_factory=_Unread)
    gain: Gain = 1.0


def read(data: bytes) -> Clip:
    """Return the vibration that a `.haps` file of version 5 describes.

    Raises ValueError, TextureError, msgspec.DecodeError and RecursionError.
    """
    document = read_json(data, _Document)
    if document.version != VERSION:
        raise TextureError(
            f"version {document.version[:10]} of the format, and only {VERSION} is known",
            action="open it in Haptic Composer, and save it again",
        )
    vibration = document.vibration
    skipped = {"m_loop"} if vibration.loop else set()
    for name, unread in (("m_stiffness", document.stiffness), ("m_texture", document.texture)):
        if any(melody.get("m_notes") for melody in unread.melodies):
            skipped.add(name)
    parts = []
    for melody in vibration.melodies:
        for note in () if melody.mute else melody.notes:
            parts.append(_part(note, document.gain * vibration.gain * melody.gain * note.gain, skipped))
    constants = (
        f"a transient = {TRANSIENT_CYCLES} cycles in {1000 * TRANSIENT_S:g} ms; all gains multiply; a note without "
        f"frequencies has {MISSING_HZ:g} Hz"
    )
    return Clip([Channel([parts])], (constants, *left_out(skipped)))


def _part(note: _Note, gain: float, skipped: set[str]) -> Part:
    """Return a note as a part; add to the names of what was left out."""
    effect = note.haptic_effect
    if effect.amplitude_modulation is None:
        return transient(note.starting_point, gain)
    keyframes = (effect.amplitude_modulation.keyframes, effect.frequency_modulation.keyframes)
    if any(each.in_slope or each.out_slope for modulation in keyframes for each in modulation):
        skipped.add("m_inSlope and m_outSlope")
    amplitude, frequency = (
        polyline([(each.time, each.value) for each in modulation] or [(0.0, missing)], name)
        for modulation, missing, name in zip(keyframes, (0.0, MISSING_HZ), ("amplitudes", "frequencies"), strict=True)
    )

    def values(times_s: Signal) -> Signal:
        return wave(times_s, gain * np.interp(times_s, *amplitude), np.interp(times_s, *frequency))

    return Part(note.starting_point, note.starting_point + note.length, values)
