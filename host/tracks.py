"""Tracks that play one after another: found in files, folders and lists, and opened for a controller."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, GrowingStream, begin_encoding
from vibrocast.codec.stream import Stream, read_stream, with_gain
from vibrocast.codec.threshold import PHYSICAL_UNITS, filtered, read_threshold, skin_filter
from vibrocast.device_protocol.coded_stream import StreamHeader, packet_sequence
from vibrocast.errors import InputError
from vibrocast.files import read_input
from vibrocast.host.controller import Controller
from vibrocast.host.limits import CARRIED_STEP, check_limits, check_unit, fitted, packet_limit, playable
from vibrocast.host.player import RECONNECT_S
from vibrocast.textures import dataset

Source: TypeAlias = Path | Stream | textures.Recording
"""What a track is made of."""
STREAM_SUFFIX = ".vct"
LIST_SUFFIXES = (".m3u", ".m3u8")
LEVEL_S = 0.05
"""A level of a track is that of so long a part."""
_SILENT_DB = -120.0
_HEADROOM = 4.0
"""The full scale of a track in a list, in its peak: the codec loses nothing by it."""
_MAX_LIST_BYTES = 10_000_000


def tracks_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files to play, in order: those given, those of folders by name, those that .m3u lists name.

    Raises InputError for a list that cannot be read, and for a folder or list without a track; OSError.
    """
    tracks: list[Path] = []
    for path in paths:
        if path.suffix.lower() in LIST_SUFFIXES:
            found = _listed(path)
        elif path.is_dir():
            found = [each for each in path.rglob("*") if each.suffix.lower() == STREAM_SUFFIX]
            try:
                found += [entry.path for entry in dataset.entries(path)]
            except InputError:
                if not found:
                    raise
            found.sort()
        else:
            found = [path]
        if not found:
            raise InputError(f"{path}: it names no track; write the path of a file on each line")
        tracks += found
    return tracks


