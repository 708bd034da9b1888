"""Configure: its rejections and their codes, and the first credit."""

import struct
from dataclasses import replace

import pytest

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import IMAGE_HASH_BYTES, MAX_CHANNELS, MAX_RATE_HZ
from vibrocast.device_protocol.messages import (
    CodingDescription,
    Configure,
    ErrorCode,
    Gain,
    HelloResponse,
    Loop,
    State,
    Status,
)
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import Probe, an_error, describe, in_state
from vibrocast.harness.conformance.streams import held_samples, stream_for


@pytest.fixture
def stream(hello: HelloResponse) -> Stream:
    """A stream that can be played."""
    return stream_for(hello)


def configure_rejected(probe: Probe, stream: Stream, header: bytes, code: ErrorCode, **options: int | float) -> str:
    """Send a Configure that must be rejected; return the text of the Error."""
    return probe.expect_rejection(replace(probe.configuration(stream, **options), header=header), code).text


@section("Playing: Configure")
@pytest.mark.parametrize("fault", ["empty", "cut", "magic", "format", "surplus"])
def test_stream_header_that_cannot_be_read(probe: Probe, stream: Stream, fault: str) -> None:
    """The controller answers BAD_VALUE to an unreadable stream header ({fault})."""
    header = stream.header.pack()
    faulty = {
        "empty": b"",
        "cut": header[:-1],
        "magic": bytes([header[0] ^ 0x10]) + header[1:],
        "format": bytes([header[0] + 1]) + header[1:],
        "surplus": header + b"\x00",
    }
    configure_rejected(probe, stream, faulty[fault], ErrorCode.BAD_VALUE)


@section("Messages: Error codes")
def test_codec_that_is_not_there(probe: Probe, stream: Stream) -> None:
    """The controller answers UNKNOWN_CODEC to a stream of a codec that HelloResponse does not name."""
    announced = {number for number, _ in probe.description.codecs}
    for number in set(range(1, 16)) - announced:
        configure_rejected(
            probe, stream, replace(stream.header, codec_identifier=number).pack(), ErrorCode.UNKNOWN_CODEC
        )


@section("Messages: Error codes")
def test_configuration_that_the_codec_does_not_take(probe: Probe, stream: Stream) -> None:
    """The controller answers UNKNOWN_CODEC to a configuration that the stream's codec cannot read."""
    configuration = stream.header.configuration
    for faulty in (b"", configuration + bytes(200), b"\xff" * max(1, len(configuration))):
        configure_rejected(probe, stream, replace(stream.header, configuration=faulty).pack(), ErrorCode.UNKNOWN_CODEC)


@section("Messages: Error codes")
def test_image_that_does_not_run(probe: Probe, stream: Stream) -> None:
    """The controller answers UNKNOWN_IMAGE to a stream whose model image does not run, and names the image."""
    unknown = b"\xab\xcd\xef\x01"
    assert len(unknown) == IMAGE_HASH_BYTES, "an image is named by four bytes"
    text = configure_rejected(probe, stream, replace(stream.header, image_hash=unknown).pack(), ErrorCode.UNKNOWN_IMAGE)
    assert unknown.hex() in text.lower(), f"expected {unknown.hex()} in the text, came {text!r}"


@section("Messages: Error codes")
def test_more_channels_than_there_are(probe: Probe, stream: Stream) -> None:
    """The controller answers BEYOND_LIMITS to a stream with more channels than its limit."""
    channels = probe.description.limits.channels
    if channels == MAX_CHANNELS:
        pytest.skip("the controller has as many channels as a stream can have")
    for count in {channels + 1, MAX_CHANNELS}:
        header = replace(stream.header, gains=stream.header.gains * count)
        configure_rejected(probe, stream, header.pack(), ErrorCode.BEYOND_LIMITS)


@section("Messages: Error codes")
def test_rates_beyond_the_limits(probe: Probe, stream: Stream) -> None:
    """The controller answers BEYOND_LIMITS to a stream whose rate is outside its limits."""
    limits = probe.description.limits
    rates = [rate for rate in (limits.min_rate_hz - 1, limits.max_rate_hz + 1) if 1 <= rate <= MAX_RATE_HZ]
    if not rates:
        pytest.skip("the controller takes every rate")
    for rate_hz in rates:
        configure_rejected(probe, stream, replace(stream.header, rate_hz=rate_hz).pack(), ErrorCode.BEYOND_LIMITS)


