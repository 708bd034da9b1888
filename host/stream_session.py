"""One stream on a controller, for every sender: fit it to limits, configure, send on credit, read it back."""

import contextlib
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models, textures
from vibrocast.codec.core import decoding_cycles
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, encode_recording, families, middle
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.layout import MAX_VARINT_BYTES
from vibrocast.device_protocol.messages import (
    COUNTERS,
    STREAM_DATA_HEAD_BYTES,
    CaptureData,
    CaptureRead,
    Configure,
    ErrorCode,
    Limits,
    Queue,
    SinglePacket,
    Start,
    State,
    Status,
    StatusRequest,
    StreamData,
    Tap,
    pack,
)
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import Controller, ControllerError, Steps

_log = logging.getLogger(__name__)

READ_BACK_S = 60.0
"""For so long at most a capture is read back after playing, and longer by the time of its bytes on the slowest link."""
SLOWEST_BYTES_PER_S = 960.0
"""Of a serial port at 9600 baud."""
_MIN_PART = 4
"""A frame of a capture is at least this part full, unless the capture ends in it."""
_FRAME_S = 0.05
"""A frame of a capture keeps the link busy for about so long: half the time after which a request is sent again."""
_MIN_FRAME_BYTES = 64
CARRIED_STEP = 0.002
"""Of what is decoded here and coded again, relative to the RMS value: an error 60 dB below the signal."""
_BUFFERED_PACKETS = 2
"""A controller that holds only one packet of a stream runs dry between two of them."""


def next_number(stream: int) -> int:
    """Return the number of the stream after this one."""
    return (stream + 1) % 256


class StreamSession:
    """A stream that a controller has been configured for, until the next Configure.

    `number`: marks its data. `status`: its last one. `credit_until`: data that ends at or before this position may be
    sent.
    """

    def __init__(self, controller: Controller, number: int, status: Status) -> None:
        """Raises ControllerError for a controller in fault."""
        self.controller = controller
        self.number = number
        self.credit_until = 0
        self.status = status
        self._take(status)

    def send(self, packets: Sequence[bytes], iteration: int = 0) -> None:
        """Send packets in one frame. Raises TransportError, MessageError."""
        alone = len(packets) == 1 and iteration == 0
        self.controller.send(
            SinglePacket(self.number, packets[0]) if alone else StreamData(self.number, iteration, tuple(packets))
        )

    def fitting(self, packets: Sequence[bytes]) -> int:
        """Return how many packets, from the first on, one frame holds."""
        left_bytes = self.controller.description.limits.max_payload_bytes - STREAM_DATA_HEAD_BYTES
        for count, packet in enumerate(packets):
            left_bytes -= len(packet) + MAX_VARINT_BYTES
            if left_bytes < 0:
                return count
        return len(packets)

    def start_steps(self, device_time_us: int = 0) -> Steps[None]:
        """Start it at a device time, 0 = at once. Raises as `Controller.request_steps`."""
        yield from self.controller.request_steps(Start(device_time_us), Status)

    def news(self) -> Status | None:
        """Take in the last Status that came; return it, None if there is no new one of this stream.

        Raises ControllerError for a controller in fault.
        """
        status = self.controller.status
        if status is not None and status.queued is not None and status.queued.stream == self.number:
            self.credit_until = max(self.credit_until, status.queued.credit_until)
        if status is None or status is self.status or status.stream != self.number:
            return None
        self._take(status)
        return status

    def _take(self, status: Status) -> None:
        if status.state == State.FAULT:
            raise ControllerError(
                "the controller reports a fault of its hardware and has stopped; switch it off and on"
            )
        self._log(status)
        self.status = status
        self.credit_until = max(self.credit_until, status.credit_until)

    def _log(self, status: Status) -> None:
        """Log what has changed since the last status."""
        if status.state != self.status.state:
            _log.info("stream %d is %s at %d", status.stream, status.state.name.lower(), status.position)
        for name in COUNTERS:
            if (count := getattr(status, name)) > getattr(self.status, name):
                _log.warning("stream %d: %s %d at %d", status.stream, name, count, status.position)


