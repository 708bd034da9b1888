"""Plays coded packets on a controller: fed under credit, watched, resumed after a pulled cable. No threads."""

import bisect
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import CaptureData, Configure, Start, State, Status, StreamData, Tap, pack
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import ANSWER_TIMEOUT_S, ConnectionLost, Controller, ControllerError

# Longer than a busy computer keeps a program waiting, as a rule; all of it is delay between host and skin.
BUFFER_S = 0.3
RECONNECT_S = 10.0

# Enough packets to make the frame's own bytes small, few enough that a lost frame costs little.
_LARGEST_FRAME_PACKETS = 8
_LONGEST_VARINT_BYTES = 5
_LONGEST_STATUS_INTERVAL_S = 0.25
_READ_S = 0.02
_SILENCE_S = 2.0
_STALL_S = 5.0


@dataclass(frozen=True)
class Progress:
    """Where a playback is, in time that it really plays; `duration_s` is None for one that loops until stopped."""

    position_s: float
    duration_s: float | None
    buffered_s: float
    status: Status


@dataclass(frozen=True)
class PlaybackResult:
    """What a playback did.

    `state`: FINISHED, or STOPPED if someone stopped it. `seconds`: from start to end. `buffered_s`: mean time that
    data waited in the controller. `wire_bytes_*`: all bytes of this playback on the transport. `underruns`,
    `lost_packets` and `reconnects` count over all of it; `status` is the last one. `decoded` (int16, stream rate) and
    `dac_codes` (int16, DAC rate), both (samples, channels), are the controller's capture from packet `captured_from`
    (counted over all loops) on: 0 unless a lost connection made the controller start anew; None if not asked for.
    """

    state: State
    status: Status
    seconds: float
    buffered_s: float
    wire_bytes_sent: int
    wire_bytes_received: int
    underruns: int
    lost_packets: int
    reconnects: int
    captured_from: int
    decoded: NDArray[np.int16] | None
    dac_codes: NDArray[np.int16] | None


