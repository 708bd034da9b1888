"""Profiles: loading without a gap, playing by the position of the hand, and rejections."""

from dataclasses import replace

import numpy as np
import pytest

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.device_protocol.messages import ErrorCode, HelloResponse, Loop, Position, Start, State, Status, Tap, pack
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import Probe, Undecided, describe, in_state, same_samples
from vibrocast.harness.conformance.streams import (
    RATE_HZ,
    SECONDS,
    dac_samples,
    decoded,
    decoded_as,
    known_actuator,
    need_capture,
    stream_for,
)
from vibrocast.output import profile as rendering

_SAMPLES_PER_METRE, _FINEST_PER_METRE = 20_000, 200_000
# Until the fade-in is over, positions are rendered, and their smoothing has come to rest.
_SETTLED_S = 0.3
_STILL_SAMPLES = 100
_LATER_S = 0.01
_SOON_US = 400_000
_PLACE_NM, _MOVED_NM, _HELD_US = 3_333_333, 400_000, 10_000
# A controller decodes a profile block by block.
_LOADED_S = 0.3
# Of the buffer, and somewhat more.
_QUARTER = 0.35


@pytest.fixture
def profile(hello: HelloResponse) -> Stream:
    """A profile that can be rendered."""
    return profile_for(hello, SECONDS)


def profile_for(hello: HelloResponse, seconds: float) -> Stream:
    """Return a texture of this length as a profile that can be rendered; skip the test where there is none."""
    limits, dac_rate_hz = hello.limits, hello.actuator.dac_rate_hz
    if not limits.profile_samples:
        pytest.skip("the controller takes no profiles")
    coded = stream_for(hello, seconds=seconds)
    profile = replace(coded, header=replace(coded.header, unit=PROFILE_UNIT, rate_hz=_SAMPLES_PER_METRE))
    min_samples = rendering.min_samples(_SAMPLES_PER_METRE, dac_rate_hz)
    if not min_samples <= profile.samples <= limits.profile_samples:
        pytest.skip(f"no profile of {min_samples} to {limits.profile_samples} samples is there to be tested")
    return profile


def played_at(probe: Probe, profile: Stream, position_nm: int) -> None:
    """Load a profile and play it under a hand that rests at a place, until the output has settled."""
    probe.feed(probe.configure(profile).stream, profile)
    probe.expect(Start(), Status)
    probe.wait_for_state(State.PLAYING)
    rest_at(probe, position_nm)


def rest_at(probe: Probe, position_nm: int) -> None:
    """Say where the hand is, later than was said before, and let the output settle."""
    probe.listen(_LATER_S)
    probe.send(pack(Position(0, position_nm)))
    probe.listen(_SETTLED_S)


@section("Playing: Profiles")
def test_profile_is_loaded_without_gaps(probe: Probe, profile: Stream) -> None:
    """The controller reports in Status.position how much of a profile is loaded without a gap, for any packet order."""
    if len(profile.packets) < 3:
        pytest.skip("the profile has too few packets to leave one out")
    packet_samples = profile.packet_samples
    number = probe.configure(profile).stream
    for sent, loaded in ((profile.packets[:1], 1), (profile.packets[2:], 1), (profile.packets, len(profile.packets))):
        probe.feed(number, profile, sent)
        probe.listen(_LOADED_S)
        status = probe.status()
        assert status.position == loaded * packet_samples, f"expected {loaded} packets loaded, came {describe(status)}"
    decoded_as(probe, decoded(profile), "what was decoded of a profile")


