"""Learns from arrivals what a link carries: when frames arrive, and how many bytes per second."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import Message, Status, StatusRequest, StreamData, pack
from vibrocast.host.controller import Controller
from vibrocast.host.stream_session import next_number

# The controller drops data of a stream that is not under way, so a frame of it may be of any length.
_PROBE_BYTES = 128
_PROBES = 3
# A controller that plays sends a Status at least so often (docs/reference/protocol.md, "Credit").
STATUS_INTERVAL_S = 0.1
# Computer and bus shift a frame by up to this. A later arrival shows the link's capacity.
_JITTER_S = 0.005
# The capacity is taken to double in so long while nothing speaks against it, and halves at most for each frame.
_DOUBLING_S = 2.0
_MAX_DOUBLINGS = 64  # at once: a controller's clock may jump
_MAX_FALL = 0.5
# Over so long at most what arrives is counted: long enough for whole frames to do, and to follow a link that changes.
_WINDOW_S = 2.0
# Of the two clocks against each other.
_MAX_DRIFT = 0.005


def frame_bytes(message: Message) -> int:
    """Return the bytes of a message on the wire, its frame included."""
    return len(write_frame(pack(message, 1)))


@dataclass
class _Frame:
    """A frame under way: when it reached the link, when that begins to carry it, when it should arrive
    (`due_s`) and when it is expected to, by now.

    `min_rate`: this frame does not lower the capacity below these bytes per second. `is_first`: all earlier frames
    have arrived.
    """

    number: int
    size: int
    reached_s: float
    begins_s: float
    due_s: float
    arrives_s: float
    min_rate: float
    is_first: bool = False


class Link:
    """A model of the link to a controller: one queue that `bytes_per_second` empty. Times are the controller's.

    Measured: when frames are sent, and from each Status how many of them had arrived when it was written. Decided:

    - A frame that should have arrived and has not shows that the link is slower: since it last made progress it has
      carried at most what has arrived, and this frame.
    - While nothing is overdue the capacity grows, as far as it is `needed`: so a link is found out to have recovered.

    So the delay is the signal, as in TCP Vegas (Brakmo and Peterson, IEEE JSAC 13(8), 1995). The decrease goes to the
    rate of delivery, as in BBR (Cardwell et al., ACM Queue 14(5), 2016). The increase is by a factor, as in Google
    Congestion Control (Carlucci et al., ACM MMSys 2016).
    """

    def __init__(self, controller: Controller, stream: int) -> None:
        """Measure the link while nothing else is on it; `stream` is under way. Raises as `Controller.request`.

        A request is timed alone, and behind a frame of data. The difference is the time of the frame (the packet pair
        of Keshav, "A control-theoretic approach to flow control", SIGCOMM 1991). The soonest of each counts, because a
        busy computer or a lost answer can only make it later.
        """
        probe = StreamData(next_number(stream), 0, (bytes(_PROBE_BYTES),))
        trips = [[_trip(controller, data) for _ in range(_PROBES)] for data in ((), (probe,))]
        alone_s, behind_s = (min(late_s for late_s, _ in each) for each in trips)
        byte_s = max(0.0, behind_s - alone_s) / frame_bytes(probe)
        self.bytes_per_second = 1 / byte_s if byte_s else math.inf
        self.needed = math.inf
        self._round_trip_s = min(round_trip_s for _, round_trip_s in trips[0])
        # The controller's time, less the host's, when what the host sends begins to arrive on an idle link.
        self._offset_s = alone_s - byte_s * frame_bytes(StatusRequest())
        self._heard_s = controller.clock()
        self._sent: deque[int] = deque()
        self._under_way: deque[_Frame] = deque()
        self._packets = self._arrived = self._asked = self._decoded = self._lost = 0
        self._observed_s = self.now_s(controller.clock())
        # When, since it was last idle, the link was seen to be busy, and how many bytes had arrived before in all.
        self._busy: deque[tuple[float, int]] = deque()
        self._carried = 0

    def now_s(self, host_s: float) -> float:
        """Return the controller's time at which what is sent now begins to arrive on an idle link."""
        return host_s + self._offset_s

    def queue_s(self, now_s: float) -> float:
        """Return for how long the link is still busy with sent frames."""
        return max(0.0, self._under_way[-1].arrives_s - now_s) if self._under_way else 0.0

    def answer_s(self, now_s: float) -> float:
        """Return how long an answer takes to a short request that is sent now."""
        return self._round_trip_s + self.queue_s(now_s)

    def seconds(self, size: float) -> float:
        """Return how long the link takes for a number of bytes."""
        return size / self.bytes_per_second

    def send(self, number: int, size: int, now_s: float) -> float:
        """Note that the frame of packet `number` is sent; return when it should have arrived."""
        begins_s = now_s + self.queue_s(now_s)
        arrives_s = begins_s + self.seconds(size)
        min_rate = _MAX_FALL * min(self.bytes_per_second, self.needed)
        self._under_way.append(_Frame(number, size, now_s, begins_s, arrives_s, arrives_s, min_rate))
        self._sent.append(number)
        self._packets = number + 1
        return arrives_s

    def arrived_by(self, device_s: float) -> int:
        """Return how many packets should have arrived at a time."""
        return next((frame.number for frame in self._under_way if frame.arrives_s > device_s), self._packets)

    def is_late(self, device_s: float) -> bool:
        """Return whether something that was sent should have arrived by a time and has not."""
        return bool(self._under_way) and self._under_way[0].due_s + _JITTER_S < device_s

    def hear(self, status: Status, packet_samples: int, host_s: float) -> None:
        """Take in a Status that has come."""
        device_s = status.device_time_us / 1e6
        # A Status can come late, but not too early: what the soonest said holds, as far as clocks do not drift.
        drifted_s = self._offset_s - _MAX_DRIFT * (host_s - self._heard_s)
        self._offset_s = max(drifted_s, device_s - host_s + self._round_trip_s)
        self._heard_s = host_s
        # Those that are buffered are the first that were sent from the one on that is decoded next.
        decoded = -(-status.position // packet_samples)
        buffered = (status.position + status.buffered_samples) // packet_samples - decoded
        while self._sent and self._sent[0] < decoded:
            self._sent.popleft()
        if decoded > self._decoded:
            if status.lost_packets == self._lost:  # else what was passed over may still be under way
                self._arrived = max(self._arrived, decoded)
            self._decoded, self._lost = decoded, status.lost_packets
        if buffered > 0 and self._sent:
            self._arrived = max(self._arrived, self._sent[min(buffered, len(self._sent)) - 1] + 1)
        self._observe(device_s)

    def flushed(self) -> None:
        """Take in that a request has been answered: all that was sent before it is no longer under way."""
        self._arrived = max(self._arrived, self._asked)

    def asking(self) -> None:
        """Note that a request is sent."""
        self._asked = self._packets

    def wait(self, now_s: float) -> None:
        """Take in that nothing has come: a controller that plays tells often that it does."""
        self._observe(now_s - self._round_trip_s - STATUS_INTERVAL_S - _JITTER_S)

    def _observe(self, device_s: float) -> None:
        """Compare the arrivals by a time with the expected ones."""
        passed_s = device_s - self._observed_s
        if passed_s <= 0:
            return
        arrived_s = -math.inf
        while self._under_way:
            head = self._under_way[0]
            if not head.is_first and head.begins_s <= head.reached_s:
                self._busy = deque([(head.reached_s, self._carried)])  # the link was idle before
            head.is_first = True
            if head.number >= self._arrived:
                break
            arrived_s = max(self._observed_s, min(head.due_s, device_s))
            self._carried += head.size
            self._under_way.popleft()
        if self.is_late(device_s):
            carried = self._carried + head.size
            max_rate = min((carried - before) / (device_s - busy_s) for busy_s, before in self._busy)
            self.bytes_per_second = min(self.bytes_per_second, max(head.min_rate, max_rate))
        elif self.bytes_per_second < self.needed:
            doublings = min(passed_s / _DOUBLING_S, _MAX_DOUBLINGS)
            self.bytes_per_second = min(self.needed, self.bytes_per_second * 2**doublings)
        if self._under_way and head.reached_s < device_s:
            while self._busy and self._busy[0][0] < device_s - _WINDOW_S:
                self._busy.popleft()
            self._busy.append((device_s, self._carried))
        self._observed_s = device_s
        free_s = arrived_s
        for frame in self._under_way:
            if frame is not head or math.isfinite(arrived_s):
                frame.begins_s = max(frame.reached_s, free_s)
            frame.due_s = frame.begins_s + self.seconds(frame.size)
            # A late frame is assumed to be late by as much again. This detects a link that stands still.
            frame.arrives_s = frame.due_s + 2 * max(0.0, device_s - frame.due_s)
            free_s = frame.arrives_s


def _trip(controller: Controller, data: Sequence[StreamData]) -> tuple[float, float]:
    """Send data and a request; return the controller's time when that had arrived, less the host's before, and the
    host's time until it was answered."""
    began_s = controller.clock()
    for each in data:
        controller.send(each)
    device_s = controller.request_status().device_time_us / 1e6
    return device_s - began_s, controller.clock() - began_s
