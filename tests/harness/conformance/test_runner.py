"""The suite runner: faulty controllers fail it, nothing of the protocol is left out, and the report says it all."""

import ast
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from vibrocast.device_protocol import messages
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    NOTIFICATION,
    CaptureData,
    Error,
    ErrorCode,
    FlashStatus,
    HelloResponse,
    Message,
    SlotState,
    Status,
    Tap,
    pack,
    unpack,
)
from vibrocast.device_protocol.transports import Transport
from vibrocast.firmware.keys import public_key
from vibrocast.harness import conformance
from vibrocast.harness.conformance import NotTestable, Outcome, Report, TappedLink, page, run_suite
from vibrocast.harness.conformance.fixtures import SECTIONS
from vibrocast.harness.conformance.runner import requirements
from vibrocast.host import devices
from vibrocast.host.cli.command_line import main
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.memory_link import MemoryLink, SimulatedTime

MODULES = sorted(Path(conformance.__file__).parent.glob("test_*.py"))
PROTOCOL = page.PAGE.with_name("protocol.md")
# Needs broken hardware.
NOT_PROVOKED = {ErrorCode.FLASH_FAILED}
NOT_PASSED = set(Outcome) - {Outcome.PASSED}
# Needs someone to restart the controller.
NEEDS_A_RESTART = "test_image_that_is_not_confirmed_is_reverted_by_a_restart"
NEED_MORE = {NEEDS_A_RESTART, "test_port_puts_out_what_is_captured", "test_sensor_feels_the_dac_codes"}
"""Tests that need a restart of the controller, or a recorder of its output."""


def link_to(controller: Device) -> TappedLink:
    link = MemoryLink(controller)
    return TappedLink(link, link.clock, link.sleep)


def ended(report: Report, *outcomes: Outcome) -> dict[str, str]:
    """Return the tests that ended so, with their reasons."""
    return {each.requirement.test: each.reason for each in report.findings if each.outcome in outcomes}


@pytest.mark.slow
def test_reference_conforms_and_nothing_of_the_protocol_is_left_out() -> None:
    link = link_to(Controller())
    report = run_suite(link)
    assert report.hello.build
    assert ended(report, *NOT_PASSED).keys() <= NEED_MORE
    assert link.messages == {message.__name__ for message in messages.ALL}
    assert link.error_codes == set(ErrorCode) - NOT_PROVOKED


@pytest.mark.slow
def test_controller_with_a_key_conforms_and_only_tests_that_need_its_signature_are_skipped() -> None:
    report = run_suite(link_to(Controller(Settings(public_key=public_key(bytes(32))))), quick=True)
    skipped = ended(report, Outcome.NOT_APPLICABLE)
    assert ended(report, *NOT_PASSED) == skipped
    assert {"test_image_is_tested_and_kept", "test_cut_session_is_resumed"} <= skipped.keys()
    assert "test_signature_is_checked_where_hello_names_a_key" not in skipped


class Altered(Controller):
    """Alters the messages that it sends."""

    def alter(self, message: Message) -> Message:
        return message

    def alter_payload(self, payload: bytes) -> bytes:
        sequence, message = unpack(payload)
        return pack(self.alter(message), sequence)

    def transmit(self) -> bytes:
        return b"".join(write_frame(self.alter_payload(payload)) for payload in FrameReader().feed(super().transmit()))


class Faulty(Altered):
    """Counts no bad frames, rejects copies, gives no host up, flashes while playing, decodes a sample wrong.

    Its clock runs backwards, and its output jumps to rest and goes beyond the codes of its DAC.
    """

    def __init__(self) -> None:
        super().__init__(Settings(actuator=replace(PIEZO_STACK, name="another", dac_bits=12), watchdog_ms=60_000))
        self._last_payload = b""

    def alter(self, message: Message) -> Message:
        match message:
            case HelloResponse():
                return replace(message, limits=replace(message.limits, watchdog_ms=Settings().watchdog_ms))
            case Status():
                return replace(message, bad_frames=0, device_time_us=10**12 - message.device_time_us)
            case Error(text="a stream is being played: stop it first"):
                return FlashStatus(0, SlotState.WRITING, 0)
            case CaptureData(tap=Tap.DECODED) if message.offset <= 100 < message.offset + len(message.data) // 2:
                wrong = bytearray(message.data)
                wrong[2 * (100 - message.offset)] ^= 1
                return replace(message, data=bytes(wrong))
            case CaptureData(tap=Tap.DAC):
                codes = np.frombuffer(message.data, "<i2")
                return replace(message, data=np.where(np.abs(codes) < 200, 0, 2 * codes).astype("<i2").tobytes())
        return message

    def alter_payload(self, payload: bytes) -> bytes:
        before, self._last_payload = self._last_payload, payload
        sequence, message = unpack(payload)
        copied = payload == before and sequence != NOTIFICATION
        return pack(Error(ErrorCode.WRONG_STATE, "once more") if copied else self.alter(message), sequence)


