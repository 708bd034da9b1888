"""Plays height profiles by the position of a hand: its movement, loading, playing, and the same computed here."""

import csv
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Position, State, Status, Tap
from vibrocast.errors import InputError
from vibrocast.host import playback
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.limits import playable
from vibrocast.host.picture import Trace
from vibrocast.host.playback import Member
from vibrocast.host.report import SCHEMA, Provenance, StrokeReport
from vibrocast.host.skin_quality import COMPARED_S, SkinQuality, compare_channels
from vibrocast.host.stream_session import StreamSession, configure_steps, read_capture
from vibrocast.output import profile as rendering
from vibrocast.output.actuator import SKIN_OVERSAMPLING, Actuator, Codes
from vibrocast.textures import Recording

_POSITION_RATE_HZ = 500
_MAX_POSITIONS = 1_000_000
_MAX_S = _MAX_POSITIONS / _POSITION_RATE_HZ
_MAX_MM = 1e6
# Between Start and the first DAC sample, so that its time is known; and until the last position has been rendered.
_AHEAD_S, _BEHIND_S = 0.2, 0.05
# Loading ends without progress for _LOADING_S, or at fewer bytes a second than any link carries.
_LOADING_S, _MIN_LOADING_BYTES_PER_S = 5.0, 500
_LATE_S = 5.0
_READ_S, _MIN_READ_S = 0.02, 0.001
_FULL_SCALE = 32768  # of a stream's integers
# The controller's clock is at least at the time of the last Status, ten a second; the soonest of _HEARD counts. Sent
# _SENT_AFTER_S later, no position comes before its time, even if that clock is slow by 1 %.
_HEARD, _SENT_AFTER_S = 2, 0.003


@dataclass(frozen=True)
class Movement:
    """Where a hand is: `times_s` from 0 on, rising, and `positions_mm`, both float64 (n,), n >= 2."""

    times_s: NDArray[np.float64]
    positions_mm: NDArray[np.float64]

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return float(self.times_s[-1])

    @property
    def fastest_mm_s(self) -> float:
        """Its highest speed from one position to the next."""
        return float(np.max(np.abs(np.diff(self.positions_mm) / np.diff(self.times_s))))


def back_and_forth(stroke_mm: float, speed_mm_s: float, strokes: int) -> Movement:
    """Return a hand that strokes there and back along a cosine, this many `strokes`, at most at this speed."""
    seconds = strokes * math.pi * stroke_mm / speed_mm_s
    if not seconds <= _MAX_S:
        raise InputError(f"a movement of {seconds:.0f} s is too long; shorten it, by --loop, --hand or a faster hand")
    times_s = np.arange(math.ceil(seconds * _POSITION_RATE_HZ) + 2) / _POSITION_RATE_HZ
    phase = np.minimum(2 * speed_mm_s / stroke_mm * times_s, 2 * math.pi * strokes)
    return Movement(times_s, stroke_mm / 2 * (1 - np.cos(phase)))


