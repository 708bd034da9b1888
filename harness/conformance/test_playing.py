"""Playing: start, data, credit, losses, pause, loops, live streams, stop."""

import random
from dataclasses import replace

import numpy as np
import pytest

from vibrocast import codec
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import packet_sequence, renumbered
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.device_protocol.messages import (
    EndStream,
    ErrorCode,
    Gain,
    Loop,
    Pause,
    Queue,
    Resume,
    Start,
    State,
    Status,
    Tap,
)
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import ANSWER_S, Probe, describe, in_state
from vibrocast.harness.conformance.streams import (
    constant,
    dac_samples,
    decoded,
    decoded_as,
    held_samples,
    lasting_stream,
    need_capture,
    need_since,
    play_on,
    stream_for,
)
from vibrocast.host.stream_session import next_number

# Longer than requests take to arrive, in addition to the time for their answers.
_SOON_US = 400_000
_MAX_WAIT_S = 1.0
# Behind a Start, of a test in which something happens in the middle.
_REQUESTS = 4
_ENDLESS_PACKETS = 60_000
# Of the stream: the filters of the output may lead, and times are rounded.
_SAMPLES_AHEAD = 32
# A block is decoded and put out meanwhile.
_LATE_S = 0.005
# Of a DAC code, to tell a ramp from a jump.
_MIN_LEVEL = 8


@pytest.fixture
def stream(probe: Probe) -> Stream:
    """A stream that can be played."""
    return stream_for(probe.description)


@pytest.fixture
def longer(probe: Probe) -> Stream:
    """A stream long enough for something to happen in the middle."""
    return lasting_stream(probe, _REQUESTS, seconds=1.0)


def soon_us(probe: Probe) -> int:
    """Return a device time that is still to come when two requests from now have been answered."""
    return probe.status().device_time_us + _SOON_US + round(3e6 * probe.answer_s)


def finished(probe: Probe, stream: Stream, iterations: int = 1) -> Status:
    """Wait for the end of a stream."""
    return probe.wait_for_state(State.FINISHED, ANSWER_S + 2 * iterations * stream.seconds)


def configure_live(probe: Probe, stream: Stream, first_packet: int = 0) -> Status:
    """Set up a live stream, of unknown length, for the packets of a stream."""
    header = replace(stream.header, samples=None).pack()
    configure = replace(probe.configuration(stream, packets=0, first_packet=first_packet), header=header)
    return in_state(probe.expect(configure, Status), State.BUFFERING, "Configure")


def without_loss(status: Status) -> None:
    """Check that nothing was lost."""
    assert (status.underruns, status.lost_packets) == (0, 0), (
        f"expected no underrun and no loss, came {describe(status)}"
    )


@section("Playing: Start")
def test_start_waits_for_the_device_time(probe: Probe, stream: Stream) -> None:
    """The controller waits in ARMED until a future start time, and then plays."""
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    start_us = soon_us(probe)
    probe.expect(Start(start_us), Status)
    latest_s = probe.link.clock() + ANSWER_S + 3 * probe.answer_s
    while (status := probe.status()).device_time_us < start_us:
        assert probe.link.clock() < latest_s, f"expected the device time {start_us} to come, came {describe(status)}"
        in_state(status, State.ARMED, f"{start_us - status.device_time_us} us before the start")
        assert status.position == 0, f"expected the position 0 before the start, came {describe(status)}"
        probe.listen(0.02)
    probe.wait_for(lambda status: status.state in (State.PLAYING, State.FINISHED), "to play", ANSWER_S)
    without_loss(finished(probe, stream))


@section("Playing: Start")
def test_start_at_a_past_time_plays_at_once(probe: Probe, stream: Stream) -> None:
    """The controller plays as soon as the prebuffer is there when the start time is 0 or past."""
    for gone_by_us in (None, 1, 1_000_000):
        number = probe.configure(stream).stream
        probe.feed(number, stream)
        now_us = probe.status().device_time_us
        probe.expect(Start(0 if gone_by_us is None else max(0, now_us - gone_by_us)), Status)
        without_loss(finished(probe, stream))


