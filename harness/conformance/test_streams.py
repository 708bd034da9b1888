"""Streams: decoded samples and DAC codes equal the computed ones, bit for bit."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast import codec
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import MAX_CHANNELS, UNITS
from vibrocast.device_protocol.messages import HelloResponse, SinglePacket, Start, State, Status, pack
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import ANSWER_S, NotConforming, Probe, Undecided, describe, same_samples
from vibrocast.harness.conformance.streams import decoded, known_actuator, need_capture, need_no_signature, stream_for
from vibrocast.host import player
from vibrocast.host.controller import Controller
from vibrocast.host.stream_session import next_number
from vibrocast.host.uploader import flash
from vibrocast.output.rendering import LimitCounts, render

# Far beyond any actuator's amplifier.
_TOO_LOUD = 30.0


def played(probe: Probe, stream: Stream, **options: int | float | bool) -> player.PlaybackResult:
    """Play a stream as the host does, read back what it did, and see that nothing of it was lost."""
    need_capture(probe.description)
    controller = Controller(probe.link, probe.link.clock, probe.link.sleep)
    settings = player.PlaybackSettings(capture=True, **options)  # type: ignore[arg-type]
    result = player.play(controller, stream, settings)
    if result.state != State.FINISHED or (result.underruns, result.lost_packets) != (0, 0):
        raise NotConforming(f"expected to play to the end without loss, came {result.status}")
    return result


def read_back(samples: NDArray[np.int16] | None) -> NDArray[np.int16]:
    """Return a capture that was asked for."""
    if samples is None:
        raise Undecided("the controller overwrote its capture before this machine read it")
    return samples


def computed(probe: Probe, stream: Stream, **options: int | float | bool) -> tuple[NDArray[np.int16], LimitCounts]:
    """Return the DAC codes of a stream, and what the limits changed; skip the test for an actuator not known here."""
    actuator = known_actuator(probe.description.actuator)
    delay_samples = stream.delay_samples
    return render(stream.header, decoded(stream), delay_samples, actuator, **options)  # type: ignore[arg-type]


def all_channels(hello: HelloResponse) -> int:
    """Return how many channels there are; skip the test where there is one."""
    if hello.limits.channels == 1:
        pytest.skip("the controller has one channel")
    return min(hello.limits.channels, MAX_CHANNELS)


@section("Playing: Positions")
@pytest.mark.parametrize("channels", ["one channel", "all channels"])
@pytest.mark.parametrize("codec_name", list(codec.BUILT_IN))
def test_codec_is_decoded_as_offline(
    probe: Probe, codec_name: str, channels: str, request: pytest.FixtureRequest
) -> None:
    """The controller decodes {codec_name} in {channels} to the same samples as the offline decoder."""
    hello = probe.description
    stream = stream_for(hello, codec_name, 1 if channels == "one channel" else all_channels(hello))
    if stream.image is not None:
        request.getfixturevalue("slot")
        need_no_signature(probe.description)
        flash(Controller(probe.link, probe.link.clock, probe.link.sleep), stream.image)
    result = played(probe, stream)
    same_samples(read_back(result.decoded), decoded(stream), f"{codec_name} in {channels}")


@section("Messages: From the host")
def test_single_packets_count_like_those_of_stream_data(probe: Probe) -> None:
    """The controller plays packets of SinglePacket as those of StreamData, and drops those of other streams."""
    stream = stream_for(probe.description)
    status = probe.configure(stream)
    if status.credit_until < len(stream.packets) * stream.packet_samples:
        pytest.skip("the controller's buffer does not hold the stream")
    for number in (next_number(status.stream), status.stream):
        for packet in stream.packets:
            probe.send(pack(SinglePacket(number, packet)))
        expected = number == status.stream
        buffered = probe.status().buffered_samples
        assert (buffered > 0) == expected, f"expected packets in the buffer: {expected}; {buffered} samples are there"
    probe.expect(Start(), Status)
    finished = probe.wait_for_state(State.FINISHED, ANSWER_S + 2 * stream.seconds)
    assert finished.lost_packets == finished.underruns == 0, describe(finished)
    assert finished.position == len(stream.packets) * stream.packet_samples, describe(finished)


@section("Playing: Positions")
def test_loops_are_decoded_one_after_the_other(probe: Probe) -> None:
    """The controller decodes each of three iterations from a fresh state."""
    stream = stream_for(probe.description)
    result = played(probe, stream, loops=3)
    same_samples(read_back(result.decoded), np.tile(decoded(stream), (3, 1)), "three iterations")


@section("Playing: Capture")
@pytest.mark.parametrize("unit", UNITS)
def test_dac_codes_of_each_unit(probe: Probe, unit: str) -> None:
    """The controller gives exactly the expected DAC codes for a stream in {unit}, with compensation."""
    stream = stream_for(probe.description, unit=unit)
    expected, _ = computed(probe, stream)
    same_samples(read_back(played(probe, stream).dac_codes), expected, f"DAC codes of a stream in {unit}")


@section("Playing: Capture")
def test_dac_codes_of_all_channels(probe: Probe) -> None:
    """The controller gives exactly the expected DAC codes in all its channels, without compensation."""
    stream = stream_for(probe.description, channels=all_channels(probe.description))
    expected, _ = computed(probe, stream, compensation=False)
    result = played(probe, stream, compensation=False)
    same_samples(read_back(result.dac_codes), expected, "DAC codes of all channels")


@section("Playing: Positions")
def test_dac_codes_of_loops(probe: Probe) -> None:
    """The controller gives exactly the expected DAC codes over three iterations with a gain of 0.5."""
    stream = stream_for(probe.description)
    expected, _ = computed(probe, stream, loops=3, gain=0.5)
    same_samples(
        read_back(played(probe, stream, loops=3, gain=0.5).dac_codes), expected, "DAC codes of three iterations"
    )


@section("Playing: Limits of the output")
@pytest.mark.parametrize("compensation", [True, False], ids=["on", "off"])
def test_limits_act_and_are_counted(probe: Probe, compensation: bool) -> None:
    """The controller limits a far too loud stream exactly as expected, and counts it (compensation: {compensation})."""
    stream = stream_for(probe.description, unit="full scale", seconds=1.2)
    expected, counts = computed(probe, stream, gain=_TOO_LOUD, compensation=compensation)
    result = played(probe, stream, gain=_TOO_LOUD, compensation=compensation)
    same_samples(read_back(result.dac_codes), expected, "DAC codes of a stream that is too loud")
    status = result.status
    came = LimitCounts(status.compensation_clipped, status.voltage_limited, status.slew_limited, status.power_limited)
    assert came == counts, f"expected {counts}, came {came}"


@section("Playing: Configure")
def test_gain_of_zero_keeps_the_output_at_rest(probe: Probe) -> None:
    """The controller gives the DAC code 0 throughout at a gain of 0."""
    codes = read_back(played(probe, stream_for(probe.description), gain=0.0).dac_codes)
    assert len(codes), "expected DAC codes, came none"
    assert not codes.any(), f"expected nothing but 0, came codes up to {np.abs(codes).max()}"


@section("Playing: Limits of the output")
def test_dac_codes_stay_within_the_dac(probe: Probe) -> None:
    """The controller keeps the DAC codes of any stream within the DAC's range."""
    stream = stream_for(probe.description, unit="full scale")
    codes = read_back(played(probe, stream, gain=_TOO_LOUD).dac_codes)
    beyond = 1 << probe.description.actuator.dac_bits - 1
    assert codes.any(), "expected DAC codes, came none but 0"
    lowest, highest = int(codes.min()), int(codes.max())
    assert -beyond <= lowest <= highest < beyond, (
        f"expected codes from {-beyond} to {beyond - 1}, came {lowest} to {highest}"
    )


@section("Playing: Limits of the output")
def test_streams_begin_alike(probe: Probe) -> None:
    """The controller gives a stream the same DAC codes after one that is far too loud."""
    stream = stream_for(probe.description, unit="full scale", seconds=1.2)
    first = read_back(played(probe, stream).dac_codes)
    played(probe, stream, gain=_TOO_LOUD)
    same_samples(read_back(played(probe, stream).dac_codes), first, "DAC codes behind a loud stream")