def read_movement(path: Path) -> Movement:
    """Read a CSV file with the columns time_s and position_mm. Raises InputError, OSError."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: no file; give a CSV file of time_s,position_mm")
    rows: list[tuple[float, float]] = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = csv.reader(file)
        if [name.strip() for name in next(lines, [])] != ["time_s", "position_mm"]:
            raise InputError(f"{path}: its first line must be time_s,position_mm")
        for number, row in enumerate(lines, 2):
            try:
                time_s, position_mm = map(float, row)
            except ValueError as error:
                raise InputError(f"{path}: line {number} is not two numbers, time_s,position_mm") from error
            if not (math.isfinite(time_s) and abs(position_mm) <= _MAX_MM):
                raise InputError(f"{path}: line {number}: a position is within {_MAX_MM:g} mm, at a finite time")
            if rows and time_s <= rows[-1][0]:
                raise InputError(f"{path}: line {number}: times must rise; sort the lines and drop copies")
            if len(rows) == _MAX_POSITIONS:
                raise InputError(f"{path}: more than {_MAX_POSITIONS} positions; cut it into parts")
            rows.append((time_s, position_mm))
    if len(rows) < 2:
        raise InputError(f"{path}: a movement has at least two positions; add some")
    times_s, positions_mm = np.array(rows).T
    if not times_s[-1] - times_s[0] <= _MAX_S:
        raise InputError(f"{path}: a movement of more than {_MAX_S:.0f} s; cut it into parts")
    return Movement(times_s - times_s[0], positions_mm)


def chosen_movement(hand: float | Path, speed_mm_s: float | None, strokes: int) -> Movement:
    """Return strokes of a length in mm, or the movement in a file. Raises InputError and OSError."""
    if isinstance(hand, Path):
        if speed_mm_s or strokes != 1:
            raise InputError(f"{hand} is a whole movement; drop --hand-speed-mm-s and --loop")
        return read_movement(hand)
    if speed_mm_s is None:
        raise InputError("missing --hand-speed-mm-s; give the speed of the stroke")
    return back_and_forth(hand, speed_mm_s, strokes)


@dataclass(frozen=True)
class Played:
    """The result of a playback by position.

    `status`: at the end. `damaged`: frames that came damaged, `damaged_back`: to this computer. `dac_codes`: int16
    (n, channels) as far as the controller kept them, from sample `captured_from` on. `positions`: as sent, device time
    in us and place in nm. `start_us`: device time of the first DAC sample.
    """

    status: Status
    damaged: int
    damaged_back: int
    dac_codes: Codes
    captured_from: int
    start_us: int
    positions: tuple[tuple[int, int], ...]


def load(controller: Controller, stream: Stream) -> StreamSession:
    """Set a spatial stream up on a controller and send it until all of it has come. Raises ControllerError."""
    limits, header = controller.description.limits, stream.header
    if stream.samples * header.channels > limits.profile_samples:
        raise ControllerError(
            f"the profile has {stream.samples * header.channels} samples, and the controller holds "
            f"{limits.profile_samples}; "
            + ("update its firmware" if not limits.profile_samples else "code a shorter one, or a coarser pitch")
        )
    packet_samples = stream.decoder().packet_samples
    session = controller.run(configure_steps(controller, header, 0, packets=len(stream.packets)))
    max_bytes = limits.sendable_packet_bytes
    if max(map(len, stream.packets)) > max_bytes:
        raise ControllerError(f"the controller takes packets of at most {max_bytes} bytes; encode at a lower quality")
    until_s = controller.clock() + _LOADING_S
    end_s = until_s + sum(map(len, stream.packets)) / _MIN_LOADING_BYTES_PER_S
    while (loaded := session.status.position // packet_samples) < len(stream.packets):
        for packet in stream.packets[loaded : session.credit_until // packet_samples]:
            session.send((packet,))
        controller.request_status()
        session.news()
        if session.status.position // packet_samples > loaded:
            until_s = min(controller.clock() + _LOADING_S, end_s)
        elif controller.clock() > until_s:
            raise ControllerError("the profile does not get through to the controller; check the link")
    if session.status.lost_packets:
        raise ControllerError(
            f"the controller could not decode {session.status.lost_packets} packets of the profile; encode it again"
        )
    return session


def play(
    controller: Controller,
    stream: Stream,
    movement: Movement,
    progress: Callable[[float], None] | None = None,
) -> Played:
    """Load a spatial stream and play it under a hand that moves, in real time; read back what went to the DAC.

    The hand goes straight from each position to the next. The controller gets it 500 times a second, by its own
    clock. `progress` is called with the part done. Raises ControllerError, TransportError.
    """
    damaged_back = controller.bad_frames
    session = load(controller, stream)
    begun = controller.request_status()
    session.news()
    heard = deque([begun.device_time_us / 1e6 - controller.clock()], _HEARD)
    start_us = begun.device_time_us + round(1e6 * _AHEAD_S)
    times_s = np.arange(math.ceil(movement.seconds * _POSITION_RATE_HZ) + 1) / _POSITION_RATE_HZ
    positions = tuple(
        (start_us + round(1e6 * time_s), round(1e6 * position_mm))
        for time_s, position_mm in zip(
            times_s, np.interp(times_s, movement.times_s, movement.positions_mm), strict=True
        )
    )
    # Where the hand is before it moves is known from the beginning.
    positions = ((begun.device_time_us, positions[0][1]), *positions)
    controller.send(Position(*positions[0]))
    controller.run(session.start_steps(start_us))
    sent = 1
    whole_s = movement.seconds + _BEHIND_S
    ask_s = controller.clock()
    end_s = ask_s + _AHEAD_S + 1.1 * whole_s + _LATE_S
    try:
        while (passed_s := (now_s := controller.clock()) + max(heard) - start_us / 1e6) < whole_s:
            while sent < len(positions) and times_s[sent - 1] + _SENT_AFTER_S <= passed_s:
                controller.send(Position(*positions[sent]))
                sent += 1
            if now_s > end_s:
                raise ControllerError("the controller's clock is too slow, or stands still; restart it")
            if now_s >= ask_s:
                ask_s = now_s + min(0.1, controller.description.limits.watchdog_ms / 4000)
                controller.ask_status()
            due_s = times_s[sent - 1] + _SENT_AFTER_S if sent < len(positions) else whole_s
            controller.poll(min(_READ_S, max(_MIN_READ_S, due_s - passed_s)))
            if (status := session.news()) is not None:
                heard.append(status.device_time_us / 1e6 - controller.clock())
                if status.state not in (State.ARMED, State.PLAYING):
                    raise ControllerError(f"the controller stopped playing (state {status.state.name}); play again")
            if progress is not None:
                progress(max(0.0, passed_s / whole_s))
    finally:
        status = controller.stop()
    captured_from, codes = read_capture(controller, Tap.DAC, stream.header.channels)
    damaged = status.bad_frames - begun.bad_frames
    damaged_back = controller.bad_frames - damaged_back
    return Played(status, damaged, damaged_back, codes, captured_from, start_us, positions)


@dataclass(frozen=True)
class Computed:
    """The controller's output if all positions come in time: heights in um and codes, both (n, channels)."""

    heights_um: NDArray[np.float64]
    codes: Codes