@section("Playing: Start")
def test_start_waits_for_the_prebuffer(probe: Probe, stream: Stream) -> None:
    """After Start, the controller waits in ARMED until the prebuffer is there."""
    packet_samples = stream.packet_samples
    status = probe.configure(stream, prebuffer_samples=2 * packet_samples)
    granted = status.credit_until // packet_samples
    # Without a request between them: after a second without data, the controller would play what it has.
    if probe.answer_s > _MAX_WAIT_S / 2:
        pytest.skip("the controller answers too late to see it wait for no longer than a second")
    probe.send_packets(status.stream, stream.packets[:1])
    in_state(probe.expect(Start(), Status), State.ARMED, "Start with half of the prebuffer")
    probe.notified.clear()
    probe.listen(_MAX_WAIT_S / 4)
    probe.send_packets(status.stream, stream.packets[1:granted])
    states = {message.state for message in probe.notified if isinstance(message, Status)}
    assert State.PLAYING not in states, f"with half of the prebuffer: expected the state ARMED, came {states}"
    probe.feed(status.stream, stream, stream.packets[granted:])
    without_loss(finished(probe, stream))
    decoded_as(probe, decoded(stream), "after waiting for the prebuffer")


@section("Playing: Start")
def test_all_data_is_enough_for_the_prebuffer(probe: Probe, stream: Stream) -> None:
    """The controller plays a stream shorter than the prebuffer when all of it is there."""
    number = probe.configure(stream, prebuffer_samples=held_samples(probe.description, stream)).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    without_loss(finished(probe, stream))


@long
@section("Playing: Start")
def test_start_does_not_wait_for_ever(probe: Probe, stream: Stream) -> None:
    """The controller plays the packets that it has when no data have arrived for a second."""
    packet_samples = stream.packet_samples
    number = probe.configure(stream, prebuffer_samples=2 * packet_samples).stream
    probe.feed(number, stream, stream.packets[:1])
    probe.expect(Start(), Status)
    probe.wait_for(lambda status: status.state in (State.PLAYING, State.FINISHED), "to play", 2 * _MAX_WAIT_S)