def configure_steps(
    controller: Controller,
    header: StreamHeader,
    prebuffer_samples: int,
    *,
    packets: int = 0,
    first_packet: int = 0,
    loops: int = 1,
    compensation: bool = True,
    gain: float = 1.0,
) -> Steps[StreamSession]:
    """Set a stream up, under the number after the last one. Raises as `Controller.request_steps`, with advice."""
    status = yield from controller.request_steps(StatusRequest(), Status)
    configure = Configure(
        stream=next_number(status.stream),
        header=header.pack(),
        prebuffer_samples=prebuffer_samples,
        packets=packets,
        first_packet=first_packet,
        loops=loops,
        compensation=compensation,
        gain=gain,
    )
    try:
        accepted = yield from controller.request_steps(configure, Status)
    except ControllerError as error:
        raise explained(controller, header, error) from error
    _log.info(
        "stream %d set up: codec %d, %d channels at %d Hz",
        configure.stream,
        header.codec_identifier,
        header.channels,
        header.rate_hz,
    )
    return StreamSession(controller, configure.stream, accepted)


def queue_steps(
    session: StreamSession, header: StreamHeader, packets: int, *, compensation: bool = True, gain: float = 1.0
) -> Steps[StreamSession | None]:
    """Set a stream up behind the one of a session; return None where it cannot follow that one without a gap.

    Raises as `Controller.request_steps`, but for a rejection.
    """
    controller, number = session.controller, next_number(session.number)
    queue = Queue(
        stream=number,
        header=header.pack(),
        prebuffer_samples=0,
        packets=packets,
        compensation=compensation,
        gain=gain,
    )
    try:
        status = yield from controller.request_steps(queue, Status)
    except ControllerError as error:
        if error.code is None:
            raise
        _log.info("the next stream waits for the end of this one: %s", error)
        return None
    _log.info("stream %d waits behind stream %d", number, session.number)
    return StreamSession(controller, number, replace(status, credit_until=0))


@contextlib.contextmanager
def stopped_on_error(controller: Controller) -> Iterator[None]:
    """Stop the controller first, whatever is raised inside, KeyboardInterrupt included."""
    try:
        yield
    except BaseException:
        # Where the controller is out of reach, its own watchdog stops it.
        with contextlib.suppress(ControllerError, TransportError):
            controller.stop()
        raise


class CaptureOverwritten(ControllerError):
    """Samples that the controller no longer keeps: it captured others before these were read."""