@section("Playing: Configure")
def test_first_packet_is_one_of_the_iteration(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to a first packet beyond the iteration."""
    packets = len(stream.packets)
    for first_packet in (packets, packets + 1, 0xFFFFFFFF):
        configure_rejected(probe, stream, stream.header.pack(), ErrorCode.BAD_VALUE, first_packet=first_packet)


@section("Playing: Configure")
def test_live_stream_has_one_iteration(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to a live stream with any number of loops but 1, in Configure and Loop."""
    for loops in (0, 2, 0xFFFF):
        configure_rejected(probe, stream, stream.header.pack(), ErrorCode.BAD_VALUE, packets=0, loops=loops)
    probe.configure(stream, packets=0)
    probe.expect_rejection(Loop(2), ErrorCode.BAD_VALUE)


@section("Playing: Configure")
def test_more_packets_than_samples(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to more packets than the samples in the stream header can fill."""
    for packets in (len(stream.packets) + 2, 0xFFFFFFFF):
        configure_rejected(probe, stream, stream.header.pack(), ErrorCode.BAD_VALUE, packets=packets)


@section("Playing: Configure")
def test_iteration_too_short_to_be_repeated(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to the repetition of an iteration under 3 ms, in Configure and Loop."""
    header = replace(stream.header, samples=max(1, stream.header.rate_hz * 2 // 1000)).pack()
    for loops in (0, 2):
        configure_rejected(probe, stream, header, ErrorCode.BAD_VALUE, packets=1, loops=loops)
    in_state(
        probe.expect(replace(probe.configuration(stream, packets=1), header=header), Status),
        State.BUFFERING,
        "Configure",
    )
    probe.expect_rejection(Loop(2), ErrorCode.BAD_VALUE)
    in_state(probe.expect(Loop(1), Status), State.BUFFERING, "Loop")


@section("Playing: Configure")
def test_unknown_flags_are_rejected(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to a flag other than 0x01."""
    body = bytearray(probe.configuration(stream).body())
    for flag in (0x02, 0x80):
        body[1] = flag
        an_error(probe.ask_body(Configure.TYPE, bytes(body)), ErrorCode.BAD_VALUE, f"Configure with flag 0x{flag:02x}")


@section("Playing: Configure")
@pytest.mark.parametrize("gain", [-1.0, float("nan"), float("inf")], ids=["negative", "nan", "infinity"])
def test_gain_is_a_finite_factor(probe: Probe, stream: Stream, gain: float) -> None:
    """The controller answers BAD_VALUE to a gain of {gain}, in Configure and Gain."""
    body = probe.configuration(stream).body()
    packed = struct.pack("<f", gain)
    end = Configure.FIXED.size
    answer = probe.ask_body(Configure.TYPE, body[: end - len(packed)] + packed + body[end:])
    an_error(answer, ErrorCode.BAD_VALUE, f"Configure with gain {gain}")
    probe.configure(stream)
    an_error(probe.ask_body(Gain.TYPE, packed), ErrorCode.BAD_VALUE, f"Gain {gain}")


@section("Playing: Configure")
def test_rejected_configure_changes_nothing(probe: Probe, stream: Stream) -> None:
    """The controller keeps its stream unchanged when it rejects a Configure."""
    before = probe.configure(stream)
    probe.feed(before.stream, stream)
    before = probe.status()
    header = replace(stream.header, image_hash=b"\xab\xcd\xef\x01").pack()
    configure_rejected(probe, stream, header, ErrorCode.UNKNOWN_IMAGE)
    after = probe.status()
    kept = replace(after, device_time_us=before.device_time_us)
    assert kept == before, f"expected {describe(before)}, came {describe(after)}"


@section("Playing: Configure")
def test_answer_says_how_the_stream_is_coded(probe: Probe, hello: HelloResponse, stream: Stream) -> None:
    """From version 2.1 on, only the answer to Configure states the samples of a packet and the delay of the decoder."""
    if hello.minor < 1:
        pytest.skip(f"the controller speaks version {hello.major}.{hello.minor}")
    expected = CodingDescription(stream.packet_samples, stream.delay_samples)
    status = probe.configure(stream)
    assert status.coding == expected, f"expected {expected}, came {status.coding}"
    status = probe.status()
    assert status.coding is None, f"expected none, came {status.coding}"


@section("Playing: Credit")
def test_first_credit(probe: Probe, stream: Stream) -> None:
    """The controller grants whole packets in its answer to Configure: at most its buffer, and at most 1024."""
    packet_samples = stream.packet_samples
    status = probe.configure(stream)
    max_samples = held_samples(probe.description, stream)
    assert packet_samples <= status.credit_until <= max_samples, (
        f"expected a credit up to {max_samples}, came {describe(status)}"
    )
    assert status.credit_until % packet_samples == 0, (
        f"expected whole packets of {packet_samples}, came {describe(status)}"
    )
    assert (status.position, status.buffered_samples) == (0, 0), f"expected an empty buffer, came {describe(status)}"


@section("Playing: Credit")
def test_prebuffer_longer_than_the_buffer(probe: Probe, stream: Stream) -> None:
    """The controller answers BEYOND_LIMITS to a prebuffer longer than its buffer, and accepts one as long."""
    max_samples = held_samples(probe.description, stream)
    probe.configure(stream, prebuffer_samples=max_samples)
    for prebuffer_samples in (max_samples + 1, 0xFFFFFFFF):
        configure_rejected(
            probe, stream, stream.header.pack(), ErrorCode.BEYOND_LIMITS, prebuffer_samples=prebuffer_samples
        )
