"""Plays coded packets on a controller: fed under credit, watched, resumed after a pulled cable. No threads."""

import bisect
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from device_protocol.messages import Configure, Start, State, Status, StreamData, Tap, pack
from device_protocol.transports import TransportError
from host.controller import ConnectionLost, Controller, ControllerError

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
    """Where a playback is; `duration_s` is None for one that loops until stopped."""

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
    and may itself use the controller: `request` a Pause, Resume or Gain, or `stop` it. Whatever is raised,
    KeyboardInterrupt included, the controller is stopped first. A broken connection is opened anew for `reconnect_s`;
    if the controller has given up meanwhile, playing (also what was paused) goes on at the next refresh packet.

    Raises StreamError for packets that make no stream, or none that the controller takes, ControllerError,
    TransportError and MessageError.
    """
    playback = _Playback(controller, header, packets, packet_samples, loops, gain, compensation, buffer_s, capture)
    try:
        return playback.run(reconnect_s, progress)
    except BaseException:
        # Where the controller is out of reach, its own watchdog stops it.
        with contextlib.suppress(ControllerError, TransportError):
            controller.stop()
        raise


def check_limits(controller: Controller, channels: int, rate_hz: int) -> None:
    """Raise StreamError, with the limit, if the controller cannot play a stream of these channels and this rate."""
    limits = controller.description.limits
    if channels > limits.channels:
        raise StreamError(f"{channels} channels, the controller has {limits.channels}: leave some out of the recording")
    if not limits.minimum_rate_hz <= rate_hz <= limits.maximum_rate_hz:
        raise StreamError(
            f"a stream of {rate_hz} Hz, the controller takes {limits.minimum_rate_hz} to {limits.maximum_rate_hz} Hz: "
            "encode with another --stream-rate-hz"
        )


class _Playback:
    """One playback. Packets are counted over all loops: packet k is number k % n of iteration k // n."""

    def __init__(
        self,
        controller: Controller,
        header: StreamHeader,
        packets: Sequence[bytes],
        packet_samples: int,
        loops: int,
        gain: float,
        compensation: bool,
        buffer_s: float,
        capture: bool,
    ) -> None:
        self._controller = controller
        self._header = header
        self._packets = packets
        self._packet_samples = packet_samples
        self._loops = loops
        self._end = loops * len(packets) if loops else None
        self._gain = gain
        self._compensation = compensation
        self._capture = capture
        self._refreshes = self._check()
        # One more than the packet that is played, however long packets are, where the controller has room for it.
        wanted_packets = max(2, round(buffer_s * header.rate_hz) // packet_samples)
        self._buffer_packets = min(wanted_packets, controller.description.limits.buffer_samples // packet_samples)
        # Waiting for a full frame must not empty the buffer.
        self._frame_packets = max(1, min(_LARGEST_FRAME_PACKETS, self._buffer_packets // 4))
        # Often enough for the watchdog, and to learn in time that playing has begun where the notification was lost.
        self._status_interval_s = min(
            _LONGEST_STATUS_INTERVAL_S,
            controller.description.limits.watchdog_ms / 4000,
            self._buffer_packets * packet_samples / header.rate_hz / 2,
        )
        self._ask_s = 0.0
        self._earlier: list[Status] = []
        self._reconnects = 0
        self._came_back_at = -1
        self._buffered_sum = self._buffered_count = 0

    def _check(self) -> list[int]:
        """Return the numbers of the refresh packets. Raises StreamError, and ControllerError for what never fits."""
        limits = self._controller.description.limits
        check_limits(self._controller, self._header.channels, self._header.rate_hz)
        if not self._packets:
            raise StreamError("the stream has no packets: there is nothing to play")
        if self._packet_samples > limits.buffer_samples:
            raise ControllerError(
                f"a packet has {self._packet_samples} samples, the controller's buffer {limits.buffer_samples}: "
                "encode with shorter packets"
            )
        frame_bytes = len(pack(StreamData(0, 0, ()))) + 2 * _LONGEST_VARINT_BYTES
        largest_bytes = min(limits.maximum_packet_bytes, limits.maximum_payload_bytes - frame_bytes)
        refreshes = []
        for number, packet in enumerate(self._packets):
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
                refreshes.append(number)
        if refreshes[:1] != [0]:
            raise StreamError("the stream does not begin with a refresh packet: it cannot be decoded")
        return refreshes

    def run(self, reconnect_s: float, progress: Callable[[Progress], None] | None) -> PlaybackResult:
        clock = self._controller.clock
        sent_before, received_before = self._controller.bytes_sent, self._controller.bytes_received
        started_s = clock()
        self._configure(0)
        while True:
            try:
                if self._pass(progress):
                    break
            except (TransportError, ConnectionLost) as cause:
                self._come_back(cause, reconnect_s)
        if self._capture:
            for tap, rate_hz in self._taps():
                # The output comes to rest within a second; a longer capture is none of this stream.
                longest = self._captured_by_now(rate_hz) + rate_hz
                while self._captured_samples[tap] < longest and self._read_capture(tap):
                    pass
        statuses = [*self._earlier, self._status]
        return PlaybackResult(
            state=self._status.state,
            status=self._status,
            seconds=clock() - started_s,
            buffered_s=self._buffered_sum / max(1, self._buffered_count) / self._header.rate_hz,
            wire_bytes_sent=self._controller.bytes_sent - sent_before,
            wire_bytes_received=self._controller.bytes_received - received_before,
            underruns=sum(status.underruns for status in statuses),
            lost_packets=sum(status.lost_packets for status in statuses),
            reconnects=self._reconnects,
            captured_from=self._first,
            decoded=self._captured(Tap.DECODED) if self._capture else None,
            dac_codes=self._captured(Tap.DAC) if self._capture else None,
        )

    def _configure(self, packet: int) -> None:
        """Set the stream up and start it, so that playing begins with `packet`."""
        iteration, first_packet = divmod(packet, len(self._packets))
        self._stream = (self._controller.request_status().stream + 1) % 256
        self._base = iteration * len(self._packets)
        self._first = self._next = packet
        self._captures: dict[Tap, list[NDArray[np.int16]]] = {tap: [] for tap in Tap}
        self._captured_samples = dict.fromkeys(Tap, 0)
        configure = Configure(
            stream=self._stream,
            header=self._header.pack(),
            prebuffer_samples=self._buffer_packets * self._packet_samples,
            packets=len(self._packets),
            first_packet=first_packet,
            loops=self._loops - iteration if self._loops else 0,
            compensation=self._compensation,
            gain=self._gain,
        )
        self._status = self._controller.request(configure, Status)
        self._credit = self._status.credit_until
        self._furthest = self._status.position
        self._noted_s = self._moved_s = self._controller.clock()
        self._controller.request(Start(), Status)

    def _pass(self, progress: Callable[[Progress], None] | None) -> bool:
        """Send a frame if there is credit, take in what came; return whether the playback has ended."""
        now_s = self._controller.clock()
        if now_s - self._noted_s > _SILENCE_S:
            raise ConnectionLost(f"the controller has not answered for {_SILENCE_S:g} s. Check that it has power.")
        if now_s - self._moved_s > _STALL_S:
            raise ControllerError(f"the controller's position has not moved for {_STALL_S:g} s. Restart it.")
        data = self._next_data()
        if data is not None:
            self._controller.send(data)
        if now_s >= self._ask_s:
            # Not waited for, so that a lost answer does not hold up the data.
            self._ask_s = now_s + self._status_interval_s
            self._controller.ask_status()
        self._controller.poll(0 if data is not None else min(_READ_S, self._status_interval_s))
        status = self._controller.status
        if status is not None and status is not self._status and status.stream == self._stream:
            self._note(status)
            if progress is not None:
                progress(self._progress())
        if self._capture:
            self._read_long_captures()
        return self._status.state in (State.FINISHED, State.STOPPED)

    def _next_data(self) -> StreamData | None:
        """Return the next packets that credit and one frame have room for, and count them as sent."""
        iteration, number = divmod(self._next, len(self._packets))
        if self._end is not None and self._next >= self._end:
            return None
        sent = self._next - self._base
        granted = min(self._credit // self._packet_samples, self._playing() + self._buffer_packets) - sent
        if self._status.state == State.PLAYING and granted < min(self._frame_packets, len(self._packets) - number):
            return None  # wait for a full frame
        room_bytes = self._controller.description.limits.maximum_payload_bytes
        room_bytes -= len(pack(StreamData(0, 0, ()))) + _LONGEST_VARINT_BYTES
        chosen: list[bytes] = []
        for packet in self._packets[number : number + min(self._frame_packets, max(0, granted))]:
            room_bytes -= len(packet) + _LONGEST_VARINT_BYTES
            if room_bytes < 0:
                break
            chosen.append(packet)
        if not chosen:
            return None
        self._next += len(chosen)
        return StreamData(self._stream, iteration - self._base // len(self._packets), tuple(chosen))

    def _playing(self) -> int:
        """Return the packet that the controller is playing by now, counted as in its positions."""
        position: float = self._status.position
        if self._status.state == State.PLAYING:
            position += (self._controller.clock() - self._noted_s) * self._header.rate_hz
        return int(position // self._packet_samples)

    def _note(self, status: Status) -> None:
        """Take in a status of this stream."""
        if status.state == State.FAULT:
            raise ControllerError("the controller reports a fault of its hardware and has stopped")
        if self._end is not None and self._base + status.position / self._packet_samples > self._end:
            raise ControllerError("the controller's position is beyond the end of the stream. Restart it.")
        if status.state == State.PAUSED or status.position > self._furthest:
            self._furthest = status.position
            self._moved_s = self._controller.clock()
        self._status = status
        self._noted_s = self._controller.clock()
        self._credit = max(self._credit, status.credit_until)
        if status.state == State.WATCHDOG:
            watchdog_ms = self._controller.description.limits.watchdog_ms
            raise ConnectionLost(f"the controller stopped because it heard nothing of this host for {watchdog_ms} ms")
        if status.state == State.PLAYING:
            self._buffered_sum += status.buffered_samples
            self._buffered_count += 1
        playing = self._base + status.position // self._packet_samples
        if playing > self._next:
            # Too late for what lies between: the controller is silent until the next refresh packet, if there is one.
            self._next = self._next_refresh(playing) or playing

    def _next_refresh(self, packet: int) -> int | None:
        """Return the first refresh packet at or after `packet`, None if the stream ends before it."""
        iteration, number = divmod(packet, len(self._packets))
        at = bisect.bisect_left(self._refreshes, number)
        refresh = (iteration + 1) * len(self._packets)
        if at < len(self._refreshes):
            refresh = iteration * len(self._packets) + self._refreshes[at]
        return refresh if self._end is None or refresh < self._end else None

    def _come_back(self, cause: Exception, reconnect_s: float) -> None:
        """Open the lost connection anew; go on where the controller is, or at the next refresh packet if it gave up."""
        position = self._base * self._packet_samples + self._status.position
        if position <= self._came_back_at:
            raise cause  # nothing was gained by coming back
        self._came_back_at = position
        self._controller.reconnect(reconnect_s)
        self._reconnects += 1
        status = self._controller.request_status()
        ours = status.stream == self._stream
        if ours and status.state in (State.ARMED, State.PLAYING, State.PAUSED, State.FINISHED, State.STOPPED):
            # What was under way when the connection broke may be lost; the controller drops what it has twice.
            self._next = min(self._next, self._base + status.position // self._packet_samples)
            self._note(status)
            return
        last = status if ours and status.state == State.WATCHDOG else self._status
        refresh = self._next_refresh(self._base + -(-last.position // self._packet_samples))
        if refresh is None:
            raise ControllerError(
                "the connection was lost for too long, and the stream has no further refresh packet to go on from: "
                "play it again, encoded for streaming"
            ) from cause
        self._earlier.append(last)
        self._configure(refresh)

    def _progress(self) -> Progress:
        rate_hz = self._header.rate_hz
        return Progress(
            position_s=(self._base * self._packet_samples + self._status.position) / rate_hz,
            duration_s=None if self._end is None else self._end * self._packet_samples / rate_hz,
            buffered_s=self._status.buffered_samples / rate_hz,
            status=self._status,
        )

    def _taps(self) -> list[tuple[Tap, int]]:
        return [(Tap.DECODED, self._header.rate_hz), (Tap.DAC, self._controller.description.actuator.dac_rate_hz)]

    def _captured_by_now(self, rate_hz: int) -> int:
        """Return how many samples at `rate_hz` the controller has captured since playing began."""
        played = self._status.position - (self._first - self._base) * self._packet_samples
        return played * rate_hz // self._header.rate_hz

    def _read_long_captures(self) -> None:
        """Read back a frame of each capture that would soon be longer than what the controller keeps."""
        for tap, rate_hz in self._taps():
            unread = self._captured_by_now(rate_hz) - self._captured_samples[tap]
            if unread > self._controller.description.limits.capture_samples // 4:
                self._read_capture(tap)

    def _read_capture(self, tap: Tap) -> bool:
        """Read a frame of a capture; return whether there is more."""
        channels = self._header.channels
        room = self._controller.capture_room(channels)
        captured = self._controller.read_capture(tap, self._captured_samples[tap], room, channels)
        samples = np.frombuffer(captured.data, "<i2").astype(np.int16).reshape(-1, channels)
        self._captures[tap].append(samples)
        self._captured_samples[tap] += len(samples)
        return len(samples) > 0 and self._captured_samples[tap] < captured.end

    def _captured(self, tap: Tap) -> NDArray[np.int16]:
        return np.concatenate(self._captures[tap])
