"""States: the requests that each state allows, and the ways into and out of it."""

from dataclasses import replace

import pytest

from vibrocast.device_protocol.messages import (
    EndStream,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    Gain,
    Loop,
    Message,
    Pause,
    Resume,
    Start,
    State,
    Status,
)
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import Probe, describe, in_state
from vibrocast.harness.conformance.streams import stream_for

_TAKES_DATA = (State.BUFFERING, State.ARMED, State.PLAYING, State.PAUSED)
_ACTIVE = (State.ARMED, State.PLAYING, State.PAUSED)
_OVER = (State.FINISHED, State.STOPPED)
_STATES = [pytest.param(state, id=state.name) for state in (*_TAKES_DATA, *_OVER)]
_STATES.append(pytest.param(State.WATCHDOG, id=State.WATCHDOG.name, marks=long))
_ENDLESS_PACKETS = 60_000
_AN_HOUR_US = 3_600_000_000


def bring_to(probe: Probe, state: State, live: bool = False) -> Status:
    """Bring the controller into a state with a stream that does not end by itself, unless it is FINISHED."""
    stream = stream_for(probe.description)
    if state == State.FINISHED:
        return probe.play(stream)
    unknown_length = replace(stream.header, samples=None)
    packets = 0 if live else _ENDLESS_PACKETS
    configure = replace(probe.configuration(stream), header=unknown_length.pack(), packets=packets)
    number = in_state(probe.expect(configure, Status), State.BUFFERING, "Configure").stream
    if state == State.BUFFERING:
        return probe.status()
    probe.feed(number, stream)
    if state == State.ARMED:
        probe.expect(Start(probe.status().device_time_us + _AN_HOUR_US), Status)
        return in_state(probe.status(), state, "Start in an hour")
    probe.expect(Start(), Status)
    probe.wait_for_state(State.PLAYING)
    if state == State.PAUSED:
        return in_state(probe.expect(Pause(), Status), state, "Pause")
    if state == State.STOPPED:
        return probe.stop()
    if state == State.WATCHDOG:
        probe.link.sleep(1.1 * probe.description.limits.watchdog_ms / 1000)
        return in_state(probe.status(), state, "silence of the host")
    return in_state(probe.status(), state, "Start")


@section("Playing: Requests by state")
@pytest.mark.parametrize("state", _STATES)
def test_requests_in_the_wrong_state_are_rejected(probe: Probe, state: State) -> None:
    """In {state}, the controller answers WRONG_STATE to each request that the table excludes, and changes nothing."""
    before = bring_to(probe, state)
    allowed: tuple[tuple[Message, tuple[State, ...]], ...] = (
        (Start(), (State.BUFFERING,)),
        (Pause(), (State.PLAYING,)),
        (Resume(), (State.PAUSED,)),
        (Loop(1), _TAKES_DATA),
        (Gain(0.5), _TAKES_DATA),
        (EndStream(before.stream, 1), _TAKES_DATA),
    )
    for request, states in allowed:
        if state not in states:
            probe.expect_rejection(request, ErrorCode.WRONG_STATE)
    in_state(probe.status(), state, "after requests in the wrong state")


@section("Playing: Requests by state")
@pytest.mark.parametrize("state", [pytest.param(state, id=state.name) for state in _TAKES_DATA])
def test_requests_in_the_right_state_are_carried_out(probe: Probe, state: State) -> None:
    """In {state}, the controller carries out Loop, Gain and EndStream."""
    bring_to(probe, state)
    for request in (Loop(0), Loop(3), Gain(0.0), Gain(1.0)):
        in_state(probe.expect(request, Status), state, type(request).__name__)
    number = bring_to(probe, state, live=True).stream
    in_state(probe.expect(EndStream(number, _ENDLESS_PACKETS), Status), state, "EndStream")


@section("Playing: Stop")
@pytest.mark.parametrize("state", _STATES)
def test_stop_works_in_every_state(probe: Probe, state: State) -> None:
    """In {state}, the controller carries out Stop: the state is STOPPED and nothing is buffered."""
    bring_to(probe, state)
    for _ in range(2):
        status = probe.stop()
        assert status.buffered_samples == 0, f"expected nothing buffered, came {describe(status)}"


@section("Playing: Configure")
@pytest.mark.parametrize("state", _STATES)
def test_configure_works_in_every_state(probe: Probe, state: State) -> None:
    """In {state}, the controller carries out Configure and plays the new stream to its end."""
    bring_to(probe, state)
    status = probe.play(stream_for(probe.description))
    assert (status.underruns, status.lost_packets) == (0, 0), f"expected no loss, came {describe(status)}"


@section("Playing: States")
@pytest.mark.parametrize("state", [pytest.param(state, id=state.name) for state in _OVER])
def test_stream_that_is_over_keeps_its_counts(probe: Probe, state: State) -> None:
    """In {state}, the controller keeps the stream's number, position and counts, and drops stream data."""
    before = bring_to(probe, state)
    probe.send_packets(before.stream, stream_for(probe.description).packets)
    after = probe.status()
    kept = replace(after, device_time_us=before.device_time_us)
    assert kept == before, f"expected {describe(before)}, came {describe(after)}"


@section("Model upload: FlashBegin")
@pytest.mark.parametrize("state", [pytest.param(state, id=state.name) for state in _ACTIVE])
def test_flashing_needs_an_idle_output(probe: Probe, slot: int, state: State) -> None:
    """In {state}, the controller answers WRONG_STATE to FlashBegin and FlashActivate."""
    bring_to(probe, state)
    probe.expect_rejection(FlashBegin(slot, 100, bytes(32), ""), ErrorCode.WRONG_STATE)
    probe.expect_rejection(FlashActivate(slot), ErrorCode.WRONG_STATE)
    in_state(probe.status(), state, "after rejected flashing")
