"""Hello: the controller's description, and the versions that work together."""

import math

import pytest

from vibrocast.device_protocol.coded_stream import MAX_CHANNELS, MAX_RATE_HZ
from vibrocast.device_protocol.frames import MAX_PAYLOAD_BYTES
from vibrocast.device_protocol.messages import (
    MAX_SEQUENCE,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    ErrorCode,
    Hello,
    HelloResponse,
    SlotState,
    Status,
    StatusRequest,
)
from vibrocast.harness.conformance.fixtures import prerequisite, section
from vibrocast.harness.conformance.probe import NotConforming, Probe, an_error, describe
from vibrocast.harness.conformance.streams import stream_for
from vibrocast.host.controller import MAX_DAC_RATE_HZ, MIN_PAYLOAD_LIMIT_BYTES, MIN_WATCHDOG_MS

# A metre: a larger number was never set.
_LARGEST_STROKE_UM = 1e6


@prerequisite
@section("Session: Version")
def test_hello_names_version_build_and_hardware(hello: HelloResponse) -> None:
    """The controller answers Hello with its version, a build and a hardware id."""
    assert hello.major == PROTOCOL_MAJOR, f"expected major version {PROTOCOL_MAJOR}, came {hello.major}"
    assert hello.build, "expected a build, came an empty text"
    assert hello.hardware, "expected a hardware id, came an empty text"


@prerequisite
@section("Messages: From the controller")
def test_limits_can_be_kept_to(hello: HelloResponse) -> None:
    """The controller announces usable limits: payloads of 256 to 4096 bytes, a channel, rates, a buffer, a watchdog."""
    limits = hello.limits
    assert MIN_PAYLOAD_LIMIT_BYTES <= limits.max_payload_bytes <= MAX_PAYLOAD_BYTES, (
        f"expected payloads of {MIN_PAYLOAD_LIMIT_BYTES} to {MAX_PAYLOAD_BYTES} bytes, came {limits}"
    )
    assert limits.max_packet_bytes > 0, f"expected room for a packet, came {limits}"
    assert 1 <= limits.channels <= MAX_CHANNELS, f"expected 1 to {MAX_CHANNELS} channels, came {limits}"
    assert 1 <= limits.min_rate_hz <= limits.max_rate_hz <= MAX_RATE_HZ, f"expected a range of rates: {limits}"
    assert limits.buffer_samples > 0, f"expected a buffer, came {limits}"
    assert limits.watchdog_ms >= MIN_WATCHDOG_MS, f"expected {MIN_WATCHDOG_MS} ms or more, came {limits}"


@prerequisite
@section("Messages: From the controller")
def test_actuator_is_described(hello: HelloResponse) -> None:
    """The controller describes its actuator: a name, and plausible values of stroke, voltage, band, slew and DAC."""
    actuator = hello.actuator
    values = (actuator.stroke_um, actuator.volts, actuator.lower_hz, actuator.upper_hz, actuator.slew_volts_per_second)
    assert actuator.name, "expected a name, came an empty text"
    assert all(map(math.isfinite, values)), f"expected numbers, came {actuator}"
    assert 0 < actuator.stroke_um <= _LARGEST_STROKE_UM, f"expected a stroke of up to a metre, came {actuator}"
    assert actuator.volts > 0, f"expected a voltage above 0, came {actuator}"
    assert 0 <= actuator.lower_hz < actuator.upper_hz, f"expected a band, came {actuator}"
    assert actuator.slew_volts_per_second >= 0, f"expected a slew of 0 or more, came {actuator}"
    assert 2 <= actuator.dac_bits <= 16, f"expected codes of 2 to 16 bits, came {actuator}"
    assert 1 <= actuator.dac_rate_hz <= MAX_DAC_RATE_HZ, f"expected up to {MAX_DAC_RATE_HZ} Hz, came {actuator}"


@prerequisite
@section("Messages: From the controller")
def test_stream_can_be_played(hello: HelloResponse) -> None:
    """The controller has a waveform codec without a model, and room for its packets in frames and buffer."""
    try:
        stream_for(hello)
    except pytest.skip.Exception as reason:
        raise NotConforming(f"expected a stream that can be played, but {reason}") from None


@section("Messages: From the controller")
def test_codecs_are_named(hello: HelloResponse) -> None:
    """The controller names each codec once, by a number from 1 to 15."""
    numbers = [number for number, _ in hello.codecs]
    assert numbers, "expected a codec, came none"
    assert len(set(numbers)) == len(numbers), f"expected each codec once, came {hello.codecs}"
    assert all(1 <= number <= 15 and text for number, text in hello.codecs), f"expected names, came {hello.codecs}"


@section("Model upload")
def test_slots_are_listed(hello: HelloResponse) -> None:
    """The controller lists no slot or at least two, each once: at most one CONFIRMED and at most one TESTING."""
    states = [image.state for image in hello.images]
    assert len({image.slot for image in hello.images}) == len(states) != 1, f"expected two slots, came {hello.images}"
    assert states.count(SlotState.CONFIRMED) <= 1, f"expected at most one CONFIRMED, came {hello.images}"
    assert states.count(SlotState.TESTING) <= 1, f"expected at most one TESTING, came {hello.images}"


@section("Session: Version")
def test_other_major_version_is_rejected(probe: Probe) -> None:
    """The controller answers UNSUPPORTED_VERSION to another major version, names both, and opens no session."""
    last = probe.sequence
    sequence = (last + 1000) % MAX_SEQUENCE + 1
    answer = probe.ask_body(Hello.TYPE, bytes((PROTOCOL_MAJOR + 1, 3)), sequence)
    text = an_error(answer, ErrorCode.UNSUPPORTED_VERSION, f"Hello of version {PROTOCOL_MAJOR + 1}.3").text
    for version in (f"{PROTOCOL_MAJOR + 1}.3", f"{PROTOCOL_MAJOR}.{probe.description.minor}"):
        assert version in text, f"expected {version} in the text, came {text!r}"
    answer = probe.ask_body(StatusRequest.TYPE, b"", last % MAX_SEQUENCE + 1)
    assert isinstance(answer, Status), f"expected the session of before to go on, came {describe(answer)}"


@section("Session: Version")
@pytest.mark.parametrize("minor", [PROTOCOL_MINOR + 1, 255])
def test_other_minor_versions_work(probe: Probe, minor: int) -> None:
    """The controller answers a host of minor version {minor} like any other."""
    answer = probe.ask(Hello(minor=minor))
    assert isinstance(answer, HelloResponse), f"expected HelloResponse, came {describe(answer)}"
