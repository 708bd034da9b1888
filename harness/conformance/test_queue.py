"""Queue: a stream that follows another without a gap."""

from dataclasses import replace

import numpy as np
import pytest

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import ErrorCode, HelloResponse, Queue, Start, State, Status, Tap
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import Probe, describe
from vibrocast.harness.conformance.streams import (
    answered_s,
    decoded,
    host,
    known_actuator,
    lasting_stream,
    need_capture,
    need_since,
    stream_for,
)
from vibrocast.host import player
from vibrocast.host.stream_session import next_number, read_capture
from vibrocast.output.rendering import render

_NUMBER = 201
_REQUESTS_TO_FOLLOW = 3
"""Behind Start, until the first packet of the next stream is there."""


@pytest.fixture
def stream(probe: Probe, hello: HelloResponse) -> Stream:
    """A stream that can be played, on a controller that knows Queue."""
    need_since(hello, Queue)
    return stream_for(probe.description)


def queue_of(played: Stream, **changes: int | bytes) -> Queue:
    """Return a request that sets a stream up behind another."""
    queue = Queue(_NUMBER, played.header.pack(), prebuffer_samples=0, packets=len(played.packets))
    return replace(queue, **changes)  # type: ignore[arg-type]


@section("Playing: Queue")
def test_the_next_stream_follows_without_a_gap(probe: Probe, hello: HelloResponse) -> None:
    """A queued stream follows the one under way without a gap, as another iteration does, bit for bit."""
    need_since(hello, Queue)
    need_capture(probe.description)
    stream = lasting_stream(probe, _REQUESTS_TO_FOLLOW)
    controller, buffer_s = host(probe), answered_s(probe)
    settings = player.PlaybackSettings(buffer_s=buffer_s, next_stream=lambda: stream)
    first = player.play(controller, stream, settings)
    assert first.following is not None, f"expected to go on with the next stream, came {describe(first.status)}"
    settings = player.PlaybackSettings(buffer_s=buffer_s, begun=first.following)
    last = player.play(controller, stream, settings)
    found = last.state, last.underruns, last.lost_packets
    assert found == (State.FINISHED, 0, 0), f"expected the end without loss, came {describe(last.status)}"
    begin, codes = read_capture(controller, Tap.DAC, stream.header.channels)
    late = stream.delay_samples
    behind = [(stream.header, decoded(stream), late)]
    actuator = known_actuator(probe.description.actuator)
    expected, _ = render(stream.header, decoded(stream), late, actuator, behind=behind)
    assert begin + len(codes) == len(expected), f"expected {len(expected)} DAC samples, came {begin + len(codes)}"
    assert np.array_equal(codes, expected[begin:]), "expected the DAC codes of two streams without a gap, came others"


@section("Playing: Queue")
def test_only_a_stream_that_ends_has_one_behind_it(probe: Probe, stream: Stream) -> None:
    """The controller answers WRONG_STATE to Queue without a stream, behind one without end, and to a second Queue."""
    probe.stop()
    probe.expect_rejection(queue_of(stream), ErrorCode.WRONG_STATE)
    status = probe.configure(stream, loops=0)
    probe.expect_rejection(queue_of(stream, stream=next_number(status.stream)), ErrorCode.WRONG_STATE)
    status = probe.configure(stream)
    probe.expect(queue_of(stream, stream=next_number(status.stream)), Status)
    probe.expect_rejection(queue_of(stream, stream=next_number(status.stream)), ErrorCode.WRONG_STATE)


@section("Playing: Queue")
def test_the_next_stream_has_another_number(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to Queue with the number of the stream under way."""
    status = probe.configure(stream)
    probe.expect_rejection(queue_of(stream, stream=status.stream), ErrorCode.BAD_VALUE)


@section("Playing: Queue")
def test_another_format_waits(probe: Probe, stream: Stream) -> None:
    """The controller answers BEYOND_LIMITS to a queued stream of another full scale, and plays on."""
    status = probe.configure(stream)
    other = replace(stream.header, gains=tuple(2 * gain for gain in stream.header.gains)).pack()
    probe.expect_rejection(queue_of(stream, stream=next_number(status.stream), header=other), ErrorCode.BEYOND_LIMITS)
    probe.feed(status.stream, stream)
    probe.expect(Start(), Status)
    probe.wait_for_state(State.FINISHED, 2.0 + 2 * stream.seconds)
