"""Sums a trace up: requests sent again, round trips, silences, damage and losses, and their likely cause."""

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from vibrocast.device_protocol.messages import NOTIFICATION, Error, ErrorCode, Message, Status
from vibrocast.device_protocol.trace import TracedFrame
from vibrocast.host.controller import ANSWER_TIMEOUT_S, StatusCounts
from vibrocast.host.figures import WIRE_FIGURES

WAYS = {True: "to_controller", False: "to_host"}


@dataclass
class Way:
    """The frames in one direction. `repeated`: came twice, though nobody asked twice."""

    frames: int = 0
    bytes: int = 0
    damaged: int = 0
    repeated: int = 0
    reordered: int = 0
    longest_silence_s: float = 0.0


@dataclass
class Summary:
    """What passed on a wire.

    `round_trips_s`: of requests, from their first frame to the answer. `host_silence_s`: the longest time in which the
    host said nothing though it had its answer. `counters`: of the controller, summed over its streams. `restarts`: of
    the controller.
    """

    seconds: float = 0.0
    ways: dict[str, Way] = field(default_factory=lambda: {way: Way() for way in WAYS.values()})
    requests: int = 0
    repeated_requests: int = 0
    unanswered_requests: int = 0
    round_trips_s: list[float] = field(default_factory=list)
    host_silence_s: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)
    restarts: int = 0

    @property
    def cause(self) -> str:
        """What has most likely gone wrong: "device", "wire" or "host"; empty where nothing has.

        A wire that carries nothing looks as a device that hangs.
        """
        if self.restarts or self.counters.get("output_gaps"):
            return "device"
        if any(way.damaged or way.repeated or way.reordered for way in self.ways.values()):
            return "wire"
        if any(self.counters.get(name) for name in WIRE_FIGURES):
            return "wire"
        if not any(self.counters.get(name) for name in ("underruns", "lost_packets")):
            return "wire" if self.repeated_requests else ""
        waited_s = max(self.round_trips_s, default=0.0)
        return "host" if self.host_silence_s > max(ANSWER_TIMEOUT_S, waited_s) else "wire"

    def document(self) -> dict[str, object]:
        """Return the summary ready for JSON."""
        trips_ms = [1e3 * each for each in self.round_trips_s]
        return {
            "seconds": self.seconds,
            **{name: vars(way) for name, way in self.ways.items()},
            "requests": self.requests,
            "repeated_requests": self.repeated_requests,
            "unanswered_requests": self.unanswered_requests,
            "round_trip_median_ms": statistics.median(trips_ms) if trips_ms else None,
            "round_trip_max_ms": max(trips_ms, default=None),
            "host_silence_s": self.host_silence_s,
            "counters": self.counters,
            "restarts": self.restarts,
            "cause": self.cause or None,
        }

    def lines(self) -> Iterator[str]:
        """Yield the summary for a person."""
        yield f"{self.seconds:.3f} s"
        for name, way in self.ways.items():
            yield (
                f"{name.replace('_', ' ')}: {way.frames} frames, {way.bytes} bytes, damaged {way.damaged}, repeated "
                f"{way.repeated}, reordered {way.reordered}, longest silence {way.longest_silence_s:.3f} s"
            )
        yield (
            f"requests {self.requests}, sent again {self.repeated_requests}, unanswered {self.unanswered_requests}; "
            f"with its answer, the host said nothing for {self.host_silence_s:.3f} s at most"
        )
        if self.round_trips_s:
            median_ms, max_ms = 1e3 * statistics.median(self.round_trips_s), 1e3 * max(self.round_trips_s)
            yield f"round trips: median {median_ms:.1f} ms, longest {max_ms:.1f} ms"
        counts = [f"{name.replace('_', ' ')} {count}" for name, count in self.counters.items() if count]
        yield f"controller: {', '.join([*counts, f'restarts {self.restarts}'])}"
        yield f"likely cause: {self.cause or 'none, nothing went wrong'}"


def summarise(frames: Sequence[TracedFrame]) -> Summary:
    """Return the summary of the frames of one link, in their order."""
    follower = _Follower()
    for frame in frames:
        follower.take(frame)
    return follower.end()


class _Follower:
    """Takes the frames of a link one by one."""

    def __init__(self) -> None:
        self._summary = Summary()
        self._last_s: dict[bool, float] = {}
        self._first_s: float | None = None
        self._asked: dict[int, tuple[float, int]] = {}  # requests without an answer: when, and how often sent
        self._answered: dict[int, int] = {}  # answers that may still come
        self._counts = StatusCounts()
        self._last_encoded = b""
        self._quiet_since_s: float | None = None

    def take(self, frame: TracedFrame) -> None:
        """Take in a frame."""
        now_s = frame.time_ns / 1e9
        self._first_s = now_s if self._first_s is None else self._first_s
        self._summary.seconds = now_s - self._first_s
        way = self._summary.ways[WAYS[frame.from_host]]
        way.frames, way.bytes = way.frames + 1, way.bytes + len(frame.encoded)
        way.longest_silence_s = max(way.longest_silence_s, now_s - self._last_s.get(frame.from_host, now_s))
        self._last_s[frame.from_host] = now_s
        if frame.from_host and self._quiet_since_s is not None:
            self._summary.host_silence_s = max(self._summary.host_silence_s, now_s - self._quiet_since_s)
        found = frame.message()
        if found is None:
            way.damaged += bool(frame.encoded)
            return
        (self._from_host if frame.from_host else self._to_host)(now_s, *found, frame.encoded)
        self._quiet_since_s = None if self._asked else self._last_s.get(True, now_s)

    def _from_host(self, now_s: float, sequence: int, _: Message, encoded: bytes) -> None:
        if sequence == NOTIFICATION:
            self._summary.ways["to_controller"].repeated += encoded == self._last_encoded
            self._last_encoded = encoded
            return
        asked_s, sent = self._asked.get(sequence, (now_s, 0))
        if not sent:  # the host goes on where an answer is late
            self._summary.requests += 1
            self._summary.unanswered_requests += len(self._asked)
            self._asked.clear()
        self._summary.repeated_requests += sent > 0
        self._asked[sequence] = asked_s, sent + 1

    def _to_host(self, now_s: float, sequence: int, message: Message, encoded: bytes) -> None:
        way = self._summary.ways["to_host"]
        repeated = False
        if sequence in self._asked:
            asked_s, sent = self._asked.pop(sequence)
            self._answered = {sequence: sent - 1}
            self._summary.round_trips_s.append(now_s - asked_s)
        elif sequence != NOTIFICATION and sequence in self._answered:
            self._answered[sequence] -= 1
            repeated = self._answered[sequence] < 0
        way.repeated += repeated
        if isinstance(message, Error) and message.code == ErrorCode.HELLO_FIRST:
            self._summary.restarts += 1
        if isinstance(message, Status) and not repeated:
            self._counts.take(message)

    def end(self) -> Summary:
        """Return the summary of all frames."""
        self._summary.unanswered_requests += len(self._asked)
        self._summary.counters = self._counts.grown
        self._summary.ways["to_host"].reordered = self._counts.reordered
        return self._summary