@section("Playing: Credit")
def test_credit_that_has_grown_is_notified(probe: Probe, hello: HelloResponse) -> None:
    """The controller sends Status when credit has grown by a quarter of the first credit, also before Start."""
    profile = profile_for(hello, _QUARTER * hello.limits.buffer_samples / RATE_HZ)
    packet_samples = profile.packet_samples
    first = probe.configure(profile)
    probe.notified.clear()
    probe.send_packets(first.stream, profile.packets[: first.credit_until // packet_samples])
    probe.listen(_LOADED_S)
    told = [status.credit_until for status in probe.notified if isinstance(status, Status)]
    grown = probe.status().credit_until
    if grown < 1.25 * first.credit_until + packet_samples:
        pytest.skip("no profile for this controller is long enough")
    assert max(told, default=0) >= 1.25 * first.credit_until, (
        f"expected a notification of credit that has grown from {first.credit_until} to {grown}, came {told or 'none'}"
    )


@long
@section("Playing: Profiles")
def test_profile_waits_for_all_of_it(probe: Probe, profile: Stream) -> None:
    """After Start, the controller is ARMED until the profile is complete, then PLAYING until it is stopped."""
    number = probe.configure(profile).stream
    probe.feed(number, profile, profile.packets[1:])
    probe.expect(Start(), Status)
    probe.listen(1.2)
    in_state(probe.status(), State.ARMED, "a profile without its first packet")
    probe.feed(number, profile, profile.packets[:1])
    probe.wait_for_state(State.PLAYING)
    probe.listen(2 * profile.seconds)
    in_state(probe.status(), State.PLAYING, "a profile, after a while")
    probe.stop()


@section("Playing: Rendering")
def test_hand_at_rest_holds_the_output(probe: Probe, hello: HelloResponse, profile: Stream) -> None:
    """Under a hand at rest, the controller holds exactly the expected DAC code of the height there."""
    need_capture(hello)
    actuator = known_actuator(hello.actuator)
    played_at(probe, profile, _PLACE_NM)
    probe.expect(Loop(1), Status)  # changes nothing
    end = probe.read_capture(Tap.DAC, (1 << 64) - 1, 0, 1).end
    held = probe.read_capture(Tap.DAC, end - min(end, _STILL_SAMPLES), _STILL_SAMPLES, 1)
    delay_samples = profile.delay_samples
    samples = round(_SETTLED_S * actuator.dac_rate_hz)
    hand = [(0, _PLACE_NM)]
    _, codes = rendering.render(profile.header, decoded(profile), delay_samples, hand, samples, actuator)
    came = np.frombuffer(held.data, "<i2").astype(np.int16).reshape(-1, 1)
    assert len(came), "expected samples of the DAC, came none"
    same_samples(came, np.broadcast_to(codes[-1], came.shape), "DAC codes under a hand at rest")


@section("Playing: Rendering")
def test_moving_hand_is_followed_in_time(probe: Probe, hello: HelloResponse, profile: Stream) -> None:
    """Under a moving hand, the controller gives exactly the expected DAC codes, 20 ms behind its positions."""
    need_capture(hello)
    actuator = known_actuator(hello.actuator)
    probe.feed(probe.configure(profile).stream, profile)
    start_us = probe.status().device_time_us + _SOON_US + round(3e6 * probe.answer_s)
    probe.expect(Start(start_us), Status)
    probe.send(pack(Position(0, _PLACE_NM)))
    probe.wait_for_state(State.PLAYING)
    probe.listen(_SETTLED_S)
    now_us = probe.status().device_time_us
    hand = [(now_us - _HELD_US, _PLACE_NM), (now_us - 1, _PLACE_NM + _MOVED_NM)]
    for time_us, position_nm in hand:
        probe.send(pack(Position(time_us, position_nm)))
    late_us = probe.status().device_time_us - now_us
    probe.listen(_SETTLED_S)
    played = dac_samples(probe)
    probe.stop()
    if late_us > rendering.HAND_DELAY_US - _HELD_US:
        raise Undecided(f"the positions came {late_us / 1000:.0f} ms late")
    first, came = probe.captured(Tap.DAC, 1)
    _, expected = rendering.render(
        profile.header,
        decoded(profile),
        profile.delay_samples,
        [(0, _PLACE_NM), *hand],
        played,
        actuator,
        start_us=start_us,
    )
    same_samples(came[: played - first], expected[first:], "DAC codes under a moving hand")


@section("Playing: Position")
def test_positions_do_no_harm(probe: Probe, hello: HelloResponse, profile: Stream) -> None:
    """The controller answers no Position, and gives the same height again when the hand returns."""
    need_capture(hello)
    played_at(probe, profile, 5_000_000)
    codes = []
    for _ in range(2):
        end = probe.read_capture(Tap.DAC, (1 << 64) - 1, 0, 1).end
        codes.append(probe.read_capture(Tap.DAC, end - 1, 1, 1).data)
        for time_us in (0, 1, (1 << 64) - 1):
            for position_nm in (0, -(1 << 63), (1 << 63) - 1, 1 << 40, -(1 << 40), 50_000_000):
                probe.unanswered(pack(Position(time_us, position_nm)), "a Position")
        rest_at(probe, 5_000_000)
    assert codes[0] == codes[1], f"expected the code {codes[0].hex()} again, came {codes[1].hex()}"


@section("Playing: Position")
def test_late_positions_are_counted(probe: Probe, profile: Stream) -> None:
    """The controller counts an underrun when a late Position shows that the hand has moved, and none at rest."""
    played_at(probe, profile, 1_000_000)
    for position_nm, underruns in ((1_000_000, 0), (2_000_000, 1), (2_000_000, 1)):
        rest_at(probe, position_nm)
        status = probe.status()
        assert status.underruns == underruns, f"expected {underruns} underruns, came {describe(status)}"


@section("Playing: Profiles")
def test_profiles_that_are_rejected(probe: Probe, profile: Stream) -> None:
    """The controller answers BAD_VALUE to a live, cut or looped profile, and BEYOND_LIMITS to one too long or short."""
    packets, header = len(profile.packets), profile.header
    min_samples = rendering.min_samples(_FINEST_PER_METRE, probe.description.actuator.dac_rate_hz)
    too_short = replace(header, rate_hz=_FINEST_PER_METRE, samples=min_samples - 1)
    too_long = probe.description.limits.profile_samples + 1
    packets_of_too_long = -(-(too_long + profile.delay_samples) // profile.packet_samples)
    for changed, options, code in (
        (replace(header, samples=None), {"packets": 0}, ErrorCode.BAD_VALUE),
        (header, {"packets": packets - 1}, ErrorCode.BAD_VALUE),
        (header, {"first_packet": packets - 1}, ErrorCode.BAD_VALUE),
        (header, {"loops": 0}, ErrorCode.BAD_VALUE),
        (header, {"loops": 2}, ErrorCode.BAD_VALUE),
        (too_short, {"packets": 1}, ErrorCode.BEYOND_LIMITS),
        (replace(header, samples=too_long), {"packets": packets_of_too_long}, ErrorCode.BEYOND_LIMITS),
    ):
        probe.expect_rejection(replace(probe.configuration(profile, **options), header=changed.pack()), code)
    probe.configure(profile)
    probe.expect_rejection(Loop(2), ErrorCode.BAD_VALUE)
