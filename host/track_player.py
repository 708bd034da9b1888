"""Plays tracks one after another on a controller, and does meanwhile what a person or a program asks for.

Tracks are found in files, folders and lists, and opened for a controller while the one before plays.
"""

import queue
import random
import threading
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, GrowingStream, begin_encoding
from vibrocast.codec.stream import Stream, read_stream, with_gain
from vibrocast.codec.threshold import PHYSICAL_UNITS, filtered, read_threshold, skin_filter
from vibrocast.device_protocol.coded_stream import STREAM_SUFFIX, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import Gain, Pause, Resume, State, Status, StatusRequest
from vibrocast.errors import InputError
from vibrocast.files import read_input
from vibrocast.host import event_loop, playback, player, uploader
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError, Sleep, Steps
from vibrocast.host.devices import Session
from vibrocast.host.playback import Playback, output_delay_s
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.report import Provenance
from vibrocast.host.stream_session import CARRIED_STEP, check_limits, check_unit, fitted, packet_limit, playable
from vibrocast.textures import dataset

_Key = TypeVar("_Key", bound=Hashable)

Source: TypeAlias = Path | Stream | textures.Recording
"""What a track is made of."""
LIST_SUFFIXES = (".m3u", ".m3u8")
LEVEL_S = 0.05
"""A level of a track is that of so long a part."""
_SILENT_DB = -120.0
_HEADROOM = 4.0
"""The full scale of a track in a list, in its peak: the codec loses nothing by it."""
_MAX_LIST_BYTES = 10_000_000

PREBUFFER_S = 0.05
"""A controller begins to play with so much of a track; the buffer then grows to `player.BUFFER_S`, and after a gap
to twice as much."""
MAX_CHANGE_DB = 60.0
"""Most that commands change the level, up or down."""
_RESTART_S = 2.0
"""Later in a track than this, "previous" goes to its beginning."""
_IDLE_S = 0.02
_SETTLED_S = 0.5
# Players of a group wait for one another for so long; they begin so long after the last one is here, which measures its
# controller's clock by so many requests. The soonest answer counts.
_WAIT_S, _AHEAD_S, _TRIPS = 2.0, 0.15, 3

WORDS = {
    "pause": "stay where it is",
    "resume": "go on",
    "toggle": "pause or resume",
    "seek": "move by so many seconds",
    "gain": "change the level by so many dB",
    "next": "play the next track",
    "previous": "play the track before, or this one from its beginning",
    "loop": "repeat the list without end, or no longer",
    "stop": "end",
}
"""The commands, and what each does; "seek" and "gain" take a number."""
_WITH_NUMBER = ("seek", "gain")


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


@dataclass(frozen=True)
class Command:
    """A command of WORDS, with its number if it takes one."""

    word: str
    number: float = 0.0


def command_of(line: str) -> Command:
    """Return the command in a line such as "seek -1". Raises InputError."""
    word, _, rest = line.strip().partition(" ")
    if word not in WORDS:
        raise InputError(f"there is no command {word!r}; give one of {', '.join(WORDS)}")
    try:
        number = float(rest) if word in _WITH_NUMBER else 0.0
        if (rest and word not in _WITH_NUMBER) or not abs(number) < float("inf"):
            raise ValueError
    except ValueError:
        form = f"{word} NUMBER" if word in _WITH_NUMBER else word
        raise InputError(f"{line.strip()!r} is no command; give {form}") from None
    return Command(word, number)


class Remote:
    """Takes commands from any thread, for one player or several."""

    def __init__(self) -> None:
        self._queues: list[queue.SimpleQueue[Command]] = []

    def commands(self) -> "queue.SimpleQueue[Command]":
        """Return the commands to another player."""
        self._queues.append(queue.SimpleQueue())
        return self._queues[-1]

    def send(self, command: Command) -> None:
        """Give a command, which the players carry out within some 20 ms."""
        for commands in self._queues:
            commands.put(command)