def play(
    controller: Controller,
    header: StreamHeader,
    packets: Sequence[bytes],
    packet_samples: int,
    *,
    loops: int = 1,
    gain: float = 1.0,
    compensation: bool = True,
    buffer_s: float = BUFFER_S,
    reconnect_s: float = RECONNECT_S,
    capture: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> PlaybackResult:
    """Play packets to their end and return what happened.

    `loops`: how often, 0 = until stopped. `buffer_s`: how much the controller holds before it begins and while it
    plays, as far as its own buffer and credit go. `progress` is called in this thread whenever the controller reports,
    and may itself use the controller: `request` a Pause, Resume or Gain, or `stop` it; but no Loop, for which this host
    would send no data. Whatever is raised, KeyboardInterrupt included, the controller is stopped first. A broken
    connection is opened anew for `reconnect_s`; if the controller has given up meanwhile, playing (also what was
    paused) goes on at the next refresh packet.

    Raises StreamError for packets that make no stream, or none that the controller takes, ControllerError,
    TransportError and MessageError.
    """
    source = _Source(controller, header, packets, packet_samples, loops)
    settings = _Settings(gain, compensation, buffer_s, capture, progress)
    sent_before, received_before = controller.bytes_sent, controller.bytes_received
    started_s = controller.clock()
    reconnects, came_back_at = 0, -1
    try:
        stretches = [_Stretch(controller, source, settings, 0)]
        while True:
            last = stretches[-1]
            try:
                if last.step():
                    break
            except (TransportError, ConnectionLost) as cause:
                if last.position <= came_back_at:
                    raise  # nothing was gained by coming back
                came_back_at = last.position
                controller.reconnect(reconnect_s)
                reconnects += 1
                if not last.goes_on():
                    stretches.append(_Stretch(controller, source, settings, last.refresh_to_go_on_from(cause)))
        if capture:
            last.read_captures_to_their_end()
    except BaseException:
        # Where the controller is out of reach, its own watchdog stops it.
        with contextlib.suppress(ControllerError, TransportError):
            controller.stop()
        raise
    reports = sum(stretch.reports_playing for stretch in stretches)
    return PlaybackResult(
        state=last.status.state,
        status=last.status,
        seconds=controller.clock() - started_s,
        buffered_s=sum(stretch.buffered_s_sum for stretch in stretches) / max(1, reports),
        wire_bytes_sent=controller.bytes_sent - sent_before,
        wire_bytes_received=controller.bytes_received - received_before,
        underruns=sum(stretch.status.underruns for stretch in stretches),
        lost_packets=sum(stretch.status.lost_packets for stretch in stretches),
        reconnects=reconnects,
        captured_from=last.first,
        decoded=last.captured(Tap.DECODED) if capture else None,
        dac_codes=last.captured(Tap.DAC) if capture else None,
    )


def check_limits(controller: Controller, channels: int, rate_hz: int) -> None:
    """Raise StreamError, with the limit, if the controller cannot play a stream of these channels and this rate."""
    limits = controller.description.limits
    if channels > limits.channels:
        raise StreamError(f"{channels} channels, the controller has {limits.channels}: leave some out of the recording")
    if not limits.minimum_rate_hz <= rate_hz <= limits.maximum_rate_hz:
        raise StreamError(
            f"a stream of {rate_hz} Hz, the controller takes {limits.minimum_rate_hz} to {limits.maximum_rate_hz} Hz: "
            "encode with another `stream_rate_hz`"
        )


def check_packet(controller: Controller, packet_samples: int) -> None:
    """Raise ControllerError if the controller's buffer does not hold a packet of so many samples."""
    buffer_samples = controller.description.limits.buffer_samples
    if packet_samples > buffer_samples:
        raise ControllerError(
            f"a packet has {packet_samples} samples, the controller's buffer {buffer_samples}: "
            "encode with shorter packets"
        )


class _Source:
    """The packets over all loops: packet k is number k % n of iteration k // n.

    `packet_s`: mean time that a packet plays. Where iterations join, what is not of the recording is left out of its
    packet, though positions count it.
    """

    def __init__(
        self, controller: Controller, header: StreamHeader, packets: Sequence[bytes], packet_samples: int, loops: int
    ) -> None:
        """Check the stream. Raises StreamError, and ControllerError for what never fits the controller."""
        limits = controller.description.limits
        check_limits(controller, header.channels, header.rate_hz)
        if not packets or header.samples == 0:
            raise StreamError("the stream has no packets or no samples: there is nothing to play")
        check_packet(controller, packet_samples)
        self.header = header
        self.packets = packets
        self.packet_samples = packet_samples
        self.loops = loops
        self.end = loops * len(packets) if loops else None
        self.packet_s = packet_samples / header.rate_hz
        if loops != 1 and header.samples is not None:
            self.packet_s = min(self.packet_s, header.samples / len(packets) / header.rate_hz)
        self._refreshes: list[int] = []
        frame_bytes = len(pack(StreamData(0, 0, ()))) + 2 * _LONGEST_VARINT_BYTES
        largest_bytes = min(limits.maximum_packet_bytes, limits.maximum_payload_bytes - frame_bytes)
        for number, packet in enumerate(packets):
            sequence, refresh = packet_sequence(packet)
            if sequence != number:
                raise StreamError(
                    f"packet {number} says that it is {sequence}: the stream has lost packets, get it anew"
                )
            if len(packet) > largest_bytes:
                raise ControllerError(
                    f"packet {number} has {len(packet)} bytes, the controller takes {largest_bytes}: "
                    "encode at a lower rate"
                )
            if refresh:
                self._refreshes.append(number)
        if self._refreshes[:1] != [0]:
            raise StreamError("the stream does not begin with a refresh packet: it cannot be decoded")

    def seconds(self, positions: int) -> float:
        """Return the time that it takes to play so many samples, as positions count them."""
        return positions / self.packet_samples * self.packet_s

    def next_refresh(self, packet: int) -> int | None:
        """Return the first refresh packet at or after `packet`, None if the stream ends before it."""
        iteration, number = divmod(packet, len(self.packets))
        at = bisect.bisect_left(self._refreshes, number)
        refresh = (iteration + 1) * len(self.packets)
        if at < len(self._refreshes):
            refresh = iteration * len(self.packets) + self._refreshes[at]
        return refresh if self.end is None or refresh < self.end else None


@dataclass(frozen=True)
class _Settings:
    """How to play; as in `play`."""

    gain: float
    compensation: bool
    buffer_s: float
    capture: bool
    progress: Callable[[Progress], None] | None


class _Stretch:
    """What is played under one Configure, from packet `first` on.

    `status`: the last one. `reports_playing`, `buffered_s_sum`: how many came while it played, and the sum of the time
    that data waited in the controller then.
    """

    def __init__(self, controller: Controller, source: _Source, settings: _Settings, first: int) -> None:
        """Set the stream up and start it."""
        self._controller = controller
        self._source = source
        self._settings = settings
        limits = controller.description.limits
        # What is played and the next one, however long packets are, where the controller has room for it; and one more
        # where the packet at the end of an iteration may be cut to almost nothing.
        least_packets = 3 if source.packet_s < source.packet_samples / source.header.rate_hz else 2
        self._ahead_packets = max(least_packets, int(settings.buffer_s / source.packet_s))
        self._buffer_packets = min(self._ahead_packets, limits.buffer_samples // source.packet_samples)
        # Waiting for a full frame must not empty the buffer.
        self._frame_packets = max(1, min(_LARGEST_FRAME_PACKETS, self._buffer_packets // 4))
        # Often enough for the watchdog, and to learn in time that playing has begun where the notification was lost.
        self._status_interval_s = min(
            _LONGEST_STATUS_INTERVAL_S, limits.watchdog_ms / 4000, self._buffer_packets * source.packet_s / 2
        )
        self._ask_s = self._free_s = 0.0
        self._asked_tap: Tap | None = None
        self.reports_playing, self.buffered_s_sum = 0, 0.0
        self._captures: dict[Tap, list[NDArray[np.int16]]] = {tap: [] for tap in Tap}
        self._captured_samples = dict.fromkeys(Tap, 0)
        iteration, first_packet = divmod(first, len(source.packets))
        self._base = iteration * len(source.packets)  # where the controller's positions begin
        self.first = self._next = first
        self._stream = (controller.request_status().stream + 1) % 256
        configure = Configure(
            stream=self._stream,
            header=source.header.pack(),
            prebuffer_samples=self._buffer_packets * source.packet_samples,
            packets=len(source.packets),
            first_packet=first_packet,
            loops=source.loops - iteration if source.loops else 0,
            compensation=settings.compensation,
            gain=settings.gain,
        )
        self.status = controller.request(configure, Status)
        self._credit = self.status.credit_until
        self._furthest = self.status.position
        self._noted_s = self._moved_s = controller.clock()
        controller.request(Start(), Status)

    @property
    def position(self) -> int:
        """Where the controller was when it last reported, counted over all loops."""
        return self._base * self._source.packet_samples + self.status.position

    def step(self) -> bool:
        """Send a frame if there is credit, take in what came; return whether the playback has ended."""
        now_s = self._controller.clock()
        if now_s - self._noted_s > _SILENCE_S:
            raise ConnectionLost(f"the controller has not answered for {_SILENCE_S:g} s. Check that it has power.")
        if now_s - self._moved_s > _STALL_S:
            raise ControllerError(f"the controller's position has not moved for {_STALL_S:g} s. Restart it.")
        data = self._next_data()
        if data is not None:
            self._controller.send(data)
        if now_s >= self._free_s:
            self._ask(now_s)
        answer = self._controller.poll(0 if data is not None else min(_READ_S, self._status_interval_s))
        if answer is not None:
            self._free_s = now_s
        if isinstance(answer, CaptureData) and self._asked_tap is not None:
            tap, self._asked_tap = self._asked_tap, None  # a second copy may follow
            offset, channels = self._captured_samples[tap], self._source.header.channels
            self._keep(self._controller.checked_capture(answer, tap, offset, channels), tap)
            if not answer.data:
                self._free_s = self._ask_s  # nothing new, as far as is known, before the next status
        status = self._controller.status
        if status is not None and status is not self.status and status.stream == self._stream:
            self._note(status)
            if self._settings.progress is not None:
                self._settings.progress(self._progress())
        return self.status.state in (State.FINISHED, State.STOPPED)

    def goes_on(self) -> bool:
        """Take in what a controller that was out of reach is doing; return whether it still plays this stretch."""
        status = self._controller.request_status()
        if status.stream != self._stream:
            return False
        if status.state in (State.ARMED, State.PLAYING, State.PAUSED, State.FINISHED, State.STOPPED):
            # What was under way when the connection broke may be lost; the controller drops what it has twice.
            self._next = min(self._next, self._base + status.position // self._source.packet_samples)
            self._note(status)
            return True
        if status.state == State.WATCHDOG:
            self.status = status
        return False

    def refresh_to_go_on_from(self, cause: Exception) -> int:
        """Return the first refresh packet that was not played. Raises ControllerError if there is none."""
        refresh = self._source.next_refresh(-(-self.position // self._source.packet_samples))
        if refresh is None:
            raise ControllerError(
                "the connection was lost for too long, and the stream has no further refresh packet to go on from: "
                "play it again, encoded for streaming"
            ) from cause
        return refresh

    def read_captures_to_their_end(self) -> None:
        """Read back what is left of the captures."""
        for tap, captured_by_now, rate_hz in self._taps():
            # The output comes to rest within a second; a longer capture is none of this stream.
            while self._captured_samples[tap] < captured_by_now + rate_hz and self._read_capture(tap):
                pass

    def captured(self, tap: Tap) -> NDArray[np.int16]:
        """Return what was read back: (samples, channels)."""
        return np.concatenate(self._captures[tap])

    def _next_data(self) -> StreamData | None:
        """Return the next packets that credit and one frame have room for, and count them as sent."""
        source = self._source
        iteration, number = divmod(self._next, len(source.packets))
        if source.end is not None and self._next >= source.end:
            return None
        sent = self._next - self._base
        granted = min(self._credit // source.packet_samples, self._playing() + self._ahead_packets) - sent
        if self.status.state == State.PLAYING and granted < min(self._frame_packets, len(source.packets) - number):
            return None  # wait for a full frame
        room_bytes = self._controller.description.limits.maximum_payload_bytes
        room_bytes -= len(pack(StreamData(0, 0, ()))) + _LONGEST_VARINT_BYTES
        chosen: list[bytes] = []
        for packet in source.packets[number : number + min(self._frame_packets, max(0, granted))]:
            room_bytes -= len(packet) + _LONGEST_VARINT_BYTES
            if room_bytes < 0:
                break
            chosen.append(packet)
        if not chosen:
            return None
        self._next += len(chosen)
        return StreamData(self._stream, iteration - self._base // len(source.packets), tuple(chosen))

    def _playing(self) -> int:
        """Return the packet that the controller is playing by now, counted as in its positions."""
        packets = self.status.position / self._source.packet_samples
        if self.status.state == State.PLAYING:
            packets += (self._controller.clock() - self._noted_s) / self._source.packet_s
        return int(packets)

    def _note(self, status: Status) -> None:
        """Take in a status of this stream."""
        source = self._source
        if status.state == State.FAULT:
            raise ControllerError("the controller reports a fault of its hardware and has stopped")
        if source.end is not None and self._base + status.position / source.packet_samples > source.end:
            raise ControllerError(
                "the controller goes on beyond the end of the stream: restart it, unless this program sent it a Loop"
            )
        if status.state == State.PAUSED or status.position > self._furthest:
            self._furthest = status.position
            self._moved_s = self._controller.clock()
        self.status = status
        self._noted_s = self._controller.clock()
        self._credit = max(self._credit, status.credit_until)
        if status.state == State.WATCHDOG:
            watchdog_ms = self._controller.description.limits.watchdog_ms
            raise ConnectionLost(f"the controller stopped because it heard nothing of this host for {watchdog_ms} ms")
        if status.state == State.PLAYING:
            self.reports_playing += 1
            self.buffered_s_sum += source.seconds(status.buffered_samples)
        playing = self._base + status.position // source.packet_samples
        if playing > self._next:
            # Too late for what lies between: the controller is silent until the next refresh packet, if there is one.
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
        """Return each tap, about how many samples it has captured by now, and how many it captures a second."""
        source = self._source
        positions = self.status.position - (self.first - self._base) * source.packet_samples
        dac_rate_hz = self._controller.description.actuator.dac_rate_hz
        return [
            (Tap.DECODED, positions, source.header.rate_hz),
            (Tap.DAC, int(source.seconds(positions) * dac_rate_hz), dac_rate_hz),
        ]

    def _ask(self, now_s: float) -> None:
        """Ask for the status, or else for a frame of a capture that would soon be longer than what is kept of it.

        Neither is waited for, so that a lost answer does not hold up the data.
        """
        if now_s >= self._ask_s:
            self._ask_s = now_s + self._status_interval_s
            self._free_s = now_s + min(ANSWER_TIMEOUT_S, self._status_interval_s)
            self._controller.ask_status()
            return
        limit = self._controller.description.limits.capture_samples // 4
        unread = {tap: captured_by_now - self._captured_samples[tap] for tap, captured_by_now, _ in self._taps()}
        tap = max(unread, key=lambda tap: unread[tap])
        if self._settings.capture and unread[tap] > limit:
            self._asked_tap = tap
            self._free_s = now_s + ANSWER_TIMEOUT_S
            self._controller.ask_capture(tap, self._captured_samples[tap], self._source.header.channels)

    def _read_capture(self, tap: Tap) -> bool:
        """Read a frame of a capture; return whether there is more."""
        channels = self._source.header.channels
        room = self._controller.capture_room(channels)
        return self._keep(self._controller.read_capture(tap, self._captured_samples[tap], room, channels), tap)

    def _keep(self, captured: CaptureData, tap: Tap) -> bool:
        """Keep what was asked for of a capture; return whether there is more."""
        samples = np.frombuffer(captured.data, "<i2").astype(np.int16).reshape(-1, captured.channels)
        self._captures[tap].append(samples)
        self._captured_samples[tap] += len(samples)
        return len(samples) > 0 and self._captured_samples[tap] < captured.end
