"""Watches a long live stream minute by minute: losses and their cause, lateness of the host, the margin left."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vibrocast.codec import Signal
from vibrocast.device_protocol.messages import State, Status
from vibrocast.host.bench_limits import Judged, lost_percent
from vibrocast.host.live import LiveResult, LiveStream
from vibrocast.host.live_quality import LiveQuality

MINUTE_S = 60.0


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

    def blocks(self, paced: Iterator[tuple[float, Signal]]) -> Iterator[Signal]:
        """Yield paced blocks, and note how late the host is with each."""
        for due_s, block in paced:
            late_ms = 1e3 * (self._stream.controller.clock() - due_s)
            self._late_ms.append(late_ms)
            yield block

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


def judged(result: LiveResult, quality: LiveQuality | None = None) -> Iterator[Judged]:
    """Yield the figures of a live stream that limits judge; those at the skin where its quality is known."""
    if quality is not None and quality.skin is not None:
        yield Judged("snr_db", "live", quality.skin.snr_db)
        yield Judged("gain", "live", quality.skin.gain)
    yield Judged("underruns", "live", result.underruns)
    yield Judged("lost_percent", "live", lost_percent(result.lost_packets, result.packets))
    yield Judged("bad_frames", "live", result.bad_frames + result.bad_frames_back)
