"""The client session: retries, answers, versions, and peers that send garbage, duplicates or nothing."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import linked, session
from tests.host.scripted_controller import ScriptedController
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import (
    CaptureData,
    Error,
    ErrorCode,
    FrameFaults,
    Gain,
    Hello,
    HelloResponse,
    Limits,
    Loop,
    Message,
    State,
    Status,
    StatusRequest,
    Stop,
    Tap,
    pack,
)
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError, StatusCounts
from vibrocast.host.stream_session import Capture

IDLE_STATUS = Status(State.IDLE, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def test_hello_under_a_number_of_the_last_session_is_said_again_under_another(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = [41, 41, 41, 500]
    monkeypatch.setattr("vibrocast.host.controller.random.randrange", lambda end: draws.pop(0))
    link, earlier = linked()
    earlier.request_status()
    again = session(link)
    assert draws == []
    assert again.request_status().state == State.IDLE


@pytest.mark.parametrize("old", [IDLE_STATUS, Error(ErrorCode.WRONG_STATE, "of long ago")])
def test_hello_that_gets_the_answer_of_an_earlier_session_is_said_again(
    old: Message, monkeypatch: pytest.MonkeyPatch
) -> None:
    draws = [41, 500]
    monkeypatch.setattr("vibrocast.host.controller.random.randrange", lambda end: draws.pop(0))
    scripted = ScriptedController()
    scripted.last = (42, write_frame(pack(old, 42)))
    assert scripted.connect().description == scripted.description
    assert scripted.handled == [Hello()]


def test_nobody_at_the_other_end_is_known_after_the_time_that_a_board_takes_to_start() -> None:
    scripted = ScriptedController()
    attempts: list[Message] = []

    def swallow(message: Message) -> bool:
        attempts.append(message)
        return True

    scripted.swallow = swallow
    with pytest.raises(ConnectionLost, match="does not answer within 5 s"):
        scripted.connect()
    assert len(attempts) == 50
    assert 5.0 <= scripted.now_s < 6.5


def test_a_controller_that_answers_no_more_hangs_or_is_behind_a_slow_wire() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    controller.request_status()
    scripted.swallow = lambda message: True
    with pytest.raises(ConnectionLost, match=r"answers no more; check its power, its cable, and .* bit rate"):
        controller.request_status()


@pytest.mark.parametrize("starts_s", [0.0, 0.45, 2.5, 4.5])
def test_a_board_that_resets_when_its_port_is_opened_is_waited_for(
    starts_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    scripted = ScriptedController()
    scripted.swallow = lambda message: scripted.now_s < starts_s
    controller = scripted.connect()
    assert starts_s <= scripted.now_s < starts_s + 0.2
    assert ("a board may reset when its port is opened" in caplog.text) == (starts_s > 0.5)
    scripted.swallow = lambda message: scripted.now_s < 2 * starts_s + 0.2  # it resets again
    controller.reconnect(1.0)


def test_lost_answers_are_requested_again_and_requests_carried_out_once() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    lost: list[bytes] = []

    def lose_one_answer() -> None:
        if scripted.outgoing and not lost:
            lost.append(scripted.outgoing)
            scripted.outgoing = b""

    scripted.at_read = lose_one_answer
    controller.request(Gain(0.5), Status)
    assert lost
    assert scripted.handled.count(Gain(0.5)) == 1


def test_rejection_carries_code_and_text() -> None:
    controller = ScriptedController().connect()
    with pytest.raises(ControllerError, match=r"what is that\?; update the older of vibrocast") as caught:
        controller.request(Loop(3), Status)
    assert caught.value.code == ErrorCode.UNKNOWN_MESSAGE


def test_restarted_controller_is_noticed_and_can_be_reconnected() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.restart()
    with pytest.raises(ConnectionLost, match="restarted"):
        controller.request_status()
    controller.reconnect(1.0)
    assert controller.request_status().state == State.IDLE
    assert controller.device_restarts == 1


def test_a_machine_that_ran_other_programs_meanwhile_is_in_doubt_unless_time_is_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    queued_s = 1.0
    monkeypatch.setattr("vibrocast.host.controller._queued_s", lambda: queued_s)
    real, simulated = Controller(ScriptedController()), ScriptedController().connect()
    assert not real.doubt()
    queued_s = 9.0
    assert real.doubt().startswith("other programs kept this one from a processor for 8.0 of ")
    assert not simulated.doubt()


def test_reconnect_waits_until_the_cable_is_back_and_gives_up_in_time() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.unplugged = True
    with pytest.raises(TransportError, match=r"lost after 0\.0 s: .*"):
        controller.reconnect(1.0)
    assert 1.0 <= scripted.now_s < 1.5

    def replug() -> None:
        scripted.unplugged = scripted.now_s < 3.0

    scripted.at_read = replug
    controller.reconnect(10.0)
    assert 3.0 <= scripted.now_s < 3.5


def test_a_lost_connection_is_told_with_its_time_and_its_return(caplog: pytest.LogCaptureFixture) -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.now_s += 3.1
    controller.reconnect(1.0)
    assert [record.getMessage() for record in caplog.records if record.name == "vibrocast.notes"] == [
        "the connection was lost after 3.1 s; trying to open it again for 1 s",
        "the connection is back",
    ]


def test_another_board_in_the_place_of_the_lost_one_is_rejected() -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, serial_number="17")
    controller = scripted.connect()
    scripted.description = replace(scripted.description, serial_number="18")
    with pytest.raises(ControllerError, match=r"another controller is there now \(none 18\); connect none 17 again"):
        controller.reconnect(1.0)


def test_another_major_version_is_rejected_naming_both() -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, major=7)
    with pytest.raises(ControllerError, match=r"protocol 7\.\d, this host 2\.\d"):
        scripted.connect()


@pytest.mark.parametrize("limits", [Limits(255, 64, 200, 0, 1, 1, 2, 400), Limits(512, 64, 200, 0, 1, 1, 2, 0)])
def test_limits_that_no_host_can_keep_to_are_rejected(limits: Limits) -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, limits=limits)
    with pytest.raises(ControllerError, match="update its firmware"):
        scripted.connect()


def test_answer_of_the_wrong_type_is_an_error() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.answer = lambda message: scripted.description
    with pytest.raises(ControllerError, match="StatusRequest with HelloResponse"):
        controller.request_status()


def test_notifications_are_kept_and_complaints_raised() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.outgoing = write_frame(pack(replace(scripted.status(), position=77)))
    controller.poll(0.1)
    assert controller.status is not None
    assert controller.status.position == 77
    scripted.outgoing = write_frame(pack(Error(ErrorCode.MALFORMED, "that packet is torn")))
    with pytest.raises(ControllerError, match="torn"):
        controller.poll(0.1)
    controller.poll(0.1)


def test_status_that_is_asked_for_in_passing_comes_with_a_poll() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.position = 55
    controller.ask_status()
    controller.poll(0.1)
    assert controller.status is not None
    assert controller.status.position == 55
    scripted.restart()
    controller.ask_status()
    with pytest.raises(ConnectionLost, match="restarted"):
        controller.poll(0.1)


def test_late_answers_to_earlier_requests_are_no_answers() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    controller.request_status()
    assert scripted.last is not None
    late = write_frame(pack(replace(scripted.status(), position=999), scripted.last[0] - 1))
    scripted.outgoing = late
    assert controller.request_status().position == 0


def test_capture_that_is_gone_is_an_error() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.answer = lambda message: CaptureData(Tap.DAC, 1, 500, 1500, b"")
    with pytest.raises(ControllerError, match="keeps 1000 samples of each capture"):
        controller.run(Capture(controller, Tap.DAC, 1).read_steps())


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_garbage_on_the_link_changes_nothing(noise: list[bytes]) -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def make_noise() -> None:
        if noise:
            scripted.outgoing = noise.pop() + b"\x00" + scripted.outgoing

    scripted.at_read = make_noise
    assert controller.request(StatusRequest(), Status).state == State.IDLE


def test_endless_garbage_neither_hangs_nor_grows() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def flood() -> None:
        scripted.now_s += 0.001
        scripted.outgoing = b"\x55" * 1000

    scripted.at_read = flood
    with pytest.raises(ConnectionLost):
        controller.request(StatusRequest(), HelloResponse)
    assert len(controller._reader._pending) < 10_000


def test_stop_gets_through_after_a_torn_frame() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.write(write_frame(pack(StatusRequest(), 5))[:4])
    assert controller.stop().state == State.STOPPED
    assert scripted.handled.count(Stop()) == 1


def test_counts_of_the_controller_add_up_over_restarts_and_not_twice_where_a_status_comes_late() -> None:
    counts = StatusCounts()
    for time_us, bad_frames, repeated in (
        (900_000, 5, 0),
        (990_000, 7, 1),
        (980_000, 6, 0),
        (999_000, 8, 3),
        (100, 2, 1),
    ):
        faults = FrameFaults(repeated, 0) if repeated else None
        counts.take(replace(IDLE_STATUS, device_time_us=time_us, bad_frames=bad_frames, frame_faults=faults))
    assert (counts.grown["bad_frames"], counts.grown["repeated_frames"], counts.reordered) == (3 + 2, 3 + 1, 1)
