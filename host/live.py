"""Streams a live source to a controller: blocks are coded as they come, and each packet is sent at once. No threads."""

import contextlib
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import codec
import models
from codec import Signal, SignalFormat
from device_protocol.coded_stream import StreamHeader
from device_protocol.frames import write_frame
from device_protocol.messages import Configure, EndStream, Start, State, Status, StreamData, pack
from device_protocol.transports import TransportError
from host import coding
from host.controller import ConnectionLost, Controller, ControllerError
from host.link import LinkModel
from host.player import RECONNECT_S, check_limits

# How long a packet lies on the controller before it is needed: what sending may be late by. All of it is delay.
MARGIN_S = 0.01
REFRESH_S = 0.25
# RMS value that a source is taken to have where nothing is known of it, relative to its full scale.
EXPECTED_RMS = 0.2

# The controller's clock and the source's drift apart: beyond the margin on one side, or so much on the other, for so
# long, the stream is begun anew.
_LARGEST_GROWTH_S = 0.02
_OUT_OF_STEP_S = 0.25
_END_S = 5.0
# What a live source kept before it was heard may come at once; what floods so many streams in a row is none.
_FLOOD_FACTOR = 1.5
_MOST_FLOODS = 4
_POLL_S = 0.005


class LiveError(ValueError):
    """A source that is not live; the message says what to do."""


@dataclass(frozen=True)
class LiveResult:
    """What live streaming did.

    `status`: the last one. `underruns`, `lost_packets`: of all streams. `streams`: more than one where it was begun
    anew, as clocks had drifted apart, the source had paused or the connection was lost.
    """

    status: Status
    underruns: int
    lost_packets: int
    streams: int


def live_format(
    rate_hz: int, unit: str, full_scales: Sequence[float], rms: Sequence[float] | None = None
) -> SignalFormat:
    """Return what an encoder is told of a live source before it comes.

    `full_scales`: the largest magnitude expected of each channel, in `unit`. `rms`: RMS values in `unit`, None =
    EXPECTED_RMS of full scale. Raises CodecError for what cannot be coded.
    """
    gains = tuple(codec.gain_for(full_scale) for full_scale in full_scales)
    if rms is None:
        return SignalFormat(rate_hz, unit, gains, (EXPECTED_RMS,) * len(gains))
    relative = tuple(value / gain or 1.0 for value, gain in zip(rms, gains, strict=True))
    return SignalFormat(rate_hz, unit, gains, relative)