def _listed(path: Path) -> list[Path]:
    """Return the files that an .m3u list names, from its folder. Raises InputError, OSError."""
    text = read_input(path, "list of tracks (.m3u)", b"", _MAX_LIST_BYTES).decode("utf-8-sig", errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    return [path.parent / line for line in lines if line and not line.startswith("#")]


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """How tracks are opened, and how a list of them plays.

    Attributes:
        facts: The arguments of `textures.load` for recordings.
        arguments: The arguments of `begin_encoding` for recordings.
        model: For a .vct file whose model does not ship.
        from_s: Where each track begins, in s.
        to_s: Where each track ends, in s; None: at its end.
        gain_db: Change of level in dB.
        loops: How often the list plays; 0: without end.
        shuffle: Whether it plays in random order, another one each time.
        reconnect_s: For how long a lost connection is opened again; 0: the list ends.
    """

    facts: Mapping[str, Any] = field(default_factory=dict)
    arguments: Mapping[str, Any] = field(default_factory=dict)
    model: models.Model | None = None
    from_s: float = 0.0
    to_s: float | None = None
    gain_db: float = 0.0
    loops: int = 1
    shuffle: bool = False
    reconnect_s: float = RECONNECT_S


@dataclass(frozen=True)
class Track:
    """A track that is ready to play, at a change of level in dB; `stream` may still be coded while it plays.

    `given_samples`: samples per channel of its packets before they were split for the controller; 0 = they were not.
    """

    name: str
    stream: Stream | GrowingStream
    gain_db: float = 0.0
    given_samples: int = 0

    @cached_property
    def header(self) -> StreamHeader:
        """The stream's header, at the track's level."""
        return with_gain(self.stream.header, self.gain_db)

    @property
    def packets(self) -> Sequence[bytes]:
        """The stream's packets."""
        return self.stream.packets

    @property
    def packet_samples(self) -> int:
        """The samples per channel in every packet."""
        return self.stream.packet_samples

    @property
    def seconds(self) -> float:
        """Its duration in s."""
        return (self.header.samples or len(self.packets) * self.packet_samples) / self.header.rate_hz

    def refresh_before(self, position_s: float) -> int | None:
        """Return the last random-access packet that begins at or before a position; None if only the first one does."""
        packet = min(int(position_s * self.header.rate_hz / self.packet_samples), len(self.packets) - 1)
        while packet > 0 and not packet_sequence(self.packets[packet])[1]:
            packet -= 1
        return packet or None

    def seekable(self) -> "Track":
        """Return the track in packets at which playing can begin, four a second; a coded one is coded again."""
        if isinstance(self.stream, GrowingStream):
            return self
        return replace(self, stream=_recoded(self.stream.recording(self.name)))

    def levels(self, progress: Callable[[float], None]) -> tuple[NDArray[np.float64], str]:
        """Return the level of each LEVEL_S in dB, and of what: the skin re threshold, or the signal re full scale.

        `progress`: called from time to time with the part that is decoded; it may raise, to end the work.
        """
        stream = self.stream
        recording = stream.recording if isinstance(stream, GrowingStream) else stream.recording(self.name, progress)
        samples, part = recording.samples, max(1, round(LEVEL_S * recording.rate_hz))
        felt = recording.unit in PHYSICAL_UNITS
        if felt:
            taps = skin_filter(recording.rate_hz, recording.unit, read_threshold(), len(samples))
            samples = filtered(np.pad(samples, ((0, len(taps) // 2), (0, 0))), taps)[len(taps) // 2 :]
        power = np.add.reduceat(np.max(np.square(samples), axis=1), np.arange(0, len(samples), part)) / part
        # The threshold is that of a sinusoid's amplitude; its power is half the square of it.
        return 10 * np.log10(
            np.maximum(2 * power, 10 ** (_SILENT_DB / 10))
        ), "re threshold" if felt else "re full scale"


def name_of(source: Source) -> str:
    """Return the name of a track, for people."""
    if isinstance(source, Path):
        return source.name
    return "stream" if isinstance(source, Stream) else source.name


def read_source(source: Source, options: TrackOptions) -> Stream | textures.Recording:
    """Return a stream that controllers decode, or a recording that is to be coded.

    Raises InputError with its kinds for one that no controller plays over time, and OSError.
    """
    place = source if isinstance(source, Path) else name_of(source)
    if isinstance(source, Path) and source.suffix.lower() == STREAM_SUFFIX:
        source = read_stream(source, options.model.image if options.model else None)
    if isinstance(source, Stream):
        if source.header.spatial:
            raise InputError(f"{place}: coded over position; give --hand, and --hand-speed-mm-s for a stroke")
        check_unit(source.header.unit, options.facts.get("unit"))
        _ = source.tables  # raises where the model is not here
        return playable(source)
    recording = textures.load(source, **options.facts) if isinstance(source, Path) else source
    if recording.axes:
        raise InputError(
            f"{place}: three axes of one texture; encode it with --columns z, dft321 or norm, or x,y,z for an actuator "
            "for each axis; then play the .vct file"
        )
    check_unit(recording.unit, "drive" if recording.drive else options.facts.get("unit"))
    return recording


def open_track(
    source: Source,
    controller: Controller,
    options: TrackOptions,
    alone: bool = True,
    before: StreamHeader | None = None,
) -> Track:
    """Open a track, so that it can play at once on a controller. Raises as `read_source`, also where it cannot.

    `alone`: False = others follow it, so its full scale leaves room for louder ones. `before`: the stream before it,
    whose full scale it takes where it fits.
    """
    name, known = name_of(source), read_source(source, options)
    if isinstance(known, Stream):
        if options.from_s or options.to_s is not None:
            return Track(name, _recoded(_cut(known.recording(name), options)), options.gain_db)
        return Track(name, fitted(controller, known), options.gain_db, known.packet_samples)
    check_limits(controller, known.channels, options.arguments.get("stream_rate_hz", DEFAULT_STREAM_RATE_HZ))
    recording = _cut(known, options)
    least = 0.0 if alone else _HEADROOM * float(np.max(np.abs(recording.samples), initial=0.0))
    if before is not None and before.unit == recording.unit and len(before.gains) == recording.channels:
        least = before.gains[0]
    growing = begin_encoding(recording, least_full_scale=least, **options.arguments)
    if growing.packet_samples <= packet_limit(controller.description.limits):
        return Track(name, growing, options.gain_db)
    return Track(name, fitted(controller, growing.finished().stream), options.gain_db)


def _cut(recording: textures.Recording, options: TrackOptions) -> textures.Recording:
    """Return the part of a recording between two times. Raises InputError where there is none."""
    end_s = recording.seconds if options.to_s is None else min(options.to_s, recording.seconds)
    first, last = (round(each * recording.rate_hz) for each in (options.from_s, end_s))
    if not first < last:
        raise InputError(
            f"{recording.name}: it lasts {recording.seconds:.3g} s, and nothing is between {options.from_s:g} and "
            f"{end_s:g} s; choose other times"
        )
    return replace(recording, samples=recording.samples[first:last])


def _recoded(recording: textures.Recording) -> GrowingStream:
    """Return what was decoded, coded again with an error far below the first one's. Raises CodecError."""
    steps = codec.codec_by_name(codec.DEFAULT_CODEC).steps
    assert steps is not None, "the default codec has steps"
    setting = {steps.parameter: CARRIED_STEP}
    return begin_encoding(recording, round(recording.rate_hz), setting=setting, highpass_hz=None, touch=0)
