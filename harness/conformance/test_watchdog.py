"""Watchdog: the controller notices a silent host; any undamaged frame is a sign of life."""

import random

import pytest

from vibrocast.device_protocol.frames import DELIMITER, write_frame
from vibrocast.device_protocol.messages import ErrorCode, Pause, Resume, Start, State, Status, StreamData, pack
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import Probe, describe, in_state
from vibrocast.harness.conformance.streams import lasting_stream, stream_for

_AN_HOUR_US = 3_600_000_000


def armed(probe: Probe) -> Status:
    """Set up a stream that waits to be started."""
    probe.configure(stream_for(probe.description))
    return probe.expect(Start(probe.status().device_time_us + _AN_HOUR_US), Status)


@long
@section("Session: Watchdog")
@pytest.mark.parametrize("state", [State.ARMED, State.PAUSED], ids=lambda state: state.name)
def test_silence_is_noticed(probe: Probe, state: State) -> None:
    """In {state}, the controller enters WATCHDOG and drops the stream when the host is silent beyond watchdog_ms."""
    if state == State.ARMED:
        armed(probe)
    else:
        stream = lasting_stream(probe, 3)
        probe.feed(probe.configure(stream).stream, stream)
        probe.expect(Start(), Status)
        probe.wait_for(lambda status: status.position > 0, "to play", 2.0)
        probe.expect(Pause(), Status)
    probe.notified.clear()
    watchdog_s = probe.description.limits.watchdog_ms / 1000
    probe.link.sleep(1.1 * watchdog_s)
    status = in_state(probe.status(), State.WATCHDOG, f"after {1.1 * watchdog_s:g} s of silence")
    assert status.buffered_samples == 0, f"expected nothing buffered, came {describe(status)}"
    states = [message.state for message in probe.notified if isinstance(message, Status)]
    assert State.WATCHDOG in states, f"expected a notification of it, came {states or 'none'}"
    for request in (Start(), Resume()):
        probe.expect_rejection(request, ErrorCode.WRONG_STATE)


@long
@section("Session: Watchdog")
@pytest.mark.parametrize("kind", ["stream data", "unreadable stream data"], ids=["data", "malformed"])
def test_any_frame_is_a_sign_of_life(probe: Probe, kind: str) -> None:
    """The controller takes {kind} as a sign of life."""
    payload = pack(StreamData(0, 0, ())) if kind == "stream data" else bytes([StreamData.TYPE])
    watchdog_s = probe.description.limits.watchdog_ms / 1000
    armed(probe)
    for _ in range(6):
        probe.link.sleep(watchdog_s / 4)
        probe.send(payload)
    in_state(probe.status(), State.ARMED, f"after {1.5 * watchdog_s:g} s with nothing but {kind}")


@long
@section("Session: Watchdog")
def test_noise_is_no_sign_of_life(probe: Probe) -> None:
    """The controller takes neither noise nor a damaged frame as a sign of life."""
    watchdog_s = probe.description.limits.watchdog_ms / 1000
    noise = random.Random(2)
    damaged = bytearray(write_frame(pack(StreamData(0, 0, ()))))
    damaged[-2] ^= 0x10  # in the CRC
    armed(probe)
    for _ in range(6):
        probe.link.sleep(watchdog_s / 4)
        probe.link.write(bytes(damaged) + noise.randbytes(100) + DELIMITER)
    in_state(probe.status(), State.WATCHDOG, f"after {1.5 * watchdog_s:g} s with nothing but noise")


@long
@section("Session: Watchdog")
def test_silence_does_not_matter_before_start(probe: Probe) -> None:
    """In BUFFERING, the controller allows the host any silence."""
    probe.configure(stream_for(probe.description))
    probe.link.sleep(1.5 * probe.description.limits.watchdog_ms / 1000)
    in_state(probe.status(), State.BUFFERING, "after silence of the host")