def computed(stream: Stream, played: Played, actuator: Actuator) -> Computed:
    """Return what a profile gives under the positions that were played, to the bit. Raises CodecError."""
    samples = played.captured_from + len(played.dac_codes)
    return _rendered(stream, stream.decode_integers(), stream.decoder().delay_samples, played, samples, actuator)


def _rendered(
    stream: Stream, heights: NDArray[np.int16], delay_samples: int, played: Played, samples: int, actuator: Actuator
) -> Computed:
    """Return what heights (n, channels), in the integers of a stream, give under the positions that were played."""
    under_hand, codes = rendering.render(
        stream.header, heights, delay_samples, played.positions, samples, actuator, start_us=played.start_us
    )
    return Computed(under_hand * (np.array(stream.header.gains) / _FULL_SCALE), codes)


@dataclass(frozen=True)
class Stroke:
    """A playback under a hand, what it gives if all positions come in time, by which actuator, and the report."""

    played: Played
    expected: Computed
    actuator: Actuator
    report: StrokeReport

    @property
    def as_computed(self) -> bool | None:
        """Whether the DAC's codes are those computed; None: unknown."""
        return self.report.dac_equals_offline


def play_and_compare(
    member: Member,
    file_name: str,
    stream: Stream,
    movement: Movement,
    texture: Recording | None = None,
    bench_sha256: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Stroke:
    """Play a spatial stream as `play` does, compare with the same computed here, and report.

    A stream that only hosts decode is sent as `limits.carried` says; the report has the size of the given one.
    `texture`: from which the stream was coded, at its rate, None = not known. Raises as `play`, and CodecError.
    """
    controller, hello = member.controller, member.controller.description
    sent = playable(stream)
    played = play(controller, sent, movement, progress)
    actuator = member.actuator or playback.actuator_model(hello.actuator)
    skin_model = member.skin_model or actuator
    expected = computed(sent, played, actuator)
    length_mm = 1e3 * stream.samples / stream.header.rate_hz
    report = StrokeReport(
        schema=SCHEMA,
        run=Provenance(bench_sha256),
        version=version("vibrocast"),
        file=file_name,
        codec=stream.codec_name,
        model=stream.model_name,
        channels=stream.header.channels,
        length_mm=length_mm,
        stream_bytes=stream.size_bytes,
        bits_per_mm=8 * stream.size_bytes / length_mm,
        seconds=movement.seconds,
        fastest_mm_s=movement.fastest_mm_s,
        positions=len(played.positions),
        underruns=played.status.underruns,
        bad_frames=played.damaged,
        bad_frames_back=played.damaged_back,
        skin=_skin_quality(sent, texture, played, expected, actuator, skin_model),
        device=playback.device_description(member.address, hello),
        sound_card=controller.sound_card,
        actuator=playback.actuator_use(actuator, skin_model, played.status),
        dac_equals_offline=as_computed(played, expected, actuator),
    )
    return Stroke(played, expected, skin_model, report)


def _skin_quality(
    stream: Stream, texture: Recording | None, played: Played, expected: Computed, actuator: Actuator, skin: Actuator
) -> SkinQuality | None:
    """Return how the skin moves against the texture under the hand, in the beginning; None where nothing is read back.

    `skin`: the actuator that moves it.
    """
    if not len(played.dac_codes):
        return None
    first = played.captured_from
    end = min(first + len(played.dac_codes), first + round(COMPARED_S * actuator.dac_rate_hz))
    asked = [expected.heights_um[first:end]]
    if texture is not None:
        whole = np.rint(texture.samples / np.array(stream.header.gains) * _FULL_SCALE)
        heights = np.clip(whole, -_FULL_SCALE, _FULL_SCALE - 1).astype(np.int16)
        asked.insert(0, _rendered(stream, heights, 0, played, end, actuator).heights_um[first:])
    moved = skin.displacement_um(played.dac_codes[: end - first], SKIN_OVERSAMPLING)
    return compare_channels(asked, actuator.dac_rate_hz, moved, SKIN_OVERSAMPLING * actuator.dac_rate_hz)


def as_computed(played: Played, expected: Computed, actuator: Actuator) -> bool | None:
    """Return whether the DAC's codes are those computed, up to the way to rest at the end.

    None without any, and where they differ and positions came too late or damaged.
    """
    first = played.captured_from
    # Stop comes when it comes: from there on the output goes to rest.
    compared = len(played.dac_codes) - round(_BEHIND_S * actuator.dac_rate_hz)
    if compared <= 0:
        return None
    if np.array_equal(played.dac_codes[:compared], expected.codes[first : first + compared]):
        return True
    return None if played.status.underruns or played.damaged else False


def pictured(played: Played, expected: Computed, actuator: Actuator) -> tuple[str, tuple[Trace, ...]]:
    """Return the caption and the traces of a picture: the profile under the hand, and what the actuator makes of it."""
    rate_hz = actuator.dac_rate_hz
    heights_um = expected.heights_um[played.captured_from :]
    skin_um, skin_rate_hz = actuator.displacement_um(played.dac_codes, SKIN_OVERSAMPLING), SKIN_OVERSAMPLING * rate_hz
    caption = f"skin: the DAC's codes, read back, through the model of the actuator {actuator.name}"
    return caption, (
        Trace("profile under the hand", heights_um, rate_hz, "um", heights_um, rate_hz),
        Trace("skin", skin_um, skin_rate_hz, "um", skin_um, skin_rate_hz),
    )