Kind = Literal["track", "pass", "position", "paused", "resumed", "gain", "loop", "failed", "ended"]


@dataclass(frozen=True)
class Event:
    """What a player tells.

    Attributes:
        kind: "track": one has begun; "pass": it begins again, by itself; "position": it goes on; "failed": it cannot be
            played; "ended": nothing more is played. The others say that a command was carried out.
        track: The name of the track.
        number: Its number in the list, from 1.
        tracks: How many there are.
        position_s: Where it is, in s.
        seconds: The duration of the track in s.
        skin_s: When that is felt, as `time.time` counts.
        paused: Whether it rests there.
        gain_db: The change of level by commands, in dB.
        level_db: The level now, None where it is not known yet.
        level_of: What `level_db` is the level of, and relative to what.
        buffered_s: How much the controller holds, in s.
        lost_packets: Of this track.
        underruns: Of this track.
        error: Why the track cannot be played.
    """

    kind: Kind
    track: str = ""
    number: int = 0
    tracks: int = 0
    position_s: float = 0.0
    seconds: float = 0.0
    skin_s: float = 0.0
    paused: bool = False
    gain_db: float = 0.0
    level_db: float | None = None
    level_of: str = ""
    buffered_s: float = 0.0
    lost_packets: int = 0
    underruns: int = 0
    error: Exception | None = None


class PlayedTrack(NamedTuple):
    """A track, and how it was played to its end."""

    track: Track
    result: player.PlaybackResult


class _Jump(Exception):
    """Ends the track under way, to go on at another place of the list; `place`: None = nowhere."""

    def __init__(self, place: int | None, position_s: float = 0.0) -> None:
        self.place, self.position_s = place, position_s


class Group:
    """Players on several controllers that begin each track at one time, within the asymmetry of their links."""

    def __init__(self, players: int) -> None:
        self._players, self._arrived = players, 0
        self._start_s: float | None = None

    def leave(self) -> None:
        """No longer wait for one of the players."""
        self._players -= 1

    def start_steps(self, controller: Controller) -> Steps[int]:
        """Wait until all players are here, or for _WAIT_S; return the time of the controller to begin at, in us."""
        trips = []
        for _ in range(_TRIPS):
            asked_s = controller.clock()
            status = yield from controller.request_steps(StatusRequest(), Status)
            took_s = controller.clock() - asked_s
            trips.append((took_s, status.device_time_us - 1e6 * (asked_s + took_s / 2)))
        if self._start_s is not None and self._start_s <= controller.clock():
            self._start_s, self._arrived = None, 0  # of the track before
        self._arrived += 1
        self._begin_if_all_are_here(controller.clock())
        until_s = controller.clock() + _WAIT_S
        while self._start_s is None and controller.clock() < until_s:
            yield Sleep(_IDLE_S / 10)
            self._begin_if_all_are_here(controller.clock())  # one may have left
        begins_s = self._start_s if self._start_s is not None else controller.clock()
        return round(1e6 * begins_s + min(trips)[1])

    def _begin_if_all_are_here(self, now_s: float) -> None:
        if self._start_s is None and self._arrived >= self._players:
            self._start_s = now_s + _AHEAD_S