@pytest.mark.slow
def test_faults_are_found_and_reported() -> None:
    failed = ended(run_suite(link_to(Faulty())), Outcome.FAILED)
    expected = {
        "test_frame_with_a_wrong_crc_is_dropped": "expected 16 more bad frame(s), came 0",
        "test_copy_of_a_request_is_answered_alike_and_not_carried_out_again": "a copy of Start: expected 81",
        "test_silence_is_noticed[ARMED]": "expected the state WATCHDOG, came Status",
        "test_flashing_needs_an_idle_output[PLAYING]": "FlashBegin: expected Error WRONG_STATE, came FlashStatus",
        "test_codec_is_decoded_as_offline[mdct-one channel]": "the first in channel 0 at sample 100: expected",
        "test_clocks": "a clock that never goes back",
        "test_start_waits_for_the_device_time": "expected the device time",
        "test_output_never_jumps": "expected a ramp to and from",
        "test_dac_codes_stay_within_the_dac": "expected codes from -2048 to 2047, came -",
    }
    for test, reason in expected.items():
        assert reason in failed[test]
    assert "test_frame_is_found_after_noise" not in failed
    assert not any("please report" in reason for reason in failed.values())


@pytest.mark.slow
def test_a_busy_machine_is_not_the_fault_of_the_controller() -> None:
    link = MemoryLink(Faulty())
    slow = TappedLink(link, link.clock, lambda seconds: link.sleep(seconds + 0.1))
    report = run_suite(slow, quick=True)
    busy = ended(report, Outcome.UNDECIDED)
    assert busy, "some tests wait"
    assert all("100 ms late" in reason for reason in busy.values())
    only_busy = replace(report, findings=tuple(each for each in report.findings if each.requirement.test in busy))
    assert only_busy.undecided
    assert not only_busy.conforming
    assert "undecided, because this machine was busy" in only_busy.summary


class OtherClock(Controller):
    """Its clock runs slow, or stands still for 0.1 s in every second, as that of an emulator on a busy machine."""

    def __init__(self, counted: Callable[[int], int]) -> None:
        super().__init__()
        self._counted = counted

    def advance(self, now_us: int) -> None:
        super().advance(self._counted(now_us))

    def receive(self, data: bytes, now_us: int) -> None:
        super().receive(data, self._counted(now_us))