class LiveStream:
    """A live stream on a controller: `send` blocks, `finish` it; playing begins with the first packet.

    `codec_name`: None = that of the model, or the default. `model`: a trained model, which the controller must run.
    `margin_s`: how long packets lie on the controller before they are needed. `packet_samples`: samples per channel in
    a packet, at least those asked for and the codec's shortest block. `header`, `stream`, `packets_sent`, `status`:
    of the stream under way. `begun`: streams so far; `earlier`: the last status of each of those before this one.
    Raises CodecError, LiveError, StreamError for what the controller does not take, ControllerError, TransportError.
    """

    def __init__(
        self,
        controller: Controller,
        signal_format: SignalFormat,
        *,
        codec_name: str | None = None,
        setting: codec.Setting | None = None,
        model: models.Model | None = None,
        packet_samples: int = 1,
        margin_s: float = MARGIN_S,
        gain: float = 1.0,
        compensation: bool = True,
    ) -> None:
        check_limits(controller, signal_format.channels, signal_format.rate_hz)
        self.controller = controller
        self.format = signal_format
        self.margin_s = margin_s
        self.earlier: list[Status] = []
        self._codec, self._model = coding.chosen_codec(codec_name, model), model
        self.setting = self._codec.complete(
            {**live_setting(self._codec.name, signal_format.rate_hz), **(setting or {})}
        )
        # Rounded up to whole blocks: to how many samples, an encoder says.
        encoder = self._make_encoder(codec.Framing(packet_samples, 1))
        self.packet_samples = encoder.packet_samples
        # The first block that is ever coded takes longer than others, and would make all of the stream that much later.
        encoder.encode(np.zeros((self.packet_samples, self.format.channels)))
        self._gain, self._compensation = gain, compensation
        self._floods = 0  # streams in a row
        self._configure()

    @property
    def begun(self) -> int:
        """How many streams have been begun."""
        return len(self.earlier) + 1

    def begin_anew(self) -> None:
        """Set up another stream in place of the one under way; its first packet will start it."""
        self.earlier.append(self.status)
        self._configure()

    def _make_encoder(self, framing: codec.Framing) -> codec.Encoder:
        model = coding.encoder_model(self._model)
        return self._codec.make_encoder(self.setting, self.format, framing, model, None)

    def _configure(self) -> None:
        refresh_packets = max(1, math.floor(REFRESH_S * self.format.rate_hz / self.packet_samples))
        self._encoder = self._make_encoder(codec.Framing(self.packet_samples, refresh_packets))
        self.header = StreamHeader(
            self._codec.identifier,
            self.format.rate_hz,
            None,
            self.format.unit,
            self.format.gains,
            self._encoder.configuration,
            b"" if self._model is None else coding.image_hash(self._model.image),
        )
        self.stream = (self.controller.request_status().stream + 1) % 256
        configure = Configure(
            self.stream, self.header.pack(), self.packet_samples, compensation=self._compensation, gain=self._gain
        )
        self.status = self.controller.request(configure, Status)
        self._link = LinkModel.measured(self.controller)
        self.packets_sent = 0
        self._on_the_way: deque[float] = deque()  # when each packet should arrive, by the controller's clock
        self._began_s = self.controller.clock()
        self._out_of_step_since_s: float | None = None

    def code(self, samples: Signal) -> list[bytes]:
        """Code samples (n, channels) in the format's unit; return the packets that they complete. Raises CodecError."""
        return self._encoder.encode(samples / np.array(self.format.gains))

    def send_packets(self, packets: Sequence[bytes]) -> None:
        """Send packets at once, each in a frame of its own; Start goes with the first, so that none waits for it."""
        for packet in packets:
            data = StreamData(self.stream, 0, (packet,))
            arrives_s = self._link.arrival_s(self.controller.clock(), len(write_frame(pack(data))))
            self.controller.send(data)
            self._on_the_way.append(arrives_s)
            self.packets_sent += 1
            if self.packets_sent == 1:
                # From here on the packets come as evenly as the samples do, so the margin stays as it begins.
                self.controller.ask(Start(round(1e6 * (arrives_s + self.margin_s))))

    def send(self, samples: Signal) -> None:
        """Code and send samples (n, channels), take in what has come; begin anew where the clocks are out of step."""
        self.send_packets(self.code(samples))
        self.poll(0)
        since_s = self._out_of_step_since_s
        out_of_step = since_s is not None and self.controller.clock() - since_s > _OUT_OF_STEP_S
        if out_of_step:
            self._refuse_floods()
        if out_of_step or self.status.state == State.WATCHDOG:
            self.begin_anew()

    def _refuse_floods(self) -> None:
        """Raise LiveError for a source that does not keep its own rate: what is ahead of time would be lost."""
        sent_s = self.packets_sent * self.packet_samples / self.format.rate_hz
        took_s = self.controller.clock() - self._began_s
        self._floods = self._floods + 1 if sent_s > _FLOOD_FACTOR * took_s else 0
        if self._floods == _MOST_FLOODS:
            raise LiveError(
                f"the source gave {sent_s:.1f} s in {took_s:.1f} s, again and again: a live one keeps its rate; play a "
                "recording from its file"
            )

    def poll(self, timeout_s: float) -> None:
        """Take in what the controller sends, waiting for it at most `timeout_s`."""
        self.controller.poll(timeout_s)
        status = self.controller.status
        if status is None or status is self.status or status.stream != self.stream:
            return
        if status.state == State.FAULT:
            raise ControllerError("the controller reports a fault of its hardware and has stopped")
        self.status = status
        while self._on_the_way and self._on_the_way[0] <= status.device_time_us / 1e6:
            self._on_the_way.popleft()
        arrived = self.packets_sent - len(self._on_the_way)
        behind = status.position > arrived * self.packet_samples
        longest_s = self.margin_s + self.packet_samples / self.format.rate_hz + _LARGEST_GROWTH_S
        too_long = status.buffered_samples > longest_s * self.format.rate_hz
        if status.state != State.PLAYING or not (behind or too_long):
            self._out_of_step_since_s = None
        elif self._out_of_step_since_s is None:
            self._out_of_step_since_s = self.controller.clock()

    def finish(self) -> LiveResult:
        """Send the end, wait until it has been played, and return what happened."""
        self.send_packets(self._encoder.finish())
        if self.packets_sent:
            self.controller.request(EndStream(self.stream, self.packets_sent), Status)
            self._wait_for_the_end()
        else:
            self.status = self.controller.stop()
        streams = [*self.earlier, self.status]
        return LiveResult(
            status=self.status,
            underruns=sum(status.underruns for status in streams),
            lost_packets=sum(status.lost_packets for status in streams),
            streams=len(streams),
        )

    def _wait_for_the_end(self) -> None:
        left_samples = self.packets_sent * self.packet_samples - self.controller.request_status().position
        deadline_s = self.controller.clock() + left_samples / self.format.rate_hz + _END_S
        while self.controller.clock() < deadline_s:
            self.status = self.controller.request_status()
            if self.status.state in (State.FINISHED, State.STOPPED, State.WATCHDOG):
                return
            self.controller.poll(_POLL_S)
        raise ControllerError(
            f"the stream's end has not been played {_END_S:g} s after its time. Restart the controller."
        )