@section("Playing: Stream data")
def test_packets_are_sorted(probe: Probe, stream: Stream) -> None:
    """The controller plays packets in their own order and once, however they arrive."""
    packet_samples = stream.packet_samples
    status = probe.configure(stream)
    granted = stream.packets[: status.credit_until // packet_samples]
    packets = [*granted, *granted]
    random.Random(3).shuffle(packets)
    for packet in packets:
        probe.send_packets(status.stream, [packet])
    buffered_samples, expected = probe.status().buffered_samples, len(granted) * packet_samples
    assert buffered_samples == expected, f"expected {expected} samples buffered, came {buffered_samples}"
    probe.feed(status.stream, stream, stream.packets[len(granted) :])
    probe.expect(Start(), Status)
    without_loss(finished(probe, stream))
    decoded_as(probe, decoded(stream), "packets out of order")


@section("Playing: Stream data")
def test_frames_out_of_turn_are_counted(probe: Probe, stream: Stream) -> None:
    """The controller counts frames that come twice, and frames that come after later ones."""
    need_since(probe.description, Queue)
    before = probe.configure(stream)
    for number in (1, 0, 0, 1):
        probe.send_packets(before.stream, [stream.packets[number]])
    after = probe.status()
    counted = (after.repeated_frames - before.repeated_frames, after.reordered_frames - before.reordered_frames)
    assert counted == (2, 1), f"expected 2 repeated frames and 1 reordered one, came {describe(after)}"


@section("Playing: Configure")
def test_data_of_another_stream_is_dropped(probe: Probe, stream: Stream) -> None:
    """The controller drops data of another stream or of an absent iteration, and packets with an unreadable number."""
    number = probe.configure(stream).stream
    probe.send_packets(next_number(number), stream.packets)
    probe.send_packets(number, stream.packets, iteration=1)
    probe.send_packets(number, stream.packets, iteration=0xFFFFFFFF)
    probe.send_packets(number, [b"", b"\xff" * 8])
    status = probe.status()
    assert status.buffered_samples == 0, f"expected nothing buffered, came {describe(status)}"


@section("Playing: Credit")
def test_data_beyond_the_credit_is_dropped(probe: Probe, stream: Stream) -> None:
    """The controller drops a packet that ends beyond the credit, and takes one that ends at it."""
    packet_samples = stream.packet_samples
    endless = replace(
        probe.configuration(stream, packets=_ENDLESS_PACKETS), header=replace(stream.header, samples=None).pack()
    )
    status = in_state(probe.expect(endless, Status), State.BUFFERING, "Configure")
    last = status.credit_until // packet_samples - 1
    # Short packets may leave room for more credit: it is requested again.
    for what, buffered_packets in (("beyond", 0), ("last", 1), ("beyond", 1), ("end", 1), ("first", 2)):
        beyond = probe.status().credit_until // packet_samples
        sequence = {"beyond": beyond, "last": last, "end": _ENDLESS_PACKETS, "first": 0}[what]
        # Twice the number: no refresh.
        probe.send_packets(status.stream, [pack_varint(2 * sequence) + b"\x00"])
        came, expected = probe.status().buffered_samples, buffered_packets * packet_samples
        assert came == expected, f"after packet {sequence}: expected {expected} samples buffered, came {came}"


@section("Playing: Credit")
def test_credit_grows_as_data_is_played(probe: Probe, stream: Stream) -> None:
    """The controller raises credit as the position advances, never lowers it, and reports it in notifications."""
    packet_samples = stream.packet_samples
    first = probe.configure(stream)
    probe.feed(first.stream, stream)
    probe.notified.clear()
    probe.expect(Start(), Status)
    last = finished(probe, stream)
    seen = [first, *(status for status in probe.notified if isinstance(status, Status)), last]
    credits = [status.credit_until for status in seen]
    assert credits == sorted(credits), f"expected credit that never falls, came {credits}"
    expected = first.credit_until + len(stream.packets) * packet_samples
    assert credits[-1] >= expected, f"expected credit until {expected} after all was played, came {credits[-1]}"


@section("Playing: Credit")
def test_notifications_while_armed_and_playing(probe: Probe, stream: Stream) -> None:
    """The controller sends Status when the state changes, and at least every 100 ms while armed or playing."""
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    start_us = soon_us(probe)
    probe.expect(Start(start_us), Status)
    probe.notified.clear()
    probe.listen(_SOON_US / 1e6 + 3 * probe.answer_s + stream.seconds + 0.3)
    came = [message for message in probe.notified if isinstance(message, Status)]
    states = {status.state for status in came}
    assert {State.ARMED, State.PLAYING, State.FINISHED} <= states, f"expected each state, came {states or 'none'}"
    times_us = [status.device_time_us for status in came if status.state in (State.ARMED, State.PLAYING)]
    # A port may look at the time every few milliseconds only.
    longest_us = max(np.diff(times_us), default=0)
    assert longest_us <= 200_000, f"expected a Status every 100 ms, one came after {longest_us / 1000:.0f} ms"


@section("Playing: Positions")
def test_position_keeps_pace_with_the_clock(probe: Probe, longer: Stream) -> None:
    """The controller's position is no further than its clock allows since the start, and keeps up with it."""
    number = probe.configure(longer).stream
    probe.feed(number, longer)
    start_us = soon_us(probe)
    probe.expect(Start(start_us), Status)
    probe.wait_for_state(State.PLAYING)
    behind = []
    for _ in range(20):
        status = probe.status()
        due = (status.device_time_us - start_us) * longer.header.rate_hz / 1e6
        assert status.position <= due + _SAMPLES_AHEAD, f"expected position {due:.0f}, came {describe(status)}"
        behind.append(due - status.position)
        probe.listen(0.013)
    late_s = min(behind) / longer.header.rate_hz
    assert late_s <= _LATE_S, f"expected to start {start_us} us, came a position {1000 * late_s:.0f} ms late"


@section("Playing: Positions")
def test_positions_have_64_bits(probe: Probe) -> None:
    """The controller plays on, with position and credit, where they pass 2^32."""
    stream = lasting_stream(probe, 2)
    packet_samples = stream.packet_samples
    before = (1 << 32) // packet_samples - 1
    packets = [renumbered(packet, before) for packet in stream.packets]
    status = configure_live(probe, stream, before)
    least = (before + 2) * packet_samples
    assert status.credit_until >= least, f"expected a credit until {least} or more, came {describe(status)}"
    probe.feed(status.stream, stream, packets)
    probe.expect(EndStream(status.stream, before + len(packets)), Status)
    probe.expect(Start(), Status)
    status = finished(probe, stream)
    without_loss(status)
    expected = (before + len(packets)) * packet_samples
    assert status.position == expected, f"expected position {expected}, came {describe(status)}"


@section("Playing: Positions")
def test_playing_begins_at_the_first_packet(probe: Probe, stream: Stream) -> None:
    """The controller begins position, decoding and capture at the refresh that Configure names."""
    refreshes = [number for number, packet in enumerate(stream.packets) if number and packet_sequence(packet)[1]]
    if not refreshes:
        pytest.skip("the longest stream that the buffer holds has one refresh packet")
    packet_samples = stream.packet_samples
    first = refreshes[0]
    status = probe.configure(stream, first_packet=first)
    assert status.position == first * packet_samples, (
        f"expected position {first * packet_samples}, came {describe(status)}"
    )
    probe.feed(status.stream, stream)
    probe.expect(Start(), Status)
    status = finished(probe, stream)
    without_loss(status)
    expected = len(stream.packets) * packet_samples
    assert status.position == expected, f"expected position {expected}, came {describe(status)}"
    decoded_as(probe, decoded(stream, first), f"from packet {first} on")


@section("Playing: Stream data")
@pytest.mark.parametrize("gap", [1, 2], ids=["one", "two"])
def test_lost_packets_are_concealed(probe: Probe, stream: Stream, gap: int) -> None:
    """The controller conceals and counts missing packets until the next refresh (missing in a row: {gap})."""
    missing = range(2, 2 + gap)
    if len(stream.packets) < missing.stop + 2:
        pytest.skip("the longest stream that the buffer holds has too few packets")
    number = probe.configure(stream).stream
    probe.feed(number, stream, [packet for sequence, packet in enumerate(stream.packets) if sequence not in missing])
    probe.expect(Start(), Status)
    status = finished(probe, stream)
    assert status.lost_packets == gap, f"expected {gap} lost packet(s), came {describe(status)}"
    assert status.underruns == 0, f"expected no underrun, came {describe(status)}"
    decoded_as(probe, decoded(stream, missing=missing), f"with {gap} packet(s) missing")


@section("Playing: Stream data")
def test_packet_that_cannot_be_decoded_is_concealed(probe: Probe) -> None:
    """The controller conceals and counts a packet that the codec cannot decode."""
    stream = stream_for(probe.description, codec.dct.NAME, seconds=1.0)  # it finds a packet without any content damaged
    broken = 1
    packets = list(stream.packets)
    packets[broken] = pack_varint(2 * broken)
    status = probe.configure(stream)
    probe.feed(status.stream, stream, packets)
    probe.expect(Start(), Status)
    status = finished(probe, stream)
    assert status.lost_packets == 1, f"expected 1 lost packet, came {describe(status)}"
    decoded_as(probe, decoded(stream, missing=[broken]), "with a packet that cannot be decoded")


@section("Playing: Stream data")
def test_underrun_is_counted_once_and_time_goes_on(probe: Probe, stream: Stream) -> None:
    """The controller counts and reports one underrun when nothing is buffered, and time goes on."""
    packets = len(stream.packets)
    half = packets // 2
    packet_samples = stream.packet_samples
    number = probe.configure(stream).stream
    probe.feed(number, stream, stream.packets[:half])
    probe.notified.clear()
    probe.expect(Start(), Status)
    status = finished(probe, stream)
    assert status.underruns == 1, f"expected 1 underrun, came {describe(status)}"
    assert status.lost_packets == packets - half, f"expected {packets - half} lost packets, came {describe(status)}"
    assert status.position == packets * packet_samples, f"expected to end at its end, came {describe(status)}"
    told_in = [state.state for state in probe.notified if isinstance(state, Status) and state.underruns]
    assert State.PLAYING in told_in, "expected a notification of the underrun while it played, came none"
    decoded_as(probe, decoded(stream, missing=range(half, packets)), "with an underrun")


@long
@section("Playing: Stream data")
def test_late_data_is_dropped(probe: Probe, stream: Stream) -> None:
    """The controller drops packets whose time has begun."""
    packets = len(stream.packets)
    number = probe.configure(stream).stream
    probe.expect(Start(), Status)
    gone = min(4, packets - 2) * stream.packet_samples
    probe.wait_for(lambda status: status.position > gone, "to play without data", _MAX_WAIT_S + ANSWER_S)
    before = probe.status().buffered_samples
    probe.send_packets(number, stream.packets[: min(4, packets - 2)])
    buffered = probe.status().buffered_samples
    assert buffered <= before + gone / 2, f"expected late packets to be dropped, came {buffered} samples buffered"
    status = finished(probe, stream)
    assert status.lost_packets == packets, f"expected {packets} lost packets, came {describe(status)}"
    decoded_as(probe, decoded(stream, missing=range(packets)), "without data in time")


@section("Playing: Pause, Resume, Loop and Gain")
def test_pause_holds_the_position(probe: Probe, longer: Stream) -> None:
    """The controller holds the position with the output at rest at Pause, and loses nothing at Resume."""
    play_on(probe, longer, probe.configure(longer))
    paused = in_state(probe.expect(Pause(), Status), State.PAUSED, "Pause")
    probe.listen(0.1)
    held = in_state(probe.status(), State.PAUSED, "Pause")
    at_rest = dac_samples(probe, longer.header.channels)
    probe.listen(0.1)
    still = in_state(probe.status(), State.PAUSED, "Pause")
    assert paused.position == held.position == still.position, f"expected a held position, came {describe(still)}"
    assert dac_samples(probe, longer.header.channels) == at_rest, "expected an output at rest, came further DAC codes"
    in_state(probe.expect(Resume(), Status), State.PLAYING, "Resume")
    without_loss(finished(probe, longer))
    decoded_as(probe, decoded(longer), "with a pause")


@section("Playing: Pause, Resume, Loop and Gain")
def test_gain_may_change_while_playing(probe: Probe, longer: Stream) -> None:
    """The controller decodes the same samples when the gain changes, and ends at rest."""
    play_on(probe, longer, probe.configure(longer))
    for gain in (0.0, 2.0, 0.5):
        probe.expect(Gain(gain), Status)
    without_loss(finished(probe, longer))
    decoded_as(probe, decoded(longer), "with another gain")
    ends_at_rest(probe, longer)


@section("Playing: Pause, Resume, Loop and Gain")
def test_loop_sets_the_iterations(probe: Probe) -> None:
    """The controller plays the number of iterations that Loop sets, also of an endless stream."""
    stream = lasting_stream(probe, 2)
    number = probe.configure(stream, loops=0).stream
    probe.expect(Loop(2), Status)
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.feed(number, stream, iteration=1)
    without_loss(finished(probe, stream, iterations=2))
    decoded_as(probe, np.tile(decoded(stream), (2, 1)), "two iterations")


@section("Playing: Pause, Resume, Loop and Gain")
def test_loop_ends_an_endless_stream(probe: Probe, longer: Stream) -> None:
    """The controller ends after the present iteration when Loop sets a number already reached."""
    play_on(probe, longer, probe.configure(longer, loops=0))
    probe.expect(Loop(1), Status)
    without_loss(finished(probe, longer))
    decoded_as(probe, decoded(longer), "one iteration")


@section("Playing: Pause, Resume, Loop and Gain")
def test_loop_may_take_the_end_away(probe: Probe, longer: Stream) -> None:
    """The controller goes on with a further iteration when Loop(0) comes in the last one, until another Loop."""
    number = play_on(probe, longer, probe.configure(longer))
    probe.expect(Loop(0), Status)
    probe.feed(number, longer, iteration=1)
    iteration = len(longer.packets) * longer.packet_samples
    probe.wait_for(lambda status: status.position > iteration, "a further iteration", ANSWER_S + 2 * longer.seconds)
    probe.expect(Loop(1), Status)
    without_loss(finished(probe, longer, iterations=2))
    decoded_as(probe, np.tile(decoded(longer), (2, 1)), "two iterations")


@section("Playing: EndStream")
def test_live_stream_ends_where_end_stream_says(probe: Probe) -> None:
    """The controller ends a live stream at the number of packets in the last EndStream."""
    stream = lasting_stream(probe, 2)
    number = configure_live(probe, stream).stream
    probe.feed(number, stream)
    probe.expect(EndStream(number, len(stream.packets) + 100), Status)
    probe.expect(Start(), Status)
    probe.expect(EndStream(number, len(stream.packets)), Status)
    without_loss(finished(probe, stream))
    decoded_as(probe, decoded(stream), "a live stream")


@section("Playing: EndStream")
def test_end_stream_that_comes_late(probe: Probe, longer: Stream) -> None:
    """The controller ends a live stream with the decoded packets when EndStream names fewer."""
    number = play_on(probe, longer, configure_live(probe, longer))
    probe.expect(EndStream(number, 0), Status)
    status = probe.wait_for_state(State.FINISHED)
    samples = status.position
    decoded_as(probe, decoded(longer)[:samples], "a live stream cut short")


@section("Playing: EndStream")
def test_end_stream_is_for_the_live_stream_under_way(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to an EndStream for a stream that is not live, and for another number."""
    number = probe.configure(stream).stream
    probe.expect_rejection(EndStream(number, 1), ErrorCode.BAD_VALUE)
    number = configure_live(probe, stream).stream
    probe.expect_rejection(EndStream(next_number(number), 1), ErrorCode.BAD_VALUE)


@section("Playing: Stop")
def test_stop_ramps_down_at_once(probe: Probe, longer: Stream) -> None:
    """The controller brings the output to rest at Stop, drops the stream and keeps the capture."""
    number = probe.configure(longer).stream
    probe.feed(number, longer)
    probe.expect(Start(), Status)
    probe.wait_for(lambda status: status.position > 2 * longer.packet_samples, "to play", ANSWER_S)
    status = probe.stop()
    assert status.buffered_samples == 0, f"expected nothing buffered, came {describe(status)}"
    ends_at_rest(probe, longer)
    captured = dac_samples(probe, longer.header.channels)
    probe.listen(0.1)
    assert dac_samples(probe, longer.header.channels) == captured, "expected an output at rest, came further DAC codes"
    assert probe.stop().position == status.position, "expected the position to stay"


@section("Playing: Start")
def test_output_never_jumps(probe: Probe) -> None:
    """The controller fades in at Start and Resume, and out at Pause and Stop, over more than one DAC code."""
    need_capture(probe.description)
    stream = lasting_stream(probe, _REQUESTS, 1.0, "full scale", constant)
    play_on(probe, stream, probe.configure(stream, compensation=False))
    in_state(probe.expect(Pause(), Status), State.PAUSED, "Pause")
    probe.listen(0.05)
    in_state(probe.expect(Resume(), Status), State.PLAYING, "Resume")
    probe.listen(0.05)
    probe.stop()
    probe.listen(0.05)
    _, codes = probe.captured(Tap.DAC, 1)
    level = np.abs(codes.astype(int)).max(initial=0)
    if level < _MIN_LEVEL:
        pytest.skip("a constant drive gives no DAC codes that could jump")
    max_step = np.abs(np.diff(codes[:, 0].astype(int))).max()
    assert max_step <= level / 2, f"expected a ramp to and from DAC code {level}, came a step of {max_step}"


def ends_at_rest(probe: Probe, stream: Stream) -> None:
    """Check that the last DAC code of each channel is 0."""
    need_capture(probe.description)
    end = dac_samples(probe, stream.header.channels)
    answer = probe.read_capture(Tap.DAC, max(0, end - 1), 1, stream.header.channels)
    last = np.frombuffer(answer.data, "<i2")
    assert len(last) == stream.header.channels, f"expected the last DAC codes, came {describe(answer)}"
    assert not last.any(), f"expected an output at rest, the last DAC codes are {last.tolist()}"