class Capture:
    """The capture of a tap, read back frame by frame.

    `samples_read`: samples per channel, counted as the controller does, up to which it has been read.

    Frames are as long as the link carries in _FRAME_S, measured from frame to frame, so that no Status waits long
    behind one.
    """

    def __init__(self, controller: Controller, tap: Tap, channels: int, first: int = 0) -> None:
        """Read from sample `first` on."""
        self.samples_read = first
        self._controller, self._tap, self._channels = controller, tap, channels
        self._pieces = [np.zeros((0, channels), np.int16)]
        fixed_bytes = len(pack(CaptureData(tap, channels, 0, 0, b"")))
        self._max_samples = (controller.description.limits.max_payload_bytes - fixed_bytes) // (2 * channels)
        self._min_samples = max(1, _MIN_FRAME_BYTES // (2 * channels))
        self._frame_samples = self._min_samples
        self._round_trip_s = math.inf  # the shortest
        self._asked_s: float | None = None  # of a request that is not answered yet

    def request(self) -> CaptureRead:
        """Return the request for the next frame, which is sent now; half of it where the last one was not answered."""
        if self._asked_s is not None:
            self._frame_samples = max(self._min_samples, self._frame_samples // 2)
        self._asked_s = self._controller.clock()
        return CaptureRead(self._tap, self.samples_read, self._frame_samples)

    def _fit(self) -> None:
        """Choose the length of the next frame from the time that this one took beyond the shortest round trip."""
        if self._asked_s is None:
            return
        took_s = self._controller.clock() - self._asked_s
        self._asked_s = None
        self._round_trip_s = min(self._round_trip_s, took_s)
        factor = min(2.0, _FRAME_S / max(took_s - self._round_trip_s, 1e-6))
        self._frame_samples = min(self._max_samples, max(self._min_samples, int(factor * self._frame_samples)))

    def take(self, answer: CaptureData) -> bool:
        """Take in a frame; return whether there is more.

        Raises CaptureOverwritten where samples before it are gone, ControllerError for a frame of another capture.
        """
        keeps = self._controller.description.limits.capture_samples
        if (answer.tap, answer.channels) != (self._tap, self._channels) or answer.offset < self.samples_read:
            raise ControllerError("the controller answers with another capture than asked for; update its firmware")
        if answer.offset > self.samples_read:
            raise CaptureOverwritten(
                f"the controller keeps {keeps} samples of each capture, and overwrote some before they were read; use "
                "a less busy machine"
            )
        piece = np.frombuffer(answer.data, "<i2").astype(np.int16).reshape(-1, self._channels)
        self._pieces.append(piece)
        self.samples_read += len(piece)
        if 0 < len(piece) < self._frame_samples // _MIN_PART and self.samples_read < answer.end:
            raise ControllerError(
                f"the controller sends {len(piece)} captured samples in a frame for {self._frame_samples}, though it "
                "has more; update its firmware"
            )
        self._fit()
        return len(piece) > 0 and self.samples_read < answer.end

    def read_steps(self, until_s: float = math.inf) -> Steps[bool]:
        """Read the next frame; return whether there is more.

        Raises as `take` and `Controller.request_steps`, and ControllerError after a time of the controller's clock.
        """
        if self._controller.clock() > until_s:
            raise ControllerError(
                "reading the capture back takes too long, and the controller says that it has more; restart it"
            )
        return self.take((yield from self._controller.request_steps(self.request(), CaptureData)))

    def samples(self) -> NDArray[np.int16]:
        """Return all that was read: int16 (samples, channels)."""
        return np.concatenate(self._pieces)


def kept_samples(controller: Controller, tap: Tap) -> range:
    """Return the numbers of the samples that a tap still has. Raises as `Controller.request`."""
    answer = controller.request(CaptureRead(tap, 0, 1), CaptureData)
    return range(answer.offset, answer.end)


def read_capture(
    controller: Controller, tap: Tap, channels: int, newest: int | None = None
) -> tuple[int, NDArray[np.int16]]:
    """Return the number of the first sample that a tap still has, and all from there on: int16 (n, channels).

    `newest`: read the last samples only, at most this many per channel. Raises as `Capture.read_steps`.
    """
    kept = kept_samples(controller, tap)
    first = kept.start if newest is None else max(kept.start, kept.stop - newest)
    capture = Capture(controller, tap, channels, first)
    until_s = controller.clock() + READ_BACK_S
    while controller.run(capture.read_steps(until_s)):
        pass
    return first, capture.samples()


def packet_limit(limits: Limits) -> int:
    """Return the samples per channel of the longest packet that a controller takes."""
    return min(limits.packet_samples, limits.buffer_samples)


def check_limits(controller: Controller, channels: int, rate_hz: int) -> None:
    """Raise StreamError, with the limit, if the controller cannot play a stream of these channels and this rate."""
    limits = controller.description.limits
    if channels > limits.channels:
        raise StreamError(
            f"{channels} channels, the controller has {limits.channels}",
            action="take some with `columns`, combine three with `reduce`, or play on another controller",
            parameter=("columns", "reduce"),
        )
    if not limits.min_rate_hz <= rate_hz <= limits.max_rate_hz:
        nearest_hz = min(max(rate_hz, limits.min_rate_hz), limits.max_rate_hz)
        raise StreamError(
            f"a stream of {rate_hz} Hz, the controller takes {limits.min_rate_hz} to {limits.max_rate_hz} Hz",
            action=f"encode the recording with `stream_rate_hz` {nearest_hz}",
            parameter="stream_rate_hz",
        )


def check_unit(stream_unit: str, unit: str | None) -> None:
    """Raise CodecError where nobody said how far a signal in this unit moves an actuator.

    `unit`: what the user says of it: "drive" for a signal in "full scale" that is the actuator's drive signal.
    """
    if stream_unit == "full scale" and unit != "drive":
        raise codec.CodecError(
            "the signal does not state its unit, so how far it moves the actuator is unknown",
            action="encode it with its unit and full scale, or pass `unit` drive to play it as the actuator's drive "
            "signal",
            parameter="unit",
        )


def check_packet(controller: Controller, packet_samples: int) -> None:
    """Raise ControllerError if the controller does not take a packet of this many samples."""
    limit = packet_limit(controller.description.limits)
    if packet_samples > limit:
        raise ControllerError(
            f"a packet has {packet_samples} samples, and the controller takes at most {limit}; choose shorter packets, "
            "or a higher rate"
        )


def fitted(controller: Controller, stream: Stream) -> Stream:
    """Return the stream as the controller takes it: itself, or in shorter packets where the codec can split them.

    Raises StreamError, with what to do, for a stream beyond the controller's limits or a damaged one, and CodecError as
    `Stream.decoder`.
    """
    header, limits = stream.header, controller.description.limits
    check_limits(controller, header.channels, header.rate_hz)
    chosen = stream.codec
    samples, size_bytes = packet_limit(limits), limits.sendable_packet_bytes
    if chosen.repack is not None:
        samples = min(samples, limits.buffer_samples // _BUFFERED_PACKETS)
    longest, largest = stream.packet_samples, max(map(len, stream.packets))
    if longest <= samples and largest <= size_bytes:
        return stream
    problem = f"packets of {longest} samples and {largest} bytes, the controller takes {samples} and {size_bytes}"
    if chosen.repack is None:
        raise StreamError(f"{problem}; {_shorter_packets(stream, chosen)}")
    try:
        return stream.repacked(samples, size_bytes)
    except codec.CodecError as error:
        raise StreamError(f"{problem}: {error}") from error


def carried(stream: Stream) -> Stream:
    """Return what a link carries of a stream that the controller does not decode: decoded here, coded again.

    The error of that is CARRIED_STEP / sqrt(12) of the RMS value. Raises CodecError, StreamError.
    """
    header, chosen = stream.header, codec.codec_by_name(codec.DEFAULT_CODEC)
    assert chosen.steps is not None, "the default codec has steps"
    decoded = textures.Recording(stream.decode(), header.rate_hz, "um" if header.spatial else header.unit, "decoded")
    return encode_recording(
        decoded,
        header.rate_hz,
        setting={chosen.steps.parameter: CARRIED_STEP},
        live=True,
        unit=header.unit,
        highpass_hz=None,
        touch=0,
    ).stream


def playable(stream: Stream) -> Stream:
    """Return a stream that controllers decode: itself, or `carried`, where only hosts decode it. Raises as that."""
    return carried(stream) if stream.decoder().hosts_only else stream


def _shorter_packets(stream: Stream, chosen: codec.Codec) -> str:
    """Return how to code the recording of a stream in short packets, which no host can split."""
    options = f"--codec {chosen.name}"
    if stream.model_name is not None:
        options += f" --model {stream.model_name}"
    if stream.header.rate_hz != DEFAULT_STREAM_RATE_HZ:
        options += f" --stream-rate-hz {stream.header.rate_hz}"
    return f"encode the recording again: `vibrocast encode RECORDING OUT.vct {options} --live`"


def explained(controller: Controller, header: StreamHeader, rejection: ControllerError) -> ControllerError:
    """Return why the controller rejected a Configure of this stream, with what to do where decoding takes too long."""
    limit = 1000 * controller.description.limits.decoding_kilocycles_per_s
    if rejection.code != ErrorCode.BEYOND_LIMITS or limit == 0:
        return rejection
    model = models.by_hash(header.image_hash) if header.image_hash else None
    tables = None if model is None else model.tables
    cycles = decoding_cycles(header.codec_identifier, header.configuration, header.channels, tables)
    if cycles * header.rate_hz <= limit:
        return rejection
    choices = list(_lighter(controller, header, limit))
    if limit // cycles >= controller.description.limits.min_rate_hz:
        choices.append(f"--stream-rate-hz {limit // cycles}")
    advice = f"encode the recording with {' or '.join(choices)}" if choices else "use fewer channels"
    return ControllerError(
        f"decoding may take {cycles * header.rate_hz / 1e6:.3g} million cycles a second, and the controller has time "
        f"for {limit / 1e6:.3g}; {advice}",
        rejection.code,
    )


def _lighter(controller: Controller, header: StreamHeader, limit: int) -> Iterator[str]:
    """Yield the options of codings that take at most `limit` cycles a second: another model, and another codec.

    Of each, the one that takes the most of them.
    """
    once = (1.0,) * header.channels
    signal_format = codec.SignalFormat(header.rate_hz, header.unit, header.gains, once)

    def cycles_per_s(chosen: codec.Codec, model: models.Model | None) -> int:
        setting, framing = chosen.live({}, signal_format, model), codec.live_framing(header.rate_hz)
        encoder = chosen.make_encoder(setting, signal_format, framing, model, None)
        tables = None if model is None else model.tables
        return header.rate_hz * decoding_cycles(chosen.identifier, encoder.configuration, header.channels, tables)

    same = codec.codec_by_identifier(header.codec_identifier, header.configuration)
    decoded = [identifier for identifier, _ in controller.description.codecs]
    # The codec itself is another coding where it also works without the model.
    others = [
        each
        for each in codec.BUILT_IN.values()
        if each.identifier in decoded and (each is not same or header.image_hash)
    ]
    costs = (
        {f"--model {middle(members).name}": cycles_per_s(same, middle(members)) for members in families(same)},
        {
            f"--codec {other.name}": cycles_per_s(other, None)
            for other in others
            if other.keeps_waveform and not other.needs_model
        },
    )
    for each in costs:
        fits = [option for option, cycles in each.items() if cycles <= limit]
        if fits:
            yield max(fits, key=each.__getitem__)
