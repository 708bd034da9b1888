"""Watches a live stream: its quality, its delay, losses and their cause minute by minute, and the margin left."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import State, Status, Tap
from vibrocast.host.bench_limits import Judged, lost_percent
from vibrocast.host.device_clock import DeviceClock
from vibrocast.host.live import LiveResult, LiveStream, block_samples, paced
from vibrocast.host.playback import Member, actuator_use, at_the_skin, displacement_um, known_actuator, output_delay_s
from vibrocast.host.skin_quality import COMPARED_S, SkinQuality, compare_channels, judged_skin, limit_note
from vibrocast.host.stream_session import read_capture
from vibrocast.output.rendering import render

_MIN_S = 0.5
_READ_BACK_S = 5.0
"""How long reading the captures back may take."""
_MAX_VALUES = 1 << 23
"""Samples of all channels together whose packets are kept: some 50 minutes at 2800 Hz."""


@dataclass(frozen=True)
class LiveQuality:
    """The quality of a live stream.

    `snr_db`: of the decoded signal; None for silence, an exact copy, and where it was too short. `skin`, `skin_note`:
    as in `host.report.Report`, by the models of output stage and actuator. `decoded_equals_offline`,
    `dac_equals_offline`: whether the controller's captures of the end of the stream are those computed here, bit for
    bit. They are None where packets were lost, nothing is captured, or there are more than _MAX_VALUES.
    """

    snr_db: float | None = None
    skin: SkinQuality | None = None
    skin_note: str | None = None
    decoded_equals_offline: bool | None = None
    dac_equals_offline: bool | None = None

    @property
    def differs(self) -> bool:
        """Whether the controller has played something else than was sent."""
        return False in (self.decoded_equals_offline, self.dac_equals_offline)


class CodedSignal:
    """Keeps the packets of a live stream, and COMPARED_S of its source, up to where it left out packets or began again.

    Nothing is read back of a stream of more than _MAX_VALUES.
    """

    def __init__(self, stream: LiveStream) -> None:
        self._stream = stream
        self._blocks: list[Signal] = []
        self._packets: list[bytes] = []
        self._keeps = True
        stream.on_packets = self._keep

    def blocks(self, blocks: Iterable[Signal]) -> Iterator[Signal]:
        """Yield blocks on their way to the stream."""
        seconds = 0.0
        for block in blocks:
            if self._keeps and seconds < COMPARED_S:
                self._blocks.append(block)
                seconds += len(block) / self._stream.format.rate_hz
            yield block

    def _keep(self, packets: Sequence[bytes]) -> None:
        stream = self._stream
        values = len(self._packets) * stream.packet_samples * stream.format.channels
        self._keeps = self._keeps and not (stream.dropped_packets or stream.earlier or values > _MAX_VALUES)
        if self._keeps:
            self._packets += packets

    def quality(self, member: Member, model: models.Model | None, result: LiveResult) -> LiveQuality:
        """Compare the coded signal with its source, and the controller's captures with both.

        Reads the controller's captures: call it when the stream has ended. Raises CodecError, ControllerError,
        TransportError.
        """
        if not self._packets:
            return LiveQuality()
        header = replace(self._stream.header, samples=None)
        stream = Stream(header, tuple(self._packets), None if model is None else model.image)
        quality = self._of_coding(member, stream)
        if not self._keeps or result.lost_packets or result.underruns or result.streams > 1:
            return quality
        decoded, computed = self._as_sent(member, stream)
        return replace(quality, decoded_equals_offline=decoded, dac_equals_offline=computed)

    def _of_coding(self, member: Member, whole: Stream) -> LiveQuality:
        """Return the quality of coding, and at the skin by models; empty where the stream was too short."""
        header, empty = whole.header, whole.decoder()
        signal = np.concatenate([np.zeros((0, header.channels)), *self._blocks])
        samples = min(len(signal), len(self._packets) * empty.packet_samples - empty.delay_samples)
        if samples < _MIN_S * header.rate_hz:
            return LiveQuality()
        needed = -(-(samples + empty.delay_samples) // empty.packet_samples)
        stream = replace(whole, header=replace(header, samples=samples), packets=whole.packets[:needed])
        decoded, sent = stream.decode(), signal[:samples]
        snr_db = codec.snr_db(sent, decoded)
        if snr_db is not None and not math.isfinite(snr_db):
            snr_db = None
        if header.unit == "full scale":
            return LiveQuality(snr_db)
        actuator = member.skin_model or known_actuator(member)
        if actuator is None:
            return LiveQuality(snr_db)
        moved = at_the_skin(stream, actuator)
        asked_um = [displacement_um(each, header.unit, header.rate_hz, actuator) for each in (sent, decoded)]
        skin = compare_channels(asked_um, header.rate_hz, moved.samples, moved.rate_hz)
        if skin is None:
            return LiveQuality(snr_db)
        use = actuator_use(known_actuator(member) or actuator, actuator, self._stream.status)
        return LiveQuality(snr_db, skin, limit_note(skin, use.gains_db, use.limited_samples))

    def _as_sent(self, member: Member, stream: Stream) -> tuple[bool | None, bool | None]:
        """Return whether the controller decoded the end of the stream and computed its DAC codes as this computer."""
        controller, header = member.controller, stream.header
        if not controller.description.limits.capture_samples:
            return None, None
        offline = stream.decode_integers()
        values = _READ_BACK_S * self._stream.link_bytes_per_second / len(Tap) / offline.itemsize
        newest = int(min(values / header.channels, controller.description.limits.capture_samples))
        as_decoded = _ends_as(member, Tap.DECODED, offline, newest)
        actuator = known_actuator(member)
        if actuator is None:
            return as_decoded, None
        codes, _ = render(header, offline, stream.decoder().delay_samples, actuator)
        return as_decoded, _ends_as(member, Tap.DAC, codes, newest)


def _ends_as(member: Member, tap: Tap, computed: NDArray[np.int16], newest: int) -> bool:
    """Return whether a capture ends as it was computed. `newest`: samples per channel to compare, or fewer."""
    first, kept = read_capture(member.controller, tap, computed.shape[1], newest)
    return first + len(kept) == len(computed) and np.array_equal(kept, computed[first:])


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
