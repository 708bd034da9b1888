"""Sequence numbers: a request is carried out once, however often or late its frame arrives."""

from vibrocast.device_protocol.messages import (
    MAX_SEQUENCE,
    ErrorCode,
    Hello,
    HelloResponse,
    Message,
    Pause,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    pack,
)
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import Probe, an_error, describe, in_state
from vibrocast.harness.conformance.streams import stream_for

_NUMBERS = MAX_SEQUENCE + 1
_HALF = _NUMBERS // 2


def open_as(probe: Probe, number: int) -> None:
    """Open a session with this number."""
    while probe.opened_by == number:
        probe.open()  # by another one: its copy would be ignored
    answer = probe.ask_body(Hello.TYPE, Hello().body(), number)
    assert isinstance(answer, HelloResponse), (
        f"Hello under number {number}: expected HelloResponse, came {describe(answer)}"
    )
    probe.opened_by = number


def repeat(probe: Probe, message: Message) -> None:
    """Send a copy of the last request, whose answer must be the one before, byte for byte."""
    before = probe.last_answer.hex(" ")
    probe.ask_body(message.TYPE, message.body(), probe.sequence)
    came = probe.last_answer.hex(" ")
    assert came == before, f"a copy of {type(message).__name__}: expected {before}, came {came}"


@section("Session: Sequence numbers")
def test_copy_of_a_request_is_answered_alike_and_not_carried_out_again(probe: Probe) -> None:
    """The controller answers a copy of the last request with the same bytes, and does not carry it out again."""
    probe.configure(stream_for(probe.description))
    start = Start(probe.status().device_time_us + 3_600_000_000)
    probe.expect(start, Status)  # a second Start would be rejected
    for _ in range(3):
        repeat(probe, start)
    in_state(probe.status(), State.ARMED, "after copies of Start")


@section("Session: Sequence numbers")
def test_copy_of_a_rejected_request_is_rejected_alike(probe: Probe) -> None:
    """The controller answers a copy of a rejected or unreadable request with the same Error, byte for byte."""
    probe.expect_rejection(Pause(), ErrorCode.WRONG_STATE)
    repeat(probe, Pause())
    for message_type, code in ((0x3F, ErrorCode.UNKNOWN_MESSAGE), (Start.TYPE, ErrorCode.MALFORMED)):
        an_error(probe.ask_body(message_type, b"\x01"), code, f"type 0x{message_type:02x} with one byte")
        before = probe.last_answer
        probe.ask_body(message_type, b"\x01", probe.sequence)
        assert probe.last_answer == before, f"expected {before.hex(' ')}, came {probe.last_answer.hex(' ')}"


@section("Session: Sequence numbers")
def test_late_copies_are_ignored(probe: Probe) -> None:
    """The controller ignores a request whose number is up to 32768 behind the last one."""
    probe.configure(stream_for(probe.description))
    for behind in (1, 2, 1000, _HALF - 2, _HALF):
        late = (probe.sequence - behind) % _NUMBERS
        if late:
            probe.unanswered(pack(Stop(), late), f"Stop with a number {behind} behind the last one")
    in_state(probe.status(), State.BUFFERING, "after late copies of Stop")


@section("Session: Sequence numbers")
def test_numbers_may_leave_some_out(probe: Probe) -> None:
    """The controller carries out a request whose number is up to 32767 ahead of the last one."""
    open_as(probe, 1)
    for ahead in (1, 2, 1000, _HALF - 1):
        answer = probe.ask_body(StatusRequest.TYPE, b"", (probe.sequence + ahead) % _NUMBERS)
        assert isinstance(answer, Status), (
            f"a number {ahead} ahead of the last one: expected Status, came {describe(answer)}"
        )


@section("Session: Sequence numbers")
def test_one_follows_the_highest_number(probe: Probe) -> None:
    """The controller takes 1 as the number after 65535."""
    open_as(probe, MAX_SEQUENCE - 1)
    for number in (MAX_SEQUENCE, 1, 2):
        answer = probe.ask_body(StatusRequest.TYPE, b"", number)
        assert isinstance(answer, Status), f"number {number}: expected Status, came {describe(answer)}"
    probe.unanswered(pack(Stop(), MAX_SEQUENCE), "a late copy of number 65535")


@section("Session: Sequence numbers")
def test_copy_of_the_hello_that_opened_the_session(probe: Probe) -> None:
    """The controller answers a copy of the opening Hello alike, and ignores it after another request."""
    probe.open()
    repeat(probe, Hello())
    probe.status()
    probe.unanswered(pack(Hello(), probe.opened_by), "a copy of the Hello that opened the session")


@section("Session: Sequence numbers")
def test_hello_opens_a_new_session_under_any_other_number(probe: Probe) -> None:
    """The controller opens a new session for a Hello with any other number, even that of the last request."""
    probe.status()
    last = probe.sequence
    open_as(probe, last)
    probe.status()
    # Far behind the last number: in the session before it would be a late copy.
    open_as(probe, (last - 1000) % MAX_SEQUENCE + 1)
    probe.status()


@section("Session: Sequence numbers")
def test_hello_leaves_the_stream_alone(probe: Probe) -> None:
    """The controller keeps its stream in a new session."""
    before = probe.configure(stream_for(probe.description))
    probe.open()
    after = in_state(probe.status(), State.BUFFERING, "after a new Hello")
    assert after.stream == before.stream, f"expected stream {before.stream}, came {describe(after)}"


@section("Messages")
def test_request_without_a_number_is_malformed(probe: Probe) -> None:
    """The controller answers MALFORMED, with the number 0, to a request with the number 0, and does not act on it."""
    probe.configure(stream_for(probe.description))
    probe.complaint(pack(Stop(), 0), ErrorCode.MALFORMED, "Stop with the number 0")
    in_state(probe.status(), State.BUFFERING, "after Stop with the number 0")