class TrackPlayer:
    """Plays a list of tracks.

    Attributes:
        gain_db: The change of level by commands, in dB.
        played: The tracks that were played to their end.
        failures: By name, why tracks could not be played.
    """

    def __init__(
        self,
        session: Session,
        sources: Sequence[Source],
        options: TrackOptions,
        *,
        remote: Remote | None = None,
        tell: Callable[[Event], None] | None = None,
        capture: bool = False,
        group: Group | None = None,
    ) -> None:
        """`tell`: called with each Event in the player's thread. `group`: with which it begins tracks.

        `capture`: read back what the controller plays.
        """
        self.gain_db = 0.0
        self.played: list[PlayedTrack] = []
        self.failures: dict[str, Exception] = {}
        self._session = session
        self._sources = list(sources)
        self._order = list(range(len(self._sources)))
        self._options = options
        # The controller itself repeats a single track, without a gap.
        track_loops, list_loops = (options.loops, 1) if len(self._sources) == 1 else (1, options.loops)
        self._passes_left = list_loops - 1 if list_loops else None
        self._commands = (remote or Remote()).commands()
        self._tell = tell or (lambda event: None)
        self._settings = player.PlaybackSettings(
            loops=track_loops,
            capture=capture,
            reconnect_s=options.reconnect_s,
            prebuffer_s=PREBUFFER_S,
            progress=self._progress,
            turn=self._turn,
            next_stream=None if len(self._sources) == 1 else self._next_stream,
            start_steps=None if group is None else group.start_steps,
        )
        self._group = group
        self._place, self._position_s = 0, 0.0
        self._track: Track | None = None
        self._now: player.Progress | None = None
        self._begun, self._passes = False, 0
        self._paused = False
        self._pool = ThreadPoolExecutor(2, "tracks")  # one opens tracks while the other computes levels
        self._ended = False
        self._opening: dict[int, Future[Track]] = {}  # by the number of the source
        self._playing = -1
        self._queued: player.Following | None = None
        self._levels: Future[tuple[NDArray[np.float64], str]] | None = None
        if options.shuffle:
            random.shuffle(self._order)

    def steps(self) -> Steps[None]:
        """Play all. Raises ControllerError and TransportError if the controller fails."""
        place: int | None = 0
        start_s, failed_in_turn = 0.0, 0
        try:
            while place is not None:
                self._place, self._position_s, self._now = place, start_s, None
                self._begun, self._passes = False, 0
                try:
                    yield from self._play_steps(self._opened(place), start_s)
                    failed_in_turn, place, start_s = 0, self._following(), 0.0
                except _Jump as jump:
                    place, start_s, self._queued = jump.place, jump.position_s, None
                except (InputError, OSError, ControllerError) as error:
                    if isinstance(error, ConnectionLost):
                        raise
                    name = name_of(self._sources[self._order[self._place]])
                    self.failures[name] = error
                    self._tell(self._event("failed", error))
                    failed_in_turn += 1
                    place, start_s = (self._following() if failed_in_turn < len(self._order) else None), 0.0
            if self._queued is not None:  # a command has ended the list meanwhile
                yield from self._session.controller.stop_steps()
        finally:
            if self._group is not None:
                self._group.leave()
            self._ended = True
            self._pool.shutdown(cancel_futures=True)
        self._tell(self._event("ended"))

    def _opened(self, place: int) -> Track:
        """Return the track at a place of the list. Raises as `open_track`."""
        source = self._order[place]
        opening = self._opening.get(source) or self._open(source)
        if opening is not self._opening.get(self._playing):
            self._levels = None
        self._playing, self._opening = source, {source: opening}
        self._track = opening.result()
        return self._track

    def _open(self, source: int) -> Future[Track]:
        """Begin to open a track, with the full scale of the one that plays where it fits, so that it can follow it."""
        controller, alone = self._session.controller, len(self._sources) == 1
        before = None if self._track is None or alone else self._track.stream.header
        return self._pool.submit(open_track, self._sources[source], controller, self._options, alone, before)

    def _play_steps(self, track: Track, start_s: float) -> Steps[None]:
        """Play a track from a time on, to its end. Raises _Jump at a command, and as `player.play_steps`."""
        while self._paused:
            self._turn()
            yield Sleep(_IDLE_S)
        first = track.refresh_before(start_s)
        if first is None and start_s > 0:
            self._track = track = track.seekable()
            first = track.refresh_before(start_s)
        if track.stream.image is not None:
            uploader.provide(self._session.controller, self._session.address, track.stream.image)
        begun, self._queued = self._queued, None
        settings = replace(
            self._settings, first_packet=first or 0, gain=10 ** (self.gain_db / 20), begun=begun if not first else None
        )
        result = yield from player.play_steps(self._session.controller, track, settings)
        self._queued = result.following
        self.played.append(PlayedTrack(track, result))

    def _next_stream(self) -> Track | None:
        """Return what follows this track without a gap, if it is open by now."""
        if self._place + 1 < len(self._order):
            source = self._order[self._place + 1]
        elif self._passes_left != 0 and not self._options.shuffle:
            source = self._order[0]
        else:
            return None
        opening = self._opening.get(source)
        if opening is None or not opening.done() or opening.exception() is not None:
            return None
        track = opening.result()
        return None if track.stream.image is not None else track  # a model may have to be uploaded first

    def _following(self) -> int | None:
        """Return the place behind this one; None at the end of the last pass."""
        if self._place + 1 < len(self._order):
            return self._place + 1
        if self._passes_left == 0:
            return None
        if self._passes_left is not None:
            self._passes_left -= 1
        if self._options.shuffle:
            random.shuffle(self._order)
        return 0

    def _turn(self) -> None:
        """Carry out commands. Raises _Jump, and as `Controller.request`."""
        while not self._commands.empty():
            self._do(self._commands.get())
        controller = self._session.controller
        state = controller.status.state if controller.status is not None and self._begun else None
        if self._paused and state == State.PLAYING:
            controller.request(Pause(), Status)
            self._tell(self._event("paused"))
        elif not self._paused and state == State.PAUSED:
            controller.request(Resume(), Status)
            self._tell(self._event("resumed"))

    def _do(self, command: Command) -> None:
        """Carry out a command. Raises as `_turn`."""
        match command.word:
            case "pause" | "resume" | "toggle":
                self._paused = command.word == "pause" or (command.word == "toggle" and not self._paused)
            case "gain":
                self.gain_db = min(max(self.gain_db + command.number, -MAX_CHANGE_DB), MAX_CHANGE_DB)
                if self._begun:
                    self._session.controller.request(Gain(10 ** (self.gain_db / 20)), Status)
                self._tell(self._event("gain"))
            case "seek":
                wanted_s = max(0.0, self._position_s + command.number)
                if self._track is not None and wanted_s >= self._track.seconds:
                    raise _Jump(self._following())
                raise _Jump(self._place, wanted_s)
            case "next":
                raise _Jump(self._following())
            case "previous":
                raise _Jump(self._place if self._position_s > _RESTART_S else max(0, self._place - 1))
            case "loop":
                self._passes_left = 0 if self._passes_left is None else None
                self._tell(self._event("loop"))
            case "stop":
                raise _Jump(None)

    def _progress(self, now: player.Progress) -> None:
        self._now = now
        if now.status.state not in (State.PLAYING, State.PAUSED):
            return
        self._position_s = now.position_s
        if self._track is not None:
            loops = self._settings.loops != 1
            self._position_s = min(
                now.position_s % self._track.seconds if loops else now.position_s, self._track.seconds
            )
        if not self._begun:
            self._begun = True
            self._tell(self._event("track"))
        if self._track is not None and (passes := int(now.position_s // self._track.seconds)) > self._passes:
            self._passes = passes
            if self._settings.loops != 1:
                self._tell(self._event("pass"))
        if self._levels is None and self._track is not None and self._position_s > _SETTLED_S:
            # Work beside the player only where a full buffer bridges it.
            track = self._track
            self._levels = self._pool.submit(track.levels, self._raise_if_ended)
            following = self._order[(self._place + 1) % len(self._order)]
            if following not in self._opening:
                self._opening[following] = self._open(following)
        self._tell(self._event("position"))

    def _raise_if_ended(self, part: float) -> None:
        """End the work of another thread once nobody needs it."""
        if self._ended:
            raise _Jump(None)

    def _event(self, kind: Kind, error: Exception | None = None) -> Event:
        """Return an event at the position that was last reported."""
        track, now = self._track, self._now
        level_db, level_of = None, ""
        known = self._levels if self._levels is not None and self._levels.done() else None
        if track is not None and known is not None and not (known.cancelled() or known.exception()):
            levels, level_of = known.result()
            level_db = float(levels[min(int(self._position_s / LEVEL_S), len(levels) - 1)]) + self.gain_db
        late_s = 0.0 if track is None else output_delay_s(track.header, self._session.driven)
        return Event(
            kind=kind,
            track=name_of(self._sources[self._order[self._place]]),
            number=self._order[self._place] + 1,
            tracks=len(self._sources),
            position_s=self._position_s,
            seconds=0.0 if track is None else track.seconds,
            skin_s=time.time() + late_s,
            paused=self._paused,
            gain_db=self.gain_db,
            level_db=level_db,
            level_of=level_of,
            buffered_s=0.0 if now is None else now.buffered_s,
            lost_packets=0 if now is None else now.status.lost_packets,
            underruns=0 if now is None else now.status.underruns,
            error=error,
        )


@dataclass(frozen=True)
class PlayedList:
    """How a controller played a list.

    Attributes:
        played: The tracks that were played to their end.
        failures: By name, why tracks could not be played.
        playback: Of a single track that was played to its end, compared with the same computed here; None otherwise.
    """

    played: list[PlayedTrack]
    failures: Mapping[str, Exception]
    playback: Playback | None


def play_list(
    sessions: Mapping[_Key, Session],
    sources: Sequence[Source],
    options: TrackOptions,
    *,
    remote: Remote | None = None,
    tell: Callable[[_Key, Event], None] | None = None,
    provenance: Provenance | None = None,
) -> dict[_Key, PlayedList | Exception]:
    """Play a list on all controllers, which begin each track at one time; return by key what each did, or its error.

    The parameters are those of `TrackPlayer`. The error of a single track that cannot be played is that of the list.
    """
    group = Group(len(sessions)) if len(sessions) > 1 else None
    players = {}
    for key, session in sessions.items():
        session.controller.watch_time()
        players[key] = TrackPlayer(
            session,
            sources,
            options,
            remote=remote,
            tell=tell and partial(tell, key),
            capture=len(sources) == 1 and options.loops != 0,
            group=group,
        )
    works = {key: (sessions[key].controller, each.steps()) for key, each in players.items()}
    results: dict[_Key, PlayedList | Exception] = {}
    for key, error in event_loop.run_all(works).items():
        each, alone = players[key], len(sources) == 1
        if isinstance(error, Exception):
            results[key] = error
        elif alone and each.failures:
            results[key] = next(iter(each.failures.values()))
        else:
            compared = None
            if alone and each.played:
                ((track, result),) = each.played
                compared = _compared(sessions[key], track, result, options.loops, provenance or Provenance())
            results[key] = PlayedList(each.played, each.failures, compared)
    return results


def _compared(
    session: Session, track: Track, result: player.PlaybackResult, loops: int, provenance: Provenance
) -> Playback:
    """Return what a controller did with a track, compared with the same computed here. Raises CodecError."""
    stream, encoding = track.stream, None
    if isinstance(stream, GrowingStream):
        encoding = stream.finished()
        stream = encoding.stream
    stream = stream.with_gain(track.gain_db)
    played = playback.compared(session, track.name, stream, encoding, loops, result, provenance)
    return replace(played, given_samples=track.given_samples)


class BackgroundPlayer:
    """A player in a thread of its own.

    Attributes:
        player: What plays.
        remote: Takes commands.
    """

    def __init__(
        self, session: Session, sources: Sequence[Source], options: TrackOptions, tell: Callable[[Event], None] | None
    ) -> None:
        """Begin to play; the parameters are those of TrackPlayer."""
        self.remote = Remote()
        self.player = TrackPlayer(session, sources, options, remote=self.remote, tell=tell)
        self._controller = session.controller
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    @property
    def has_ended(self) -> bool:
        """Whether nothing more is played."""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Wait for the end. Raises what ended the player."""
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self._controller.run(self.player.steps())
        except BaseException as error:  # told by `wait`
            self._error = error
