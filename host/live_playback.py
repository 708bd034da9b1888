"""Plays live streams and watches them: their quality, their delay, and losses with their cause, minute by minute."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.source import recording_format
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import State, Status, Tap
from vibrocast.host import live, playback
from vibrocast.host.controller import ANSWER_TIMEOUT_S, Controller
from vibrocast.host.devices import Session
from vibrocast.host.picture import Trace
from vibrocast.host.playback import COMPARED_S, Captured, Playback
from vibrocast.host.report import LiveFigures, Minute, Provenance, Quality, Report, Timing, Wire
from vibrocast.host.stream_session import read_capture
from vibrocast.output.rendering import render
from vibrocast.textures import Recording

_MIN_S = 0.5
_HOSTS_SHARE = 0.5
"""Where the host has handled more late packets than this part of the losses, it has caused them."""
_LATE_SHARE = 0.05
"""Without a loss, delay and jitter are the host's where it has handled more packets than this part too late."""
_READ_BACK_S = 5.0
"""How long reading the captures back may take."""
_MAX_VALUES = 1 << 23
"""Samples of all channels together whose packets are kept: some 50 minutes at 2800 Hz."""
MINUTE_S = 60.0
ASK_S = 0.25
"""How often the controller is asked where it is."""
_MIN_TRIPS = 4
_GROUP = 4
# Round trips kept: those that no queue on the way has held up.
_KEPT_PART = 0.25
_MIN_KEPT = 8
# A read ends this much before its time, because it may take longer than requested: USB counts in whole milliseconds.
_READ_EARLY_S = 0.001
_MIN_READ_S = 1e-6


@dataclass(frozen=True)
class ClockFit:
    """device time = `device_s` + (1 + `drift_ppm` / 1e6) (host time - `host_s`), all in seconds.

    `drift_error_ppm`: standard error of the drift. `round_trip_ms`: the shortest one; half of it bounds the offset's
    error.
    """

    host_s: float
    device_s: float
    drift_ppm: float
    drift_error_ppm: float
    round_trip_ms: float

    def host_time_s(self, device_s: float) -> float:
        """Return the host's time at a time of the device."""
        return self.host_s + (device_s - self.device_s) / (1 + self.drift_ppm / 1e6)


