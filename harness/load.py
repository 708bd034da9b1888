"""Measures what a link and a controller bear: throughput, underruns against load, the longest silence of the host."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vibrocast.codec import Signal, SignalFormat
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.messages import PACKET_OVERHEAD_BYTES, CaptureData, State, StreamData, Tap
from vibrocast.harness.latency import looped
from vibrocast.host import live
from vibrocast.host.controller import Controller
from vibrocast.host.player import BUFFER_S
from vibrocast.host.stream_session import Capture, kept_samples, next_number
from vibrocast.textures import Recording

THROUGHPUT_S = 1.0
LOAD_S = 1.5
CHANNELS = (1, 2, 4, 8, 16)
RATES_HZ = (2800, 8000)

_FRAMES_AT_ONCE = 8
_READ_S = 0.01
_START_S = 0.05  # from the first packet to its playing: time to send the others that fill the buffer
_MIN_WAIT_S = 1e-6
_GAP_STEPS = 5
_AFTER_GAP_S = 0.3


@dataclass(frozen=True)
class Throughput:
    """The capacity of the link, in bytes on the wire a second. `to_host`: requested frame by frame, as captures are.

    `bad_frames`: of those sent, how many arrived damaged.
    """

    to_controller_bytes_per_s: float
    to_host_bytes_per_s: float
    bad_frames: int


@dataclass(frozen=True)
class Load:
    """One live stream with its channels and rate, and the packets that were late."""

    channels: int
    rate_hz: int
    underruns: int
    lost_packets: int

    @property
    def samples_per_s(self) -> int:
        """Of all channels, if every packet came in time; else 0."""
        return 0 if self.underruns or self.lost_packets else self.channels * self.rate_hz


@dataclass(frozen=True)
class Gap:
    """How long the host may be silent while the controller holds `buffer_ms`.

    `survived_ms`: the longest silence without an underrun. `ended_by`: what ended the next longer one, "buffer" or
    "watchdog"; None where none did.
    """

    buffer_ms: float
    survived_ms: float
    ended_by: str | None


def throughput(controller: Controller, texture: Recording) -> Throughput:
    """Measure how many bytes a second cross the link in each direction. Raises as `live.LiveStream`.

    To the controller goes data of a stream that it does not play, which it receives and drops; back come captures.
    """
    _play(controller, texture, 1, RATES_HZ[0], 1.0)
    before = controller.request_status()
    packet = bytes(controller.description.limits.max_payload_bytes - PACKET_OVERHEAD_BYTES)
    data = StreamData(next_number(before.stream), 0, (packet,))
    began_s, sent_before = controller.clock(), controller.bytes_sent
    while (seconds := controller.clock() - began_s) < THROUGHPUT_S:
        for _ in range(_FRAMES_AT_ONCE):
            controller.send(data)
        after = controller.request_status()
    sent = (controller.bytes_sent - sent_before) / seconds
    first = kept_samples(controller, Tap.DAC).start
    capture = Capture(controller, Tap.DAC, 1, first)
    began_s, received_before = controller.clock(), controller.bytes_received
    while (seconds := controller.clock() - began_s) < THROUGHPUT_S:
        if not capture.take(controller.request(capture.request(), CaptureData)):
            capture.samples_read = first
    received = (controller.bytes_received - received_before) / seconds
    return Throughput(sent, received, after.bad_frames - before.bad_frames)


def underruns(
    controller: Controller, texture: Recording, progress: Callable[[float], None] | None = None
) -> tuple[Load, ...]:
    """Stream live at every load that the controller takes, and count what was not in time.

    Raises as `live.LiveStream`.
    """
    limits = controller.description.limits
    loads = [
        (channels, rate_hz)
        for rate_hz in RATES_HZ
        if limits.min_rate_hz <= rate_hz <= limits.max_rate_hz
        for channels in CHANNELS
        if channels <= limits.channels
    ]
    measured = []
    for number, (channels, rate_hz) in enumerate(loads, 1):
        result = _play(controller, texture, channels, rate_hz, LOAD_S)
        measured.append(Load(channels, rate_hz, result.underruns, result.lost_packets))
        if progress is not None:
            progress(number / len(loads))
    return tuple(measured)


def max_gap(
    controller: Controller,
    texture: Recording,
    buffer_s: float = BUFFER_S,
    *,
    progress: Callable[[float], None] | None = None,
) -> Gap:
    """Search the longest silence of the host that a stream survives which was `buffer_s` ahead.

    Beyond the watchdog no buffer helps, so a longer one is not filled. Raises as `live.LiveStream`.
    """
    limits, rate_hz = controller.description.limits, RATES_HZ[0]
    buffer_s = min(buffer_s, limits.watchdog_ms / 1000 + _AFTER_GAP_S, 0.9 * limits.buffer_samples / rate_hz)
    survived_s, max_s = 0.0, min(buffer_s, limits.watchdog_ms / 1000) * (1 + 2.0**-_GAP_STEPS)
    step_s, ended_by = max_s, None
    for number in range(_GAP_STEPS + 1):
        ended = _silence(controller, texture, buffer_s, survived_s + step_s, rate_hz)
        if ended is None:
            survived_s += step_s
        else:
            ended_by = ended
        if survived_s == max_s:
            break
        step_s /= 2
        if progress is not None:
            progress((number + 1) / (_GAP_STEPS + 1))
    return Gap(1e3 * buffer_s, 1e3 * survived_s, ended_by)


def _silence(controller: Controller, texture: Recording, buffer_s: float, gap_s: float, rate_hz: int) -> str | None:
    """Send ahead, be silent, and send the rest; return the cause if the stream ended early."""
    samples = looped(texture, max(buffer_s, gap_s) + 2 * _AFTER_GAP_S, rate_hz).samples
    stream = live.LiveStream(controller, _format(texture, samples, rate_hz), playout_delay_s=_START_S)
    packets = stream.code(samples)
    ahead = round((buffer_s - _START_S) * rate_hz / stream.packet_samples)
    stream.send_packets(packets[:ahead])
    _listen(controller, gap_s)
    stream.send_packets(packets[ahead:])
    _listen(controller, _AFTER_GAP_S)
    status = controller.request_status()
    controller.stop()
    if status.state == State.WATCHDOG:
        return "watchdog"
    return "buffer" if status.underruns or status.lost_packets else None


def _listen(controller: Controller, seconds: float) -> None:
    """Send nothing for a time, and receive messages."""
    until_s = controller.clock() + seconds
    while (left_s := until_s - controller.clock()) >= _MIN_WAIT_S:
        controller.poll(min(left_s, _READ_S))


def _play(controller: Controller, texture: Recording, channels: int, rate_hz: int, seconds: float) -> live.LiveResult:
    samples = np.repeat(looped(texture, seconds, rate_hz).samples, channels, axis=1)
    stream = live.LiveStream(controller, _format(texture, samples, rate_hz))
    return live.play(stream, (block for _, block in live.paced(stream, samples)))


def _format(texture: Recording, samples: Signal, rate_hz: int) -> SignalFormat:
    return live_format(rate_hz, texture.unit, list(np.max(np.abs(samples), axis=0)))
