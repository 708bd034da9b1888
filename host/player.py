"""Plays coded packets on one controller or on many: fed under credit, watched, resumed after a pulled cable."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.encoding import GrowingPackets
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import CaptureData, State, Status, StatusRequest, Tap
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import ANSWER_TIMEOUT_S, ConnectionLost, Controller, ControllerError, Steps, WireFaults
from vibrocast.host.stream_session import (
    READ_BACK_S,
    SLOWEST_BYTES_PER_S,
    Capture,
    CaptureOverwritten,
    StreamSession,
    check_limits,
    check_packet,
    configure_steps,
    queue_steps,
)

# Longer than a busy computer keeps a program waiting, as a rule; all of it is delay between host and skin.
BUFFER_S = 0.3
RECONNECT_S = 10.0
"""How long a player tries to open a lost connection again."""

# Enough packets to make the frame's own bytes small, few enough that a lost frame costs little.
_MAX_FRAME_PACKETS = 8
_MAX_STATUS_INTERVAL_S = 0.25
_MIN_WAIT_S = 0.001
_TURN_S = 0.02
_SILENCE_S = 2.0  # a controller that says nothing for so long is lost
# A playback lasts at most its duration, times 1 + 2 _SLOWNESS, and _STALL_S and _MAX_OUTAGES_S more.
_STALL_S, _MAX_OUTAGES_S = 5.0, 60.0
_SLOWNESS = 0.1
# From the end of an outage until the controller plays again.
_RESTART_S = 1.0
# At most so much is played again after an outage, so that the rest can be decoded.
_MAX_REPEATED_S = 1.0


@dataclass(frozen=True)
class Progress:
    """Where a playback is, in time that it really plays; `duration_s` is None for one that loops until stopped."""

    position_s: float
    duration_s: float | None
    buffered_s: float
    status: Status


@dataclass(frozen=True)
class PlaybackResult:
    """The result of a playback.

    `state`: FINISHED, or STOPPED if someone stopped it. `seconds`: from start to end. `buffered_s`: mean time that
    data waited in the controller. `wire_bytes_*`: all bytes of this playback on the transport. `underruns`,
    `lost_packets`, `reconnects` and `wire_faults` count over all of it; `status` is the last one. `decoded` (int16,
    stream rate) and
    `dac_codes` (int16, DAC rate), both (samples, channels), are the controller's capture; None if not required, or if
    the controller overwrote samples before they could be read.
    `captured_from`: its first packet, counted over all loops; 0 unless the controller started again after a loss.
    `altered`: whether this host has paused or stopped it, or changed its gain, while it played. `following`: the
    stream that the controller goes on with, for `PlaybackSettings.begun`; None = it came to rest.
    """

    state: State
    status: Status
    seconds: float
    buffered_s: float
    wire_bytes_sent: int
    wire_bytes_received: int
    underruns: int
    lost_packets: int
    wire_faults: WireFaults
    reconnects: int
    captured_from: int
    decoded: NDArray[np.int16] | None
    dac_codes: NDArray[np.int16] | None
    altered: bool
    following: "Following | None" = None


class Playable(Protocol):
    """A coded stream over time. `packets`: of one pass. `packet_samples`: samples per channel of each packet."""

    @property
    def header(self) -> StreamHeader:
        """The facts that a decoder needs."""

    @property
    def packets(self) -> Sequence[bytes]:
        """The packets, numbered from 0."""

    @property
    def packet_samples(self) -> int:
        """The samples per channel in every packet."""


@dataclass
class Following:
    """A stream that waits behind another, and how many of its packets were sent."""

    session: StreamSession
    stream: Playable
    sent: int = 0


@dataclass(frozen=True)
class PlaybackSettings:
    """How to play.

    `loops`: how often, 0 = until stopped. `buffer_s`: how much the controller holds before it begins and while it
    plays, as far as its own buffer and credit go. `reconnect_s`: how long a broken connection is opened again. If the
    controller has run out of data meanwhile, playing goes on where it was, from a random-access packet shortly before.
    With `start_steps`, and where there is no such packet, it goes on in time, at the next one.
    `capture`: read back what is played. `progress`: called in this thread whenever the controller reports. It may
    `request` a Pause, Resume or Gain, or `stop` the controller. It may not request a Loop, because this host would send
    no data for it. `compensation`: whether the controller compensates its actuator's response. `gain`: by which it
    multiplies. `first_packet`: a random-access packet at which playing begins. `prebuffer_s`: how much the controller
    holds before it begins; None = `buffer_s`. `start_steps`: return the device time of the begin, in us; None = at
    once. `turn`: called in this thread at least every _TURN_S. It may do what `progress` may do, and raise, to end the
    playback. `next_stream`: returns the stream that is to follow without a gap, None = none is known yet. `begun`: the
    stream waited behind another, and the controller has gone on with it.
    """

    loops: int = 1
    buffer_s: float = BUFFER_S
    reconnect_s: float = RECONNECT_S
    capture: bool = False
    progress: Callable[[Progress], None] | None = None
    compensation: bool = True
    gain: float = 1.0
    first_packet: int = 0
    prebuffer_s: float | None = None
    start_steps: Callable[[Controller], Steps[int]] | None = None
    turn: Callable[[], None] | None = None
    next_stream: Callable[[], Playable | None] | None = None
    begun: Following | None = None


def play(controller: Controller, stream: Playable, settings: PlaybackSettings | None = None) -> PlaybackResult:
    """Play a stream to its end, as `play_steps` does, and return what happened."""
    return controller.run(play_steps(controller, stream, settings or PlaybackSettings()))


def play_steps(controller: Controller, stream: Playable, settings: PlaybackSettings) -> Steps[PlaybackResult]:
    """Play a stream to its end, as steps of an event loop that may play on other controllers too.

    Whatever is raised, KeyboardInterrupt included, the controller is stopped first. Raises StreamError for packets that
    make no stream, or none that the controller takes, ControllerError, TransportError and MessageError.
    """
    source = _Source(controller, stream, settings.loops)
    sent_before, received_before = controller.bytes_sent, controller.bytes_received
    faults_before = controller.wire_faults
    started_s = controller.clock()
    reconnects, came_back_at = 0, -1
    pace = _Pace(controller)
    try:
        if settings.begun is None:
            senders = [(yield from _begin_steps(controller, source, settings, settings.first_packet, pace))]
        else:
            senders = [_Sender(settings.begun.session, source, settings, 0, pace, settings.begun.sent)]
        counted = senders[0].status
        while True:
            last = senders[-1]
            try:
                yield from last.send_steps()
                break
            except (TransportError, ConnectionLost) as cause:
                if last.position <= came_back_at:
                    raise  # nothing was gained by coming back
                came_back_at, lost_s = last.position, last.heard_s
                yield from controller.reconnect_steps(settings.reconnect_s)
                reconnects += 1
                if not (yield from last.goes_on_steps()):
                    first = last.refresh_to_go_on_from(cause)
                    senders.append((yield from _begin_steps(controller, source, settings, first, pace)))
                pace.note_outage(lost_s)
        if settings.capture:
            yield from last.read_captures_to_their_end_steps()
    except GeneratorExit:
        raise
    except BaseException:
        # Where the controller is out of reach, its own watchdog stops it.
        with contextlib.suppress(ControllerError, TransportError):
            yield from controller.stop_steps()
        raise
    reports = sum(sender.reports_playing for sender in senders)
    counts_before = (counted.underruns, counted.lost_packets) if settings.begun else (0, 0)
    return PlaybackResult(
        state=State.FINISHED if last.following else last.status.state,
        status=last.status,
        seconds=controller.clock() - started_s,
        buffered_s=sum(sender.buffered_s_sum for sender in senders) / max(1, reports),
        wire_bytes_sent=controller.bytes_sent - sent_before,
        wire_bytes_received=controller.bytes_received - received_before,
        underruns=sum(sender.status.underruns for sender in senders) - counts_before[0],
        lost_packets=sum(sender.status.lost_packets for sender in senders) - counts_before[1],
        wire_faults=controller.wire_faults.since(faults_before),
        reconnects=reconnects,
        captured_from=last.first,
        decoded=last.captured(Tap.DECODED),
        dac_codes=last.captured(Tap.DAC),
        altered=controller.altered,
        following=last.following,
    )


class _Source:
    """The packets over all loops: packet k is number k % n of iteration k // n.

    `packet_s`: mean time that a packet plays. Where iterations join, what is not of the recording is left out of its
    packet, though positions count it.
    """

    def __init__(self, controller: Controller, stream: Playable, loops: int) -> None:
        """Check the stream. Raises StreamError, and ControllerError for a stream that never fits the controller."""
        header, packets, packet_samples = stream.header, stream.packets, stream.packet_samples
        check_limits(controller, header.channels, header.rate_hz)
        if not packets or header.samples == 0:
            raise StreamError("the stream has no packets or no samples; encode the recording again")
        check_packet(controller, packet_samples)
        self.header = header
        self.packets = packets
        self.packet_samples = packet_samples
        self.loops = loops
        self.end = loops * len(packets) if loops else None
        self.packet_s = packet_samples / header.rate_hz
        if loops != 1 and header.samples is not None:
            self.packet_s = min(self.packet_s, header.samples / len(packets) / header.rate_hz)
        max_bytes = controller.description.limits.sendable_packet_bytes
        # Packets that are still to be coded are right.
        for number, packet in enumerate(packets[:1] if isinstance(packets, GrowingPackets) else packets):
            sequence, _ = packet_sequence(packet)
            if sequence != number:
                raise StreamError(
                    f"packet {number} has the number {sequence}: packets are missing; copy the file again"
                )
            if len(packet) > max_bytes:
                raise ControllerError(
                    f"packet {number} has {len(packet)} bytes, and the controller takes {max_bytes}; encode at a lower "
                    "rate"
                )
        if not packet_sequence(packets[0])[1]:
            raise StreamError(
                "the stream cannot be decoded: it does not begin with a random-access packet; encode it again"
            )

    def packets_ahead(self, controller: Controller, buffer_s: float) -> tuple[int, int]:
        """Return how many packets the controller is to hold, and as many of them as it has room for.

        At least the current packet and the next, however long. One more where the last one of an iteration may be
        almost empty.
        """
        least = 3 if self.packet_s < self.packet_samples / self.header.rate_hz else 2
        ahead = max(least, int(buffer_s / self.packet_s))
        return ahead, min(ahead, controller.description.limits.buffer_samples // self.packet_samples)

    def seconds(self, positions: int) -> float:
        """Return the time that samples take to play, as positions count them."""
        return positions / self.packet_samples * self.packet_s

    def next_refresh(self, packet: int) -> int | None:
        """Return the first refresh packet at or after `packet`, None if the stream ends before it."""
        refresh = packet
        while not packet_sequence(self.packets[refresh % len(self.packets)])[1]:
            refresh += 1
        return refresh if self.end is None or refresh < self.end else None


class _Pace:
    """Checks that a playback comes on, so that waiting for its end ends, whatever the controller reports.

    The controller may be behind the clock by _STALL_S, its outages, and a part _SLOWNESS of the time played. The
    time in which it rests does not count while this host wants it to pause.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._heard_s, self._counted_s = controller.clock(), 0.0
        self._played_s = self._outages_s = 0.0

    def check(self, played_s: float, rests: bool) -> None:
        """Take in how much has been played by now. Raises ControllerError if it should be more."""
        now_s = self._controller.clock()
        if not (rests and self._controller.may_pause):
            self._counted_s += now_s - self._heard_s
        self._heard_s = now_s
        self._played_s = max(self._played_s, played_s)
        if self._counted_s > _STALL_S + self._outages_s + (1 + _SLOWNESS) * self._played_s:
            raise ControllerError(
                f"the controller has played only {self._played_s:.1f} s of the stream in {self._counted_s:.1f} s; "
                "restart it"
            )

    def note_outage(self, began_s: float) -> None:
        """Take in that the controller was out of reach until now. Raises ControllerError if it was so for too long."""
        self._outages_s += self._controller.clock() - began_s + _RESTART_S
        if self._outages_s > _MAX_OUTAGES_S + _SLOWNESS * self._played_s:
            raise ControllerError(
                f"the controller has been out of reach for {self._outages_s:.0f} s in all; check its cable"
            )


