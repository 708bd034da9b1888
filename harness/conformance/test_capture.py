"""Capture: what CaptureRead returns of decoded samples and of DAC codes."""

import numpy as np
import pytest

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import CaptureRead, ErrorCode, HelloResponse, State, Tap
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import Probe, an_error, describe, same_samples
from vibrocast.harness.conformance.streams import decoded, need_capture, stream_for

_MOST = 0xFFFF


@pytest.fixture
def stream(hello: HelloResponse) -> Stream:
    """A stream that can be played."""
    need_capture(hello)
    return stream_for(hello)


@section("Playing: Capture")
def test_capture_is_read_from_anywhere(probe: Probe, stream: Stream) -> None:
    """The controller returns captured samples from the requested offset, no more than count or a frame allows."""
    expected = decoded(stream)
    probe.play(stream)
    end = len(expected)
    kept = min(end, probe.description.limits.capture_samples)
    for offset, count in ((end - kept, 1), (end - kept, _MOST), (end - kept + 7, 20), (end - 1, 1), (end - 5, 100)):
        answer = probe.read_capture(Tap.DECODED, offset, count, 1)
        assert (answer.offset, answer.end) == (offset, end), f"{count} from {offset} of {end}: came {describe(answer)}"
        samples = np.frombuffer(answer.data, "<i2").reshape(-1, 1)
        assert 1 <= len(samples) <= min(count, end - offset), f"{count} from {offset} of {end}: came {len(samples)}"
        same_samples(samples, expected[offset : offset + len(samples)], f"{len(samples)} samples from {offset}")


@section("Playing: Capture")
def test_capture_beyond_its_end_is_empty(probe: Probe, stream: Stream) -> None:
    """The controller returns an empty capture for a count of 0, and beyond the end, where the offset is the end."""
    probe.play(stream)
    for tap in Tap:
        end = probe.read_capture(tap, 0, 0, 1).end
        assert end > 0, f"expected a capture of tap {tap}, came none"
        for offset in (end, end + 1, 2**64 - 1):
            answer = probe.read_capture(tap, offset, _MOST, 1)
            assert (answer.offset, answer.end, answer.data) == (end, end, b""), (
                f"from {offset}: came {describe(answer)}"
            )
        assert not probe.read_capture(tap, end - 1, 0, 1).data, "expected no samples where none were asked for"


@section("Playing: Capture")
def test_configure_empties_the_capture(probe: Probe, stream: Stream) -> None:
    """The controller empties both taps at Configure."""
    probe.play(stream)
    probe.configure(stream)
    for tap in Tap:
        answer = probe.read_capture(tap, 0, _MOST, 1)
        assert (answer.offset, answer.end, answer.data) == (0, 0, b""), f"tap {tap}: came {describe(answer)}"


@section("Playing: Capture")
def test_capture_keeps_the_last_samples(probe: Probe, stream: Stream) -> None:
    """The controller keeps the last capture_samples of each tap. An earlier offset gives the oldest of them."""
    limit = probe.description.limits.capture_samples
    status = probe.play(stream)
    assert status.state == State.FINISHED, f"expected the end, came {describe(status)}"
    for tap in Tap:
        first, samples = probe.captured(tap, 1)
        end = first + len(samples)
        assert first == max(0, end - limit), f"tap {tap}: expected the last {limit} of {end}, came from {first} on"


@section("Messages: Error codes")
def test_tap_that_is_not_there(probe: Probe, stream: Stream) -> None:
    """The controller answers BAD_VALUE to a CaptureRead of an absent tap."""
    probe.configure(stream)
    for tap in (2, 0xFF):
        body = bytes([tap]) + CaptureRead(Tap.DECODED, 0, 1).body()[1:]
        an_error(probe.ask_body(CaptureRead.TYPE, body), ErrorCode.BAD_VALUE, f"CaptureRead of tap {tap}")
