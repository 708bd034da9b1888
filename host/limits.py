"""Fits streams to a controller's limits: splits packets that are too long, or says which option gives what fits."""

from collections.abc import Iterator

from vibrocast import codec, models, textures
from vibrocast.codec.core import decoding_cycles
from vibrocast.codec.encoding import (
    DEFAULT_STREAM_RATE_HZ,
    encode_recording,
    families,
    middle,
)
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import ErrorCode, Limits
from vibrocast.host.controller import Controller, ControllerError

CARRIED_STEP = 0.002
"""Of what is decoded here and coded again, relative to the RMS value: an error 60 dB below the signal."""
_BUFFERED_PACKETS = 2
"""A controller that holds only one packet of a stream runs dry between two of them."""


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
    chosen = codec.codec_by_name(stream.codec_name)
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