@pytest.mark.slow
def test_a_clock_that_stands_still_now_and_then_is_undecided_and_a_slow_one_fails() -> None:
    stalling = run_suite(
        link_to(OtherClock(lambda now_us: now_us // 1_000_000 * 900_000 + min(now_us % 1_000_000, 900_000)))
    )
    slow = run_suite(link_to(OtherClock(lambda now_us: now_us * 95 // 100)))
    assert "test_the_clock_keeps_time" in ended(stalling, Outcome.UNDECIDED)
    assert not ended(stalling, Outcome.FAILED)
    assert "test_the_clock_keeps_time" in ended(slow, Outcome.FAILED)


class Slow(Controller):
    """Takes 300 ms for each answer, where the protocol allows 2 s; what it says unasked comes at once."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: list[tuple[int, bytes]] = []  # until when, and the payload

    def transmit(self) -> bytes:
        for payload in FrameReader().feed(super().transmit()):
            delay_us = 0 if unpack(payload)[0] == NOTIFICATION else 300_000
            self._waiting.append((self._time_us + delay_us, payload))
        due = [payload for until_us, payload in self._waiting if until_us <= self._time_us]
        self._waiting = [(until_us, payload) for until_us, payload in self._waiting if until_us > self._time_us]
        return b"".join(map(write_frame, due))


@pytest.mark.slow
def test_controller_that_takes_its_time_to_answer_conforms() -> None:
    link = MemoryLink(Slow(), time=SimulatedTime(step_us=10_000))
    report = run_suite(TappedLink(link, link.clock, link.sleep), quick=True)
    # Positions wait for its answers.
    assert ended(report, *NOT_PASSED).keys() <= NEED_MORE | {"test_moving_hand_is_followed_in_time"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "actuator", "test"),
    [
        ({"max_payload_bytes": 0}, {}, "test_limits_can_be_kept_to"),
        ({"max_packet_bytes": 1}, {}, "test_stream_can_be_played"),
        ({}, {"stroke_um": float("nan")}, "test_actuator_is_described"),
    ],
)
def test_nothing_else_is_tested_where_hello_makes_no_sense(
    limits: dict[str, int], actuator: dict[str, float], test: str, tmp_path: Path
) -> None:
    class Absurd(Altered):
        def alter(self, message: Message) -> Message:
            if not isinstance(message, HelloResponse):
                return message
            described = replace(message.actuator, **actuator)  # type: ignore[arg-type]
            return replace(message, limits=replace(message.limits, **limits), actuator=described)

    report = run_suite(link_to(Absurd()))
    ((failed, reason),) = ended(report, Outcome.FAILED).items()
    assert failed == test
    assert "please report" not in reason
    assert len(ended(report, Outcome.NOT_TESTED)) > 200
    report.write(tmp_path)
    assert "NaN" not in (tmp_path / "conformance.json").read_text()


class DctOnly(Altered):
    """Has one codec, which needs no model."""

    def alter(self, message: Message) -> Message:
        if not isinstance(message, HelloResponse):
            return message
        return replace(message, codecs=tuple(named for named in message.codecs if named[1] == "dct"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        lambda: Controller(Settings(channels=1, buffer_samples=600, capture_samples=0, watchdog_ms=50)),
        lambda: Controller(Settings(buffer_samples=1024, capture_samples=700)),
        lambda: Controller(Settings(actuator=replace(PIEZO_STACK, name="another"))),
        DctOnly,
    ],
    ids=["tiny", "short-capture", "another-actuator", "another-codec"],
)
def test_missing_parts_of_a_controller_are_no_failures(make: Callable[[], Controller]) -> None:
    report = run_suite(link_to(make()))
    assert all(ended(report, Outcome.NOT_APPLICABLE).values())
    assert ended(report, *NOT_PASSED) == ended(report, Outcome.NOT_APPLICABLE)
    assert len(ended(report, Outcome.PASSED)) > 180


class Hostile(Faulty):
    """Has texts that would do something on a terminal or a page."""

    def alter(self, message: Message) -> Message:
        hostile = "\x1b[2J\u202e\n# <b>![x](http://y)|`"
        altered = super().alter(message)
        return replace(altered, build=hostile, hardware=hostile) if isinstance(altered, HelloResponse) else altered


@pytest.mark.slow
def test_command_names_each_failure_and_texts_of_a_controller_do_nothing(reached: list[Device], tmp_path: Path) -> None:
    reached.append(Hostile())
    ran = CliRunner().invoke(main, ["conformance", "--out", str(tmp_path), "--quick", "--no-flash"], color=True)
    assert ran.exit_code == 1
    assert "FAIL  The controller drops and counts a frame with one wrong bit" in ran.output
    assert "not conforming" in ran.output
    page = (tmp_path / "conformance.md").read_text()
    for text in (ran.output, page):
        assert "\x1b" not in text
        assert "\u202e" not in text
    assert page.splitlines()[0].startswith("# \\\\x1b\\[2J")
    assert "<b>" not in page
    assert "![x]" not in page


class Mute(Altered):
    """Says hello in letters that are none."""

    def alter_payload(self, payload: bytes) -> bytes:
        return payload.replace(b"simulated", b"simul\xff\xfed")


def test_hello_that_cannot_be_read_is_reported() -> None:
    with pytest.raises(NotTestable, match="what comes after Hello cannot be read"):
        run_suite(link_to(Mute()))


class Dying(Controller):
    """Falls silent for good at the first request of an unknown type."""

    dead = False

    def receive(self, data: bytes, now_us: int) -> None:
        if write_frame(b"\x0d")[1:2] == data[1:2] and len(data) > 4:
            self.dead = True
        if not self.dead:
            super().receive(data, now_us)


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """Has the command reach, in simulated time, the controller that the test puts here."""
    controllers: list[Device] = []
    links: list[MemoryLink] = []

    @contextmanager
    def reach(address: str, actuator: object = None) -> Iterator[Transport]:
        links.append(MemoryLink(controllers[0]))
        yield links[0]

    def tapped(transport: MemoryLink, may_flash: bool, recorder: None) -> TappedLink:
        return TappedLink(transport, transport.clock, transport.sleep, may_flash=may_flash)

    monkeypatch.setattr(devices, "reach", reach)
    monkeypatch.setattr(conformance, "TappedLink", tapped)
    return controllers


def test_command_writes_a_report_of_its_run(reached: list[Device], tmp_path: Path) -> None:
    reached.append(Controller(Settings(hardware="board <b>|</b>")))
    ran = CliRunner().invoke(main, ["conformance", "--out", str(tmp_path / "out"), "--quick", "--no-flash"])
    assert ran.exit_code == 0, ran.output
    report = json.loads((tmp_path / "out" / "conformance.json").read_text())
    assert report["conforming"] is True
    assert report["left_out"] == ["tests longer than a second", "tests that write model images"]
    assert report["controller"]["limits"]["channels"] == Settings().channels
    assert report["schema"] == 1
    assert {"run_id", "date", "versions"} <= set(report["run"])
    outcomes = {entry["test"]: entry["outcome"] for entry in report["requirements"]}
    assert outcomes["test_image_is_tested_and_kept"] == "not applicable"
    text = (tmp_path / "out" / "conformance.md").read_text()
    assert "board &lt;b&gt;\\|&lt;/b&gt; |" in text
    assert "conforming" in ran.output.splitlines()[-2]
    assert f", on {report['run']['date'][:10]}." in text
    assert all(entry["text"] in text for entry in report["requirements"])


def test_the_report_outlives_a_controller_that_dies(reached: list[Device], tmp_path: Path) -> None:
    reached.append(Dying())
    ran = CliRunner().invoke(main, ["conformance", "--out", str(tmp_path), "--quick"])
    assert ran.exit_code == 3, ran.output
    assert "the controller was lost after test_unknown_requests_are_answered_so" in ran.output
    report = json.loads((tmp_path / "conformance.json").read_text())
    assert report["lost_after"] == "test_unknown_requests_are_answered_so"
    outcomes = {entry["test"]: entry["outcome"] for entry in report["requirements"]}
    assert [test for test, outcome in outcomes.items() if outcome == "fail"] == [report["lost_after"]]
    assert outcomes["test_frame_is_found_after_noise"] == "pass"
    assert outcomes["test_gain_of_zero_keeps_the_output_at_rest"] == "not tested"


def test_command_reports_a_missing_device(tmp_path: Path) -> None:
    ran = CliRunner().invoke(main, ["conformance", "--device", f"serial:{tmp_path / 'port'}"])
    assert ran.exit_code == 3
    (line,) = ran.output.splitlines()
    assert line.startswith("error: cannot open serial port")


def test_every_requirement_says_what_it_asks_and_where_that_stands() -> None:
    protocol = PROTOCOL.read_text()
    positions = []
    for section in SECTIONS:
        heading, _, below = section.partition(": ")
        start = protocol.index(f"\n## {heading}\n")
        found = re.search(rf"\n### {below}\n", protocol[start:]) if below else re.match("", "")
        assert found, f"{section} is not in the protocol's page"
        positions.append(start + found.start())
    assert positions == sorted(positions)
    assert {requirement.section for requirement in requirements()} == set(SECTIONS)
    texts = [requirement.text for requirement in requirements()]
    assert len(set(texts)) == len(texts)


def test_the_suite_leaves_no_module_out_hides_no_test_and_says_what_each_assertion_expects() -> None:
    names, imported = set(), Path(__file__).with_name("test_suite.py").read_text()
    for module in MODULES:
        assert f"vibrocast.harness.conformance.{module.stem} " in imported
        for node in ast.walk(ast.parse(module.read_text())):
            assert not isinstance(node, ast.Assert) or node.msg, f"{module.name}:{node.lineno}"
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                assert node.name not in names
                names.add(node.name)


def test_list_of_requirements_is_up_to_date() -> None:
    written = page.PAGE.read_text()
    assert written == page.with_requirements(written), "run `python -m vibrocast.harness.conformance.page`"