def live_setting(codec_name: str, rate_hz: int) -> codec.Setting:
    """Return what of a codec's setting is another for the least delay: half the hop of `mdct`."""
    return {"hop": "16" if rate_hz < 5600 else "32"} if codec_name == "mdct" else {}


def play(
    stream: LiveStream,
    blocks: Iterable[Signal],
    *,
    reconnect_s: float = RECONNECT_S,
    progress: Callable[[Status], None] | None = None,
) -> LiveResult:
    """Stream blocks (n, channels), each as soon as the iterator yields it, to its end; return what happened.

    Whatever is raised, KeyboardInterrupt included, the controller is stopped first. A broken connection is opened anew
    for `reconnect_s`, and the stream begun anew; where the source has kept blocks meanwhile, once more when it has
    caught up. Raises as `LiveStream`.
    """
    try:
        for block in blocks:
            try:
                stream.send(block)
            except (TransportError, ConnectionLost):
                stream.controller.reconnect(reconnect_s)
                stream.begin_anew()
            if progress is not None:
                progress(stream.status)
        return stream.finish()
    except BaseException:
        # Where the controller is out of reach, its own watchdog stops it.
        with contextlib.suppress(ControllerError, TransportError):
            stream.controller.stop()
        raise


def paced(
    stream: LiveStream, samples: Signal, block_samples: int, sleep: Callable[[float], None] | None = None
) -> Iterator[tuple[float, Signal]]:
    """Yield blocks of samples (n, channels), each when its last sample would have been taken, and with that time.

    Times are in seconds of the controller session's clock; `sleep` waits in between, None = the session's.
    """
    sleep = sleep or stream.controller.sleep
    controller, rate_hz = stream.controller, stream.format.rate_hz
    began_s = controller.clock()
    for start in range(0, len(samples), block_samples):
        block = samples[start : start + block_samples]
        due_s = began_s + (start + len(block)) / rate_hz
        sleep(max(0.0, due_s - controller.clock()))
        yield due_s, block