class DeviceClock:
    """Collects Status round trips with a controller, none of which is waited for: a slow link holds nothing up.

    `trips`: of each, by the number it was requested under, when it was requested and answered, and the answer.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._pending: tuple[int, float] | None = None
        self.trips: dict[int, tuple[float, float, Status]] = {}

    def ask(self, number: int) -> None:
        """Ask, unless an answer is still awaited. Raises TransportError."""
        now_s = self._controller.clock()
        if self._pending is None or now_s - self._pending[1] > ANSWER_TIMEOUT_S:
            self._pending = number, now_s
            self._controller.ask_status()

    def sleep(self, seconds: float) -> None:
        """Let time pass and receive answers. Raises as `Controller.poll`."""
        until_s = self._controller.clock() + seconds
        read_until_s = until_s - _READ_EARLY_S
        while self._pending is not None and (left_s := read_until_s - self._controller.clock()) >= _MIN_READ_S:
            answer = self._controller.poll(left_s)
            if isinstance(answer, Status):
                number, requested_s = self._pending
                self.trips[number] = requested_s, self._controller.clock(), answer
                self._pending = None
        self._controller.sleep(max(0.0, until_s - self._controller.clock()))

    def fit(self) -> ClockFit:
        """Return the line through the shortest of the round trips, of which there is one, each as long there as back.

        Least squares, as in the clock filter of NTP (RFC 5905, section 10), which trusts the shortest of recent trips.
        """
        sent_s, answered_s, device_s = np.array(
            [(sent_s, answered_s, status.device_time_us / 1e6) for sent_s, answered_s, status in self.trips.values()]
        ).T
        round_trips_s = answered_s - sent_s
        kept = np.argsort(round_trips_s, kind="stable")[: max(_MIN_KEPT, round(_KEPT_PART * len(round_trips_s)))]
        middle_s = (sent_s[kept] + answered_s[kept]) / 2
        host_s, offset_s = float(np.mean(middle_s)), device_s[kept] - middle_s
        spread = float(np.sum(np.square(middle_s - host_s)))
        slope = float(np.sum((middle_s - host_s) * offset_s)) / spread if spread else 0.0
        residual_s = offset_s - np.mean(offset_s) - slope * (middle_s - host_s)
        freedom = max(1, len(kept) - 2)
        error = float(np.sqrt(np.sum(np.square(residual_s)) / freedom / spread)) if spread else 0.0
        return ClockFit(
            host_s=host_s,
            device_s=host_s + float(np.mean(offset_s)),
            drift_ppm=1e6 * slope,
            drift_error_ppm=1e6 * error,
            round_trip_ms=1e3 * float(np.min(round_trips_s)),
        )


class Sent(NamedTuple):
    """A packet on its way, in seconds of the host's clock.

    `due_s`: when its last sample was taken. `awake_s`: when the host began to handle it. `coded_s`: when it was coded.
    `sent_s`: when the operating system had taken it. `samples`: of the stream so far, per channel. `stream`: its
    number.
    """

    due_s: float
    awake_s: float
    coded_s: float
    sent_s: float
    samples: int
    stream: int


class LivePlayback:
    """A live stream under way: `play` it; `report` says how far it has come.

    `minutes`: those that have ended, and the one under way. `sent`: packets behind which the controller was asked
    where it is. `clock`: of the controller; its round trips have the numbers of `sent`. Nothing is read back of a
    stream of more than _MAX_VALUES, nor once it has left out packets or begun again.
    """

    def __init__(
        self,
        session: Session,
        stream: live.LiveStream,
        name: str,
        *,
        model: models.Model | None = None,
        ask_s: float = ASK_S,
        provenance: Provenance | None = None,
    ) -> None:
        """`model`: of the stream. `ask_s`: how often the controller is asked where it is. `name`: for the report."""
        self.session, self.stream, self.name = session, stream, name
        self._model, self._ask_every_s, self._provenance = model, ask_s, provenance or Provenance()
        self._blocks: list[Signal] = []
        self._packets: list[bytes] = []
        self._keeps = True
        self._late_packets = 0
        stream.on_packets = self._keep
        self._before = self._counts()
        self.minutes = [Minute(0.0)]
        self.sent: list[Sent] = []
        self.clock = DeviceClock(stream.controller)
        stream.controller.watch_time()
        self._late_ms: list[float] = []
        self._ask_s = self._coded_s = 0.0

    def play(self, blocks: Iterable[Signal], progress: Callable[[Status], None] | None = None) -> Playback:
        """Stream blocks (n, channels) as `live.play` does, read back, compare, and return what happened.

        Raises as `live.play`, and CodecError; `report` then says how far it came.
        """

        def note(status: Status) -> None:
            self._note(status)
            if progress is not None:
                progress(status)

        try:
            result = live.play(self.stream, self._kept(blocks), progress=note)
        finally:
            self._close()
        return self._compared(result)

    def paced(self, samples: Signal) -> Iterator[Signal]:
        """Yield blocks of samples (n, channels) when each is due; note when each was sent, and where the device is."""
        stream, controller = self.stream, self.stream.controller
        held_s = 0.0  # by how much later it is because the controller was waited for
        for due_s, block in live.paced(stream, samples, self.clock.sleep):
            awake_s, packets, waited_s = controller.clock(), stream.packets_sent, controller.waited_s
            held_s = min(held_s, max(0.0, awake_s - due_s))
            late_s = awake_s - due_s - held_s
            self._late_ms.append(1e3 * late_s)
            yield block
            held_s += controller.waited_s - waited_s
            sent_s = controller.clock()
            self._count_late(sent_s - due_s - held_s, packets)
            if stream.packets_sent > packets and sent_s >= self._ask_s:
                last_s = due_s - (stream.packet_samples - stream.left_samples) / stream.format.rate_hz
                samples_sent = stream.packets_sent * stream.packet_samples
                self.clock.ask(len(self.sent))
                self.sent.append(Sent(last_s, awake_s, self._coded_s, sent_s, samples_sent, stream.stream))
                self._ask_s = sent_s + self._ask_every_s

    def heard(self, read: Callable[[float], Signal | None]) -> Iterator[Signal]:
        """Yield what a source gives, as `live.heard` does; note by how much each read overran its time."""
        clock = self.stream.controller.clock
        late_s, packets = 0.0, self.stream.packets_sent

        def timed(timeout_s: float) -> Signal | None:
            nonlocal late_s, packets
            self._count_late(late_s, packets)
            until_s, packets = clock() + timeout_s, self.stream.packets_sent
            samples = read(timeout_s)
            late_s = max(0.0, clock() - until_s)
            self._late_ms.append(1e3 * late_s)
            return samples

        return live.heard(self.stream, timed)

    def _count_late(self, late_s: float, packets_before: int) -> None:
        """Count the packets that were sent since then, where the host was too late for them."""
        if late_s > self.stream.playout_delay_s / 2:
            self._late_packets += max(0, self.stream.packets_sent - packets_before)

    def _kept(self, blocks: Iterable[Signal]) -> Iterator[Signal]:
        seconds = 0.0
        for block in blocks:
            if self._keeps and seconds < COMPARED_S and len(block):
                self._blocks.append(block)
                seconds += len(block) / self.stream.format.rate_hz
            yield block

    def _keep(self, packets: Sequence[bytes]) -> None:
        stream, self._coded_s = self.stream, self.stream.controller.clock()
        values = len(self._packets) * stream.packet_samples * stream.format.channels
        broken = stream.dropped_packets or stream.earlier or stream.pauses
        self._keeps = self._keeps and not (broken or values > _MAX_VALUES)
        if self._keeps:
            self._packets += packets

    @property
    def coded(self) -> Stream | None:
        """The packets that were sent, as a stream; None where they are too few to hold a signal."""
        if len(self._packets) * self.stream.packet_samples <= self.stream.delay_samples:
            return None
        header = replace(self.stream.header, samples=None)
        return Stream(header, tuple(self._packets), None if self._model is None else self._model.image)

    def _compared(self, result: live.LiveResult) -> Playback:
        """Compare the coded signal with its source, and the controller's captures with both."""
        session, coded = self.session, self.coded
        if coded is None:
            return Playback(session, None, self.report(), "", ())
        snr_db, traces = self._quality(coded)
        decoded = dac = None
        if self._keeps and not (result.lost_packets or result.underruns or result.streams > 1 or result.pauses):
            decoded, dac = self._as_sent(coded)
        report = self.report(traces, snr_db, decoded, dac)
        return Playback(session, coded, report, playback.caption(session, playback.COMPUTED), traces)

    def _quality(self, whole: Stream) -> tuple[float | None, tuple[Trace, ...]]:
        """Return the SNR of coding and the traces, at the skin by models; nothing where the stream was too short."""
        header = whole.header
        signal = np.concatenate([np.zeros((0, header.channels)), *self._blocks])
        samples = min(len(signal), len(self._packets) * whole.packet_samples - whole.delay_samples)
        if samples < _MIN_S * header.rate_hz:
            return None, ()
        needed = -(-(samples + whole.delay_samples) // whole.packet_samples)
        stream = replace(whole, header=replace(header, samples=samples), packets=whole.packets[:needed])
        signals = {"source": signal[:samples], "decoded": stream.decode()}
        snr_db = codec.snr_db(*signals.values())
        skin_um = playback.at_the_skin(stream, self.session.driven, self.session.skin).samples
        traces = playback.traces_of(signals, header, self.session.driven, skin_um)
        return snr_db if snr_db is not None and math.isfinite(snr_db) else None, traces

    def _as_sent(self, coded: Stream) -> tuple[bool | None, bool | None]:
        """Return whether the controller decoded the end of the stream and computed its DAC codes as this computer."""
        controller, header = self.session.controller, coded.header
        keeps = controller.description.limits.capture_samples
        if not keeps:
            return None, None
        offline = coded.decode_integers()
        codes, _ = render(header, offline, coded.delay_samples, self.session.driven)
        values = _READ_BACK_S * self.stream.link_bytes_per_second / len(Tap) / offline.itemsize
        newest = int(min(values / header.channels, keeps))

        def ends(tap: Tap, computed: NDArray[np.int16]) -> bool:
            return Captured(*read_capture(controller, tap, header.channels, newest)).ends(computed)

        return ends(Tap.DECODED, offline), ends(Tap.DAC, codes) if self.session.unknown_note is None else None

    def report(
        self,
        traces: Sequence[Trace] = (),
        snr_db: float | None = None,
        decoded: bool | None = None,
        dac: bool | None = None,
    ) -> Report:
        """Return the figures so far. `traces`, `snr_db`, `decoded`, `dac`: the comparison, if any."""
        stream, result = self.stream, self.stream.result()
        latency_ms, jitter_ms, drift_ppm = self._timing()
        algorithmic_s = stream.packet_s + stream.delay_samples / stream.format.rate_hz
        at_end = playback.at_the_device(self.session, stream.status, traces)
        return Report(
            run=self._provenance,
            file=self.name,
            device=at_end.device,
            sound_card=at_end.sound_card,
            actuator=at_end.actuator,
            codec=stream.codec_name,
            model=None if self._model is None else self._model.name,
            channels=stream.format.channels,
            stream_rate_hz=stream.format.rate_hz,
            seconds=result.seconds,
            wire=Wire(result.wire_bytes, None, *result.wire_faults),
            quality=Quality(snr_db=snr_db, skin=at_end.skin, skin_note=at_end.skin_note),
            timing=Timing(1e3 * algorithmic_s, None, latency_ms, jitter_ms, drift_ppm),
            underruns=result.underruns,
            packets=result.packets,
            lost_packets=result.lost_packets,
            reconnects=result.reconnects,
            decoded_equals_offline=decoded,
            dac_equals_offline=dac,
            comparison_note=self.session.unknown_note,
            live=LiveFigures(
                packet_ms=1e3 * stream.packet_s,
                playout_delay_ms=1e3 * stream.playout_delay_s,
                payload_bits_per_second=result.payload_bps,
                wire_bits_per_second=result.wire_bps,
                wire_adds=result.wire_adds,
                dropped_packets=result.dropped_packets,
                streams=result.streams,
                pauses=result.pauses,
                left_out_packets=result.left_out_packets,
                minutes=tuple(self.minutes),
            ),
            doubt=self._doubt(result),
        )

    def _doubt(self, result: live.LiveResult) -> str:
        """Return why losses, or else the delay, may be this machine's doing; empty where they are not."""
        if result.device_restarts:
            return ""
        late, losses = self._late_packets, result.lost_packets + result.underruns
        if late > (_HOSTS_SHARE * losses if losses else _LATE_SHARE * result.packets):
            return f"this machine handled {late} packets too late"
        return self.stream.controller.doubt(math.inf)

    def latency_s(self) -> float | None:
        """Return the time from when a sample was taken until the skin moves by it; None where nothing is known of it.

        The source takes its sample k at (k + 1) / rate, and the DAC begins it at k / rate. Positions are whole samples
        that have been played, so that the earliest of some estimates is the best; clocks drift, so that the median of
        these is.
        """
        if not self.clock.trips:
            return None
        rate_hz = self.stream.format.rate_hz
        fit = self.clock.fit()
        starts_s = []
        for number, (_, _, status) in self.clock.trips.items():
            sent = self.sent[number]
            if status.state == State.PLAYING and status.position and status.stream == sent.stream:
                at_s = fit.host_time_s(status.device_time_us / 1e6) - sent.due_s
                starts_s.append(at_s + (sent.samples - status.position - 1) / rate_hz)
        if not starts_s:
            return None
        least_s = [min(starts_s[first : first + _GROUP]) for first in range(0, len(starts_s), _GROUP)]
        chain_s = playback.output_delay_s(self.stream.header, self.session.driven)
        return float(np.median(least_s)) + self.stream.delay_samples / rate_hz + chain_s

    def arrived_s(self) -> NDArray[np.float64]:
        """Return when packets had come, relative to when their last samples were taken: of those with an answer."""
        fit = self.clock.fit()
        trips = self.clock.trips.items()
        return np.array(
            [fit.host_time_s(status.device_time_us / 1e6) - self.sent[number].due_s for number, (_, _, status) in trips]
        )

    def _timing(self) -> tuple[float | None, float | None, float | None]:
        """Return latency and jitter of arrivals in ms, and the controller's drift in ppm; None: unknown."""
        trips = len(self.clock.trips)
        latency_s = self.latency_s()
        latency_ms = None if latency_s is None else 1e3 * latency_s
        if trips < _MIN_TRIPS:
            return latency_ms, None, None
        early_s, late_s = np.quantile(self.arrived_s(), (0.05, 0.95))
        return latency_ms, 1e3 * float(late_s - early_s), self.clock.fit().drift_ppm

    def _counts(self) -> dict[str, int]:
        """Return the counts of the stream so far, by the fields of Minute."""
        result = self.stream.result()
        return {
            "packets": result.packets,
            "underruns": result.underruns,
            "lost_packets": result.lost_packets,
            "dropped_packets": result.dropped_packets,
            "restarts": result.streams - 1,
            "device_restarts": result.device_restarts,
            "pauses": result.pauses,
            **result.wire_faults._asdict(),
            "output_gaps": sum(status.output_gaps for status in (*self.stream.earlier, self.stream.status)),
            "late_packets": self._late_packets,
        }

    def _note(self, status: Status) -> None:
        """Take in a status; begin another minute when one has ended."""
        minute = self.minutes[-1]
        if status.state == State.PLAYING and status.buffered_samples:
            ready_ms = 1e3 * status.buffered_samples / self.stream.format.rate_hz
            minute.margin_ms = ready_ms if minute.margin_ms is None else min(ready_ms, minute.margin_ms)
        if self.stream.seconds >= minute.from_s + MINUTE_S:
            self._close()
            self.minutes.append(Minute(minute.from_s + MINUTE_S))

    def _close(self) -> None:
        """Count the minute under way."""
        minute, now = self.minutes[-1], self._counts()
        if self._late_ms:
            minute.host_late_ms = max(0.0, max(self._late_ms))
            early_ms, late_ms = np.quantile(self._late_ms, (0.05, 0.95))
            minute.host_jitter_ms = float(late_ms - early_ms)
            self._late_ms.clear()
        for name, count in now.items():
            setattr(minute, name, max(0, count - self._before[name]))
        minute.cause = cause(minute)
        self._before = now


def play_live(
    session: Session,
    source: Recording,
    *,
    coding: live.LiveCoding | None = None,
    playout_delay_s: float | None = None,
    progress: Callable[[float], None] | None = None,
    provenance: Provenance | None = None,
) -> Playback:
    """Play a recording as a live source would give it. `coding`, `playout_delay_s`: as of `live.LiveStream`.

    `progress`: takes the seconds so far. `provenance`: for the report. Raises as `live.LiveStream`, and CodecError.
    """
    stream = live.LiveStream(
        session.controller, recording_format(source), coding=coding, playout_delay_s=playout_delay_s
    )
    model = None if coding is None else coding.model
    playing = LivePlayback(session, stream, source.name, model=model, provenance=provenance)

    def tell(_: Status) -> None:
        if progress is not None:
            progress(stream.seconds)

    return playing.play(playing.paced(source.samples), tell)


def cause(minute: Minute) -> str | None:
    """Return what made a minute lose something: "host", "wire", "device" or "source"; None where it lost nothing."""
    if not (minute.underruns or minute.lost_packets or minute.restarts or minute.output_gaps):
        return None
    if minute.output_gaps or minute.device_restarts:
        return "device"
    if minute.bad_frames or minute.bad_frames_back or minute.repeated_frames or minute.reordered_frames:
        return "wire"
    # A host that is late takes what waits for it at once, which looks like a pause of the source.
    if minute.late_packets > _HOSTS_SHARE * (minute.underruns + minute.lost_packets):
        return "host"
    return "source" if minute.pauses else "wire"
