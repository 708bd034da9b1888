"""Plays height profiles by the position of a hand: its movement, loading, playing, and the same computed here."""

import csv
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Position, State, Status, Tap
from vibrocast.errors import InputError
from vibrocast.host import playback
from vibrocast.host.controller import Controller, ControllerError, WireFaults
from vibrocast.host.devices import Session
from vibrocast.host.picture import Trace
from vibrocast.host.playback import Captured, Playback
from vibrocast.host.report import PositionFigures, Provenance, Quality, Report, Wire
from vibrocast.host.stream_session import StreamSession, configure_steps, playable, read_capture
from vibrocast.output import profile as rendering
from vibrocast.output.actuator import SKIN_OVERSAMPLING, Codes
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

    `status`: at the end. `captured`: the DAC's codes, as far as the controller kept them. `positions`: as sent, device
    time in us and place in nm. `start_us`: device time of the first DAC sample.
    """

    status: Status
    wire_faults: WireFaults
    captured: Captured
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
    packet_samples = stream.packet_samples
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
    faults_before = controller.wire_faults
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
    captured = Captured(*read_capture(controller, Tap.DAC, stream.header.channels))
    faults = controller.wire_faults.since(faults_before)
    return Played(status, faults, captured, start_us, positions)


def play_and_compare(
    session: Session,
    file_name: str,
    stream: Stream,
    movement: Movement,
    texture: Recording | None = None,
    progress: Callable[[float], None] | None = None,
    provenance: Provenance | None = None,
) -> Playback:
    """Play a spatial stream as `play` does, compare with the same computed here, and report.

    A stream that only hosts decode is sent as `limits.carried` says; the report has the size of the given one.
    `texture`: from which the stream was coded, at its rate, None = not known. `file_name`, `provenance`: for the
    report. Raises as `play`, and CodecError.
    """
    sent = playable(stream)
    session.controller.watch_time()
    played = play(session.controller, sent, movement, progress)
    heights_um, codes = computed(session, sent, played)
    traces = _traces(session, sent, texture, played, heights_um)
    length_mm = 1e3 * stream.samples / stream.header.rate_hz
    at_end = playback.at_the_device(session, played.status, traces)
    report = Report(
        run=provenance or Provenance(),
        file=file_name,
        device=at_end.device,
        sound_card=at_end.sound_card,
        actuator=at_end.actuator,
        wire=Wire(None, None, *played.wire_faults),
        quality=Quality(skin=at_end.skin, skin_note=at_end.skin_note),
        codec=stream.codec_name,
        model=stream.model_name,
        channels=stream.header.channels,
        seconds=movement.seconds,
        stream_bytes=stream.size_bytes,
        underruns=played.status.underruns,
        packets=len(sent.packets),
        lost_packets=played.status.lost_packets,
        dac_equals_offline=as_computed(session, played, codes),
        comparison_note=session.unknown_note,
        doubt=session.controller.doubt(),
        position=PositionFigures(
            length_mm=length_mm,
            bits_per_mm=8 * stream.size_bytes / length_mm,
            fastest_mm_s=movement.fastest_mm_s,
            positions=len(played.positions),
        ),
    )
    return Playback(session, sent, report, playback.caption(session, playback.READ_BACK), traces)


def computed(
    session: Session, stream: Stream, played: Played, heights: Codes | None = None
) -> tuple[NDArray[np.float64], Codes]:
    """Return what a profile gives under the positions that were played, if all of them come in time, to the bit.

    Heights in um and the DAC's codes, both (n, channels), from its first sample on. `heights`: the profile (n,
    channels) in the stream's integers; None = as decoded. Raises CodecError.
    """
    samples = played.captured.first + len(played.captured.samples)
    profile, late = (stream.decode_integers(), stream.delay_samples) if heights is None else (heights, 0)
    under_hand, codes = rendering.render(
        stream.header, profile, late, played.positions, samples, session.driven, start_us=played.start_us
    )
    return under_hand * (np.array(stream.header.gains) / playback.DECODED_FULL_SCALE), codes


def _traces(
    session: Session, stream: Stream, texture: Recording | None, played: Played, heights_um: NDArray[np.float64]
) -> tuple[Trace, ...]:
    """Return the texture under the hand, where it is known, the decoded profile there, and what the skin does.

    Empty where nothing was read back.
    """
    first, codes = played.captured
    if not len(codes):
        return ()
    rate_hz = session.driven.dac_rate_hz
    signals = {"profile under the hand": heights_um}
    if texture is not None:
        full_scale = playback.DECODED_FULL_SCALE
        whole = np.rint(texture.samples / np.array(stream.header.gains) * full_scale)
        heights = np.clip(whole, -full_scale, full_scale - 1).astype(np.int16)
        signals = {"texture under the hand": computed(session, stream, played, heights)[0], **signals}
    skin_um, skin_rate_hz = session.skin.displacement_um(codes, SKIN_OVERSAMPLING), SKIN_OVERSAMPLING * rate_hz
    asked = [Trace(name, values[first:], rate_hz, "um", values[first:], rate_hz) for name, values in signals.items()]
    return (*asked, Trace("skin", skin_um, skin_rate_hz, "um", skin_um, skin_rate_hz))


def as_computed(session: Session, played: Played, computed: Codes) -> bool | None:
    """Return whether the DAC's codes are those computed, up to the way to rest at the end.

    None without any, for an actuator not known here, and where they differ and positions came too late or damaged.
    """
    first, codes = played.captured
    # Stop comes when it comes: from there on the output goes to rest.
    compared = len(codes) - round(_BEHIND_S * session.driven.dac_rate_hz)
    if compared <= 0 or session.unknown_note is not None:
        return None
    if Captured(first, codes[:compared]).ends(computed[: first + compared]):
        return True
    return None if played.status.underruns or played.wire_faults.bad_frames else False
