"""The summary of a trace: what it counts, and the cause that it names for each fault."""

from collections.abc import Sequence
from dataclasses import dataclass

import pytest

from vibrocast.device_protocol.frames import DELIMITER, write_frame
from vibrocast.device_protocol.messages import FrameFaults, State, Status, StatusRequest, pack
from vibrocast.device_protocol.trace import TracedFrame
from vibrocast.harness.trace_summary import summarise

TURNS = 20


@dataclass(frozen=True)
class Turn:
    """A request every 20 ms. `late_ms`: of the host; `sent`, `answered`: how often; `trip_ms`: until the answer."""

    late_ms: int = 0
    sent: int = 1
    answered: int = 1
    trip_ms: int = 2
    early_us: int = 0
    is_damaged: bool = False
    underruns: int = 0
    output_gaps: int = 0
    frame_faults: FrameFaults | None = None


def traced(special: Turn) -> Sequence[TracedFrame]:
    """Return the frames of turns, of which the middle one is special, and those after it keep its counters."""
    frames, late_ms = [], 0
    for number in range(TURNS):
        turn = special if number == TURNS // 2 else Turn()
        late_ms += turn.late_ms
        after = special if number >= TURNS // 2 else Turn()
        asked_ms = 20 * number + late_ms
        status = Status(
            State.PLAYING, 1, 1000 * asked_ms + 1 - turn.early_us, 0, 0, 0, 0, after.underruns, 0, 0, 0, 0, 0,
            after.output_gaps, frame_faults=after.frame_faults,
        )  # fmt: skip
        request, answer = (write_frame(pack(each, number + 1)) for each in (StatusRequest(), status))
        if turn.is_damaged:
            answer = answer[:3] + bytes([answer[3] ^ 0x55]) + answer[4:]
        sent = [TracedFrame(10**6 * (asked_ms + each), True, "x", request) for each in range(turn.sent)]
        came_ms = asked_ms + turn.trip_ms
        came = [TracedFrame(10**6 * (came_ms + each), False, "x", answer) for each in range(turn.answered)]
        frames += [TracedFrame(at.time_ns, at.from_host, "x", at.encoded.removesuffix(DELIMITER)) for at in sent + came]
    return sorted(frames, key=lambda frame: frame.time_ns)


@pytest.mark.parametrize(
    ("turn", "cause"),
    [
        (Turn(), ""),
        (Turn(late_ms=400, underruns=1), "host"),
        (Turn(trip_ms=400, underruns=1), "wire"),
        (Turn(sent=2), "wire"),
        (Turn(answered=2), "wire"),
        (Turn(early_us=30_000), "wire"),
        (Turn(is_damaged=True), "wire"),
        (Turn(late_ms=400, underruns=1, frame_faults=FrameFaults(repeated=1, reordered=0)), "wire"),
        (Turn(late_ms=400, underruns=1, frame_faults=FrameFaults(repeated=0, reordered=1)), "wire"),
        (Turn(late_ms=400, underruns=1, output_gaps=1), "device"),
    ],
)
def test_the_likely_cause_is_named(turn: Turn, cause: str) -> None:
    assert summarise(traced(turn)).cause == cause


def test_requests_round_trips_and_silences_are_counted() -> None:
    summary = summarise(traced(Turn(late_ms=300, sent=3, trip_ms=5)))
    assert (summary.requests, summary.repeated_requests, summary.unanswered_requests) == (TURNS, 2, 0)
    assert max(summary.round_trips_s) == pytest.approx(0.005)
    assert summary.ways["to_controller"].longest_silence_s == pytest.approx(0.32)
    assert summary.host_silence_s == pytest.approx(0.32)