def _begin_steps(
    controller: Controller, source: _Source, settings: PlaybackSettings, first: int, pace: _Pace
) -> Steps["_Sender"]:
    """Set up and start the stream from packet `first` on, a random-access packet; return who sends it."""
    _, buffer_packets = source.packets_ahead(controller, settings.buffer_s)
    prebuffer_s = settings.buffer_s if settings.prebuffer_s is None else settings.prebuffer_s
    prebuffer_packets, _ = source.packets_ahead(controller, prebuffer_s)
    iteration, first_packet = divmod(first, len(source.packets))
    session = yield from configure_steps(
        controller,
        source.header,
        min(buffer_packets, prebuffer_packets) * source.packet_samples,
        packets=len(source.packets),
        first_packet=first_packet,
        loops=source.loops - iteration if source.loops else 0,
        compensation=settings.compensation,
        gain=settings.gain,
    )
    at_us = 0 if settings.start_steps is None else (yield from settings.start_steps(controller))
    yield from session.start_steps(at_us)
    return _Sender(session, source, settings, first, pace)


class _Sender:
    """Sends what is played under one Configure, from packet `first` on.

    `reports_playing`, `buffered_s_sum`: how many Status came while it played, and the sum of the time that data waited
    in the controller then. `heard_s`: when the last Status came.
    """

    def __init__(
        self,
        session: StreamSession,
        source: _Source,
        settings: PlaybackSettings,
        first: int,
        pace: _Pace,
        sent: int = 0,
    ) -> None:
        """`sent`: how many packets were sent already, where the stream waited behind another."""
        ahead_packets, buffer_packets = source.packets_ahead(session.controller, settings.buffer_s)
        self.following: Following | None = None
        self._asked_for_next = False
        self._session = session
        self._controller = controller = session.controller
        self._source = source
        self._settings = settings
        self._ahead_packets = ahead_packets
        # Waiting for a full frame must not empty the buffer.
        self._frame_packets = max(1, min(_MAX_FRAME_PACKETS, buffer_packets // 4))
        # Often enough for the watchdog, and to learn in time that playing has begun where the notification was lost.
        # A controller that tells its status as often need not be asked, unless captures are read back in time by it.
        self._max_silence_s = controller.description.limits.watchdog_ms / 4000
        self._status_interval_s = min(_MAX_STATUS_INTERVAL_S, self._max_silence_s, buffer_packets * source.packet_s / 2)
        self._ask_s = self._free_s = self._sent_s = 0.0
        self._pending_tap: Tap | None = None
        self.reports_playing, self.buffered_s_sum = 0, 0.0
        # Those of which everything could be read so far.
        self._captures = {tap: Capture(controller, tap, source.header.channels) for tap in Tap if settings.capture}
        self._base = first - first % len(source.packets)  # where the controller's positions begin
        self.first, self._next = first, max(first, sent)
        self._pace = pace
        self.heard_s = controller.clock()
        self._held_until = self.position  # what the controller has played or held

    @property
    def status(self) -> Status:
        """The last one."""
        return self._session.status

    @property
    def position(self) -> int:
        """Where the controller was when it last reported, counted over all loops."""
        return self._base * self._source.packet_samples + self.status.position

    def send_steps(self) -> Steps[None]:
        """Send as far as the credit reaches, and receive, until the playback has ended."""
        while self.status.state not in (State.FINISHED, State.STOPPED) and not self._is_followed():
            if self._settings.turn is not None:
                self._settings.turn()
            now_s = self._controller.clock()
            if now_s - self.heard_s > _SILENCE_S:
                raise ConnectionLost(f"the controller has not answered for {_SILENCE_S:g} s; check that it has power")
            self._pace.check(self._source.seconds(self.position), rests=self.status.state == State.PAUSED)
            has_sent = self._send_frame() or self._send_ahead()
            if self.following is None and self._settings.next_stream is not None and self._next == self._source.end:
                yield from self._queue_steps(self._settings.next_stream)
            if now_s >= self._free_s:
                self._ask(now_s)
            answer = yield from self._controller.poll_steps(0.0 if has_sent else self._wait_s(now_s))
            if answer is not None:
                self._free_s = now_s = self._controller.clock()
            if isinstance(answer, CaptureData) and self._pending_tap is not None:
                tap, self._pending_tap = self._pending_tap, None  # a second copy may follow
                self._take(tap, answer)
                if not answer.data:
                    self._free_s = self._ask_s  # nothing new, as far as is known, before the next status
            if self._session.news() is not None:
                self._note()
                if not self._settings.capture:
                    self._ask_s = min(self.heard_s + self._status_interval_s, self._sent_s + self._max_silence_s)
                if self._settings.progress is not None:
                    self._settings.progress(self._progress())

    def _is_followed(self) -> bool:
        """Return whether the controller has gone on with the stream behind this one."""
        status = self._controller.status
        return self.following is not None and status is not None and status.stream == self.following.session.number

    def _queue_steps(self, next_stream: Callable[[], Playable | None]) -> Steps[None]:
        """Set up the stream that follows, once it is known and if the controller can go on with it without a gap."""
        if self._asked_for_next or (found := next_stream()) is None:
            return
        self._asked_for_next = True
        settings = self._settings
        session = yield from queue_steps(
            self._session, found.header, len(found.packets), compensation=settings.compensation, gain=settings.gain
        )
        if session is not None:
            self.following = Following(session, found)

    def _send_ahead(self) -> bool:
        """Send the next packet of the stream that follows, if it has credit; return whether it did."""
        following = self.following
        if following is None or self._controller.is_sending:
            return False
        following.session.news()
        packets = following.stream.packets
        if (following.sent + 1) * following.stream.packet_samples > following.session.credit_until:
            return False
        if following.sent >= min(len(packets), self._ahead_packets):
            return False
        following.session.send([packets[following.sent]])
        following.sent += 1
        self._sent_s = self._controller.clock()
        return True

    def goes_on_steps(self) -> Steps[bool]:
        """Ask a controller that was out of reach whether it still plays this stream, or the one behind it by now."""
        status = yield from self._controller.request_steps(StatusRequest(), Status)
        if self.following is not None:
            if self._is_followed() or status.queued is not None:
                self.following.sent = 0  # frames under way may be lost; the controller drops second copies
            else:
                self.following, self._asked_for_next = None, False  # it has begun again
        if self._is_followed():
            return True
        if status.stream != self._session.number:
            return False
        ran_out = self._base * self._source.packet_samples + status.position > self._held_until
        if ran_out and status.state == State.PLAYING and self._refresh_before_gap() is not None:
            return False
        if status.state in (State.ARMED, State.PLAYING, State.PAUSED, State.FINISHED, State.STOPPED):
            # Frames under way when the connection broke may be lost. The controller drops packets that it has already.
            self._next = min(self._next, self._base + status.position // self._source.packet_samples)
            self._session.news()
            self._note()
            return True
        if status.state == State.WATCHDOG and self._refresh_before_gap() is None:
            self._session.news()  # what was lost is not played again
        return False

    def _refresh_before_gap(self) -> int | None:
        """Return the last random-access packet before the controller ran out of data.

        None where it is too far back, and where controllers play in step.
        """
        if self._settings.start_steps is not None:
            return None
        source, packet = self._source, self._held_until // self._source.packet_samples
        refresh = source.next_refresh(max(self.first, packet - int(_MAX_REPEATED_S / source.packet_s)))
        while refresh is not None and (later := source.next_refresh(refresh + 1)) is not None and later <= packet:
            refresh = later
        return refresh if refresh is not None and refresh <= packet else None

    def refresh_to_go_on_from(self, cause: Exception) -> int:
        """Return the random-access packet to go on from. Raises ControllerError if there is none."""
        refresh = self._refresh_before_gap()
        if refresh is None:
            refresh = self._source.next_refresh(-(-self.position // self._source.packet_samples))
        if refresh is None:
            raise ControllerError(
                "the connection was lost for too long, and no later packet can be decoded alone; play the recording "
                "itself, which is coded for such a link"
            ) from cause
        return refresh

    def captured(self, tap: Tap) -> NDArray[np.int16] | None:
        """Return what a tap captured, int16 (samples, channels); None if not all of it could be read."""
        return self._captures[tap].samples() if tap in self._captures else None

    def read_captures_to_their_end_steps(self) -> Steps[None]:
        """Read back what is left of the captures. Raises ControllerError if that takes too long."""
        left = sum(
            captured_by_now + rate_hz - self._captures[tap].samples_read
            for tap, captured_by_now, rate_hz in self._taps()
        )
        left_bytes = 2 * self._source.header.channels * max(0, left)
        until_s = self._controller.clock() + READ_BACK_S + left_bytes / SLOWEST_BYTES_PER_S
        for tap, captured_by_now, rate_hz in self._taps():
            # The output comes to rest within a second; a longer capture is none of this stream.
            more = True
            while more and tap in self._captures and self._captures[tap].samples_read < captured_by_now + rate_hz:
                try:
                    more = yield from self._captures[tap].read_steps(until_s)
                except CaptureOverwritten:
                    more = False
                    del self._captures[tap]

    def _take(self, tap: Tap, answer: CaptureData) -> None:
        """Take in a frame of a capture. Give up a capture that was overwritten."""
        if tap not in self._captures:
            return
        try:
            self._captures[tap].take(answer)
        except CaptureOverwritten:
            del self._captures[tap]

    def _send_frame(self) -> bool:
        """Send the next packets that credit and one frame have room for, if it is time; return whether it did."""
        source = self._source
        iteration, number = divmod(self._next, len(source.packets))
        granted = min(self._credit_packets(), self._playing() + self._ahead_packets - (self._next - self._base))
        if granted < (self._min_packets() if self.status.state == State.PLAYING else 1) or self._controller.is_sending:
            return False
        chosen = source.packets[number : number + min(self._frame_packets, granted)]
        chosen = chosen[: self._session.fitting(chosen)]
        self._next += len(chosen)
        self._session.send(chosen, iteration - self._base // len(source.packets))
        self._sent_s = self._controller.clock()
        return True

    def _min_packets(self) -> int:
        """Return how many packets to wait for: a full frame, or the rest of the iteration."""
        return min(self._frame_packets, len(self._source.packets) - self._next % len(self._source.packets))

    def _credit_packets(self) -> int:
        """Return how many packets are left to be sent and have credit."""
        until = self._base + self._session.credit_until // self._source.packet_samples
        return (until if self._source.end is None else min(until, self._source.end)) - self._next

    def _wait_s(self, now_s: float) -> float:
        """Return for how long there is nothing to send, unless something comes."""
        until_s = min(
            self._free_s if self._tap_to_read() is not None else max(self._free_s, self._ask_s),
            self.heard_s + _SILENCE_S,
        )
        if self.status.state == State.PLAYING and not self._controller.is_sending:
            packets = self._min_packets()
            if self._credit_packets() >= packets:
                playing = self._next - self._base + packets - self._ahead_packets
                until_s = min(until_s, self._playing_at_s(playing))
        if self._settings.turn is not None:
            until_s = min(until_s, now_s + _TURN_S)
        return max(_MIN_WAIT_S, until_s - now_s)

    def _playing_at_s(self, packet: int) -> float:
        """Return when the controller, which plays, begins to play a packet, counted as in its positions."""
        return self.heard_s + (packet - self.status.position / self._source.packet_samples) * self._source.packet_s

    def _playing(self) -> int:
        """Return the packet that the controller is playing by now, counted as in its positions."""
        packets = self.status.position / self._source.packet_samples
        if self.status.state == State.PLAYING:
            packets += (self._controller.clock() - self.heard_s) / self._source.packet_s
        return int(packets)

    def _note(self) -> None:
        """Take in the last status of this stream."""
        source, status = self._source, self.status
        if source.end is not None and self._base + status.position / source.packet_samples > source.end:
            raise ControllerError(
                "the controller plays beyond the end of the stream, by a Loop sent to it or a fault; restart it"
            )
        self.heard_s = self._controller.clock()
        if status.state != State.WATCHDOG:  # its position counts the silence, too
            self._held_until = max(self._held_until, self.position + status.buffered_samples)
        if status.state == State.WATCHDOG:
            watchdog_ms = self._controller.description.limits.watchdog_ms
            raise ConnectionLost(
                f"the controller stopped, because it heard nothing for {watchdog_ms} ms; use a less busy machine"
            )
        if status.state == State.PLAYING:
            self.reports_playing += 1
            self.buffered_s_sum += source.seconds(status.buffered_samples)
        playing = self._base + status.position // source.packet_samples
        if playing > self._next:
            # Too late for the packets between: the controller is silent until the next refresh, if any.
            self._next = source.next_refresh(playing) or playing

    def _progress(self) -> Progress:
        source = self._source
        return Progress(
            position_s=source.seconds(self.position),
            duration_s=None if source.end is None else source.seconds(source.end * source.packet_samples),
            buffered_s=source.seconds(self.status.buffered_samples),
            status=self.status,
        )

    def _taps(self) -> list[tuple[Tap, int, int]]:
        """Return each tap to read, about how many samples it has captured by now, and how many it captures a second."""
        source = self._source
        positions = self.status.position - (self.first - self._base) * source.packet_samples
        dac_rate_hz = self._controller.description.actuator.dac_rate_hz
        taps = [
            (Tap.DECODED, positions, source.header.rate_hz),
            (Tap.DAC, int(source.seconds(positions) * dac_rate_hz), dac_rate_hz),
        ]
        return [tap for tap in taps if tap[0] in self._captures]

    def _ask(self, now_s: float) -> None:
        """Ask for the status, or for a frame of a capture that the controller would soon overwrite.

        Neither waits for the answer, so that a lost one does not hold up the data.
        """
        if now_s >= self._ask_s:
            self._sent_s, self._ask_s = now_s, now_s + self._status_interval_s
            self._free_s = now_s + min(ANSWER_TIMEOUT_S, self._status_interval_s)
            self._controller.ask_status()
        elif (tap := self._tap_to_read()) is not None:
            self._pending_tap = tap
            self._free_s = now_s + ANSWER_TIMEOUT_S
            self._controller.ask_once(self._captures[tap].request())

    def _tap_to_read(self) -> Tap | None:
        """Return the tap whose capture the controller would soon overwrite; None if neither."""
        unread = {tap: captured_by_now - self._captures[tap].samples_read for tap, captured_by_now, _ in self._taps()}
        tap = max(unread, key=lambda tap: unread[tap], default=None)
        return (
            tap if tap is not None and unread[tap] > self._controller.description.limits.capture_samples // 4 else None
        )
