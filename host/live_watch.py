"""Watches a live stream: its delay, and minute by minute losses and their cause, lateness of the host, margin left."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vibrocast.codec import Signal
from vibrocast.device_protocol.messages import State, Status
from vibrocast.host.bench_limits import Judged, lost_percent
from vibrocast.host.device_clock import DeviceClock
from vibrocast.host.end_to_end import Member, known_actuator, output_delay_s
from vibrocast.host.live import LiveResult, LiveStream, block_samples, paced
from vibrocast.host.live_quality import LiveQuality
from vibrocast.host.skin_quality import judged_skin

MINUTE_S = 60.0
_ASK_S = 0.25
"""How often the controller is asked where it is."""
_MIN_TRIPS = 4


@dataclass
class Minute:
    """A minute of a live stream, from `from_s` on. Counts are of this minute.

    `host_late_ms`: by how much the host handled a block too late, at most; `host_jitter_ms`: between the 5 % and the
    95 % of these times; None where blocks have no time of their own.
    `margin_ms`: the least time that packets lay ready at the controller; None where it never played.
    """

    from_s: float
    packets: int = 0
    underruns: int = 0
    lost_packets: int = 0
    dropped_packets: int = 0
    restarts: int = 0
    bad_frames: int = 0
    bad_frames_back: int = 0
    output_gaps: int = 0
    host_late_ms: float | None = None
    host_jitter_ms: float | None = None
    margin_ms: float | None = None
    cause: str | None = None


class _Question(NamedTuple):
    """A request for the controller's Status, behind a packet.

    `last_s`: when the packet's last sample was taken. `sent_samples`: of the stream so far, per channel.
    """

    last_s: float
    sent_samples: int
    stream: int


@dataclass(frozen=True)
class Timing:
    """The times of a live stream whose samples have a time of their own; None: not known.

    `latency_ms`: from when a sample was taken to the DAC, the median. `jitter_ms`: between the 5 % and the 95 % of the
    times at which packets arrive, relative to when their last samples were taken. `drift_ppm`: of the controller's
    clock.
    """

    latency_ms: float | None = None
    jitter_ms: float | None = None
    drift_ppm: float | None = None


def _counts(stream: LiveStream) -> dict[str, int]:
    """Return the counts of a stream so far, by the fields of Minute."""
    result = stream.result()
    return {
        "packets": result.packets,
        "underruns": result.underruns,
        "lost_packets": result.lost_packets,
        "dropped_packets": result.dropped_packets,
        "restarts": result.streams - 1,
        "bad_frames": result.bad_frames,
        "bad_frames_back": result.bad_frames_back,
        "output_gaps": sum(status.output_gaps for status in (*stream.earlier, stream.status)),
    }


class Watch:
    """Notes what happens to a live stream; `minutes`: those that have ended, and the one under way."""

    def __init__(self, stream: LiveStream) -> None:
        self._stream = stream
        self._before = _counts(stream)
        self.minutes = [Minute(0.0)]
        self._late_ms: list[float] = []
        self._clock = DeviceClock(stream.controller)
        self._questions: list[_Question] = []
        self._ask_s = 0.0

    def blocks(self, samples: Signal) -> Iterator[Signal]:
        """Yield blocks of samples (n, channels) when each is due; note how late the host is, and where the device."""
        stream = self._stream
        for due_s, block in paced(stream, samples, block_samples(stream), self._clock.sleep):
            now_s, sent = stream.controller.clock(), stream.packets_sent
            self._late_ms.append(1e3 * (now_s - due_s))
            yield block
            if stream.packets_sent > sent and now_s >= self._ask_s:
                last_s = due_s - (stream.packet_samples - stream.left_samples) / stream.format.rate_hz
                self._clock.ask(len(self._questions))
                self._questions.append(_Question(last_s, stream.packets_sent * stream.packet_samples, stream.stream))
                self._ask_s = now_s + _ASK_S

    def timing(self, member: Member) -> Timing:
        """Return the times of the stream so far; `member`: who plays it. Raises ControllerError."""
        stream, rate_hz = self._stream, self._stream.format.rate_hz
        if len(self._clock.trips) < _MIN_TRIPS:
            return Timing()
        fit = self._clock.fit()
        arrived_s, played_s = [], []
        for number, (_, _, status) in self._clock.trips.items():
            question = self._questions[number]
            after_s = fit.host_time_s(status.device_time_us / 1e6) - question.last_s
            arrived_s.append(after_s)
            if status.state == State.PLAYING and status.position and status.stream == question.stream:
                played_s.append(after_s + (question.sent_samples - status.position) / rate_hz)
        early_s, late_s = np.quantile(arrived_s, (0.05, 0.95))
        actuator = known_actuator(member)
        latency_s = None
        if played_s and actuator is not None:
            chain_s = stream.delay_samples / rate_hz + output_delay_s(stream.header, actuator)
            latency_s = float(np.median(played_s)) + chain_s
        return Timing(
            latency_ms=None if latency_s is None else 1e3 * latency_s,
            jitter_ms=1e3 * float(late_s - early_s),
            drift_ppm=fit.drift_ppm,
        )

    def note(self, status: Status) -> None:
        """Take in a status; begin another minute when one has ended."""
        minute = self.minutes[-1]
        if status.state == State.PLAYING and status.buffered_samples:
            ready_ms = 1e3 * status.buffered_samples / self._stream.format.rate_hz
            minute.margin_ms = ready_ms if minute.margin_ms is None else min(ready_ms, minute.margin_ms)
        if self._stream.seconds >= minute.from_s + MINUTE_S:
            self.close()
            self.minutes.append(Minute(minute.from_s + MINUTE_S))

    def close(self) -> None:
        """Count the minute under way."""
        minute, now = self.minutes[-1], _counts(self._stream)
        if self._late_ms:
            minute.host_late_ms = max(0.0, max(self._late_ms))
            early_ms, late_ms = np.quantile(self._late_ms, (0.05, 0.95))
            minute.host_jitter_ms = float(late_ms - early_ms)
            self._late_ms.clear()
        for name, count in now.items():
            setattr(minute, name, max(0, count - self._before[name]))
        minute.cause = cause(minute, 1e3 * self._stream.playout_delay_s)
        self._before = now


def cause(minute: Minute, playout_delay_ms: float) -> str | None:
    """Return what made a minute lose something: "host", "wire" or "device"; None where it lost nothing."""
    if not (minute.underruns or minute.lost_packets or minute.restarts or minute.output_gaps):
        return None
    if minute.output_gaps:
        return "device"
    if minute.bad_frames or minute.bad_frames_back:
        return "wire"
    return "host" if minute.host_late_ms is not None and minute.host_late_ms > playout_delay_ms / 2 else "wire"


def judged(result: LiveResult, quality: LiveQuality, timing: Timing) -> Iterator[Judged]:
    """Yield the figures of a live stream that limits judge.

    Those at the skin are computed, so they are known only where the controller has played what was computed.
    """
    yield from judged_skin(quality.skin if quality.dac_equals_offline else None, "live")
    yield Judged("latency_ms", "live", timing.latency_ms)
    yield Judged("jitter_ms", "live", timing.jitter_ms)
    yield Judged("drift_ppm", "live", timing.drift_ppm)
    yield Judged("underruns", "live", result.underruns)
    yield Judged("lost_percent", "live", lost_percent(result.lost_packets, result.packets))
    yield Judged("bad_frames", "live", result.bad_frames + result.bad_frames_back)
