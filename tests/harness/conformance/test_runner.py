"""The suite runner: faulty controllers fail it, nothing of the protocol is left out, and the report says it all."""

import ast
import errno
import json
import re
from collections.abc import Iterator
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
from vibrocast.harness.conformance import NotTestable, Outcome, TappedLink, page, run_suite
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


def link_to(controller: Device) -> TappedLink:
    link = MemoryLink(controller)
    return TappedLink(link, link.clock, link.sleep)


@pytest.mark.slow
def test_reference_conforms_and_nothing_of_the_protocol_is_left_out() -> None:
    link = link_to(Controller())
    report = run_suite(link)
    assert report.hello.build
    assert {finding.requirement.test for finding in report.findings if finding.outcome != Outcome.PASSED} == {
        "test_image_that_is_not_confirmed_is_reverted_by_a_restart"  # needs someone to restart it
    }
    assert link.messages == {message.__name__ for message in messages.ALL}
    assert link.error_codes == set(ErrorCode) - NOT_PROVOKED


@pytest.mark.slow
def test_controller_with_a_key_conforms_and_only_tests_that_need_its_signature_are_skipped() -> None:
    findings = run_suite(link_to(Controller(Settings(public_key=public_key(bytes(32))))), quick=True).findings
    skipped = {finding.requirement.test for finding in findings if finding.outcome != Outcome.PASSED}
    assert {finding.outcome for finding in findings} == {Outcome.PASSED, Outcome.NOT_APPLICABLE}
    assert {"test_image_is_tested_and_kept", "test_cut_session_is_resumed"} <= skipped
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
    """Counts no bad frames, rejects copies, gives no host up, flashes while playing, decodes a sample wrong."""

    def __init__(self) -> None:
        super().__init__(Settings(watchdog_ms=60_000))
        self._last_payload = b""

    def alter(self, message: Message) -> Message:
        match message:
            case HelloResponse():
                return replace(message, limits=replace(message.limits, watchdog_ms=Settings().watchdog_ms))
            case Status():
                return replace(message, bad_frames=0)
            case Error(text="a stream is being played: stop it first"):
                return FlashStatus(0, SlotState.WRITING, 0)
            case CaptureData(tap=Tap.DECODED) if message.offset <= 100 < message.offset + len(message.data) // 2:
                wrong = bytearray(message.data)
                wrong[2 * (100 - message.offset)] ^= 1
                return replace(message, data=bytes(wrong))
        return message

    def alter_payload(self, payload: bytes) -> bytes:
        before, self._last_payload = self._last_payload, payload
        sequence, message = unpack(payload)
        copied = payload == before and sequence != NOTIFICATION
        return pack(Error(ErrorCode.WRONG_STATE, "once more") if copied else self.alter(message), sequence)


@pytest.mark.slow
def test_faults_are_found_and_reported() -> None:
    findings = run_suite(link_to(Faulty())).findings
    failed = {finding.requirement.test: finding.reason for finding in findings if finding.outcome == Outcome.FAILED}
    expected = {
        "test_frame_with_a_wrong_crc_is_dropped": "expected 16 more bad frame(s), came 0",
        "test_copy_of_a_request_is_answered_alike_and_not_carried_out_again": "a copy of Start: expected 81",
        "test_silence_is_noticed[ARMED]": "expected the state WATCHDOG, came Status",
        "test_flashing_needs_an_idle_output[PLAYING]": "FlashBegin: expected Error WRONG_STATE, came FlashStatus",
        "test_codec_is_decoded_as_offline[mdct-one channel]": "the first in channel 0 at sample 100: expected",
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
    blamed = {finding.requirement.test for finding in report.findings if finding.outcome == Outcome.FAILED}
    busy = {
        finding.requirement.test: finding.reason for finding in report.findings if finding.outcome == Outcome.HOST_BUSY
    }
    assert busy, "some tests wait"
    assert all("100 ms late" in reason for reason in busy.values())
    assert not blamed & set(busy)
    only_busy = replace(report, findings=tuple(each for each in report.findings if each.requirement.test in busy))
    assert only_busy.undecided
    assert not only_busy.conforming
    assert "not decided, because this machine was busy" in only_busy.summary


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
    findings = run_suite(TappedLink(link, link.clock, link.sleep), quick=True).findings
    assert {finding.requirement.test for finding in findings if finding.outcome != Outcome.PASSED} == {
        "test_image_that_is_not_confirmed_is_reverted_by_a_restart"  # needs someone to restart it
    }


class Backwards(Altered):
    """Its clock runs backwards."""

    def alter(self, message: Message) -> Message:
        if not isinstance(message, Status):
            return message
        return replace(message, device_time_us=10**12 - message.device_time_us)


class Clicking(Altered):
    """Its output jumps to rest, and goes beyond the codes of its DAC; the actuator is none that is known here."""

    def __init__(self) -> None:
        super().__init__(Settings(actuator=replace(PIEZO_STACK, name="another", dac_bits=12)))

    def alter(self, message: Message) -> Message:
        if not isinstance(message, CaptureData) or message.tap != Tap.DAC:
            return message
        codes = np.frombuffer(message.data, "<i2")
        jumping = np.where(np.abs(codes) < 200, 0, 2 * codes).astype("<i2")
        return replace(message, data=jumping.tobytes())


class OneSlot(Altered):
    """Has one slot only."""

    def alter(self, message: Message) -> Message:
        return replace(message, images=message.images[:1]) if isinstance(message, HelloResponse) else message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faulty", "reasons"),
    [
        (
            Backwards,
            {
                "test_clocks": "a clock that never goes back",
                "test_start_waits_for_the_device_time": "expected the device time",
            },
        ),
        (
            Clicking,
            {
                "test_output_never_jumps": "expected a ramp to and from",
                "test_dac_codes_stay_within_the_dac": "expected codes from -2048 to 2047, came -",
            },
        ),
        (OneSlot, {"test_slots_are_listed": "expected two slots"}),
    ],
)
def test_faults_end_in_a_reason_and_never_in_a_hang(faulty: type[Altered], reasons: dict[str, str]) -> None:
    findings = run_suite(link_to(faulty())).findings
    failed = {finding.requirement.test: finding.reason for finding in findings if finding.outcome == Outcome.FAILED}
    for test, reason in reasons.items():
        assert reason in failed[test]
    assert not any("please report" in reason for reason in failed.values())


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
            return replace(
                message,
                limits=replace(message.limits, **limits),
                actuator=replace(message.actuator, **actuator),  # type: ignore[arg-type]
            )

    report = run_suite(link_to(Absurd()))
    findings = report.findings
    failed = {finding.requirement.test: finding.reason for finding in findings if finding.outcome == Outcome.FAILED}
    assert list(failed) == [test]
    assert "please report" not in failed[test]
    assert sum(finding.outcome == Outcome.NOT_TESTED for finding in findings) > 200
    report.write(tmp_path)
    assert "NaN" not in (tmp_path / "conformance.json").read_text()


@pytest.mark.slow
def test_a_controller_with_another_simple_codec_is_tested() -> None:
    class DctOnly(Altered):
        def alter(self, message: Message) -> Message:
            if not isinstance(message, HelloResponse):
                return message
            return replace(message, codecs=tuple(named for named in message.codecs if named[1] == "dct"))

    findings = run_suite(link_to(DctOnly())).findings
    outcomes = [finding.outcome for finding in findings]
    assert set(outcomes) == {Outcome.PASSED, Outcome.NOT_APPLICABLE}
    assert outcomes.count(Outcome.PASSED) > 180


@pytest.mark.slow
def test_texts_of_a_controller_do_nothing_on_the_terminal_or_the_page(reached: list[Device], tmp_path: Path) -> None:
    class Hostile(Altered):
        def alter(self, message: Message) -> Message:
            return replace(message, build=hostile, hardware=hostile) if isinstance(message, HelloResponse) else message

    hostile = "\x1b[2J\u202e\n# <b>![x](http://y)|`"
    reached.append(Hostile())
    ran = CliRunner().invoke(main, ["conformance", "--out", str(tmp_path), "--quick", "--no-flash"], color=True)
    page = (tmp_path / "conformance.md").read_text()
    for text in (ran.output, page):
        assert "\x1b" not in text
        assert "\u202e" not in text
    assert page.splitlines()[0].startswith("# \\\\x1b\\[2J")
    assert "<b>" not in page
    assert "![x]" not in page


@pytest.mark.slow
def test_result_is_printed_where_the_report_cannot_be_written(
    reached: list[Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "conformance.md"))

    reached.append(Controller())
    monkeypatch.setattr(Path, "write_text", full)
    ran = CliRunner().invoke(main, ["conformance", "--out", str(tmp_path), "--quick", "--no-flash"])
    assert ran.exit_code == 2
    assert "conforming" in ran.output
    assert ran.output.splitlines()[-1].endswith("free some space, or write elsewhere")
    assert list(tmp_path.iterdir()) == []


class Mute(Controller):
    """Says hello in letters that are none."""

    def transmit(self) -> bytes:
        payloads = FrameReader().feed(super().transmit())
        return b"".join(write_frame(payload.replace(b"simulated", b"simul\xff\xfed")) for payload in payloads)


def test_hello_that_cannot_be_read_is_reported() -> None:
    with pytest.raises(NotTestable, match="what comes after Hello cannot be read"):
        run_suite(link_to(Mute()))


class Dying(Controller):
    """Falls silent for good at the first request of an unknown type."""

    dead = False

    def receive(self, data: bytes, now_us: int) -> None:
        if write_frame(b"\x0c")[1:2] == data[1:2] and len(data) > 4:
            self.dead = True
        if not self.dead:
            super().receive(data, now_us)


def test_a_controller_that_dies_does_not_conform_and_is_not_tested_further() -> None:
    findings = run_suite(link_to(Dying()), quick=True).findings
    outcomes = {finding.requirement.test: finding.outcome for finding in findings}
    assert outcomes["test_unknown_requests_are_answered_so"] == Outcome.FAILED
    assert outcomes["test_frame_is_found_after_noise"] == Outcome.PASSED
    assert outcomes["test_gain_of_zero_keeps_the_output_at_rest"] == Outcome.NOT_TESTED
    assert list(outcomes.values()).count(Outcome.FAILED) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        Settings(channels=1, buffer_samples=600, capture_samples=0, watchdog_ms=50),
        Settings(buffer_samples=1024, capture_samples=700),
        Settings(actuator=replace(PIEZO_STACK, name="another")),
    ],
    ids=["tiny", "short-capture", "another-actuator"],
)
def test_missing_parts_of_a_controller_are_no_failures(settings: Settings) -> None:
    findings = run_suite(link_to(Controller(settings))).findings
    assert {finding.outcome for finding in findings} == {Outcome.PASSED, Outcome.NOT_APPLICABLE}
    assert all(finding.reason for finding in findings if finding.outcome == Outcome.NOT_APPLICABLE)


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """Has the command reach, in simulated time, the controller that the test puts here."""
    controllers: list[Device] = []
    links: list[MemoryLink] = []

    @contextmanager
    def reach(address: str, actuator: object = None) -> Iterator[Transport]:
        links.append(MemoryLink(controllers[0]))
        yield links[0]

    def tapped(transport: MemoryLink, may_flash: bool) -> TappedLink:
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


@pytest.mark.slow
def test_command_names_each_failure(reached: list[Device]) -> None:
    reached.append(Faulty())
    ran = CliRunner().invoke(main, ["conformance", "--quick", "--no-flash"])
    assert ran.exit_code == 1
    assert "FAIL  The controller drops and counts a frame with one wrong bit" in ran.output
    assert "not conforming" in ran.output.splitlines()[-1]


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


def test_every_assertion_of_the_suite_says_what_was_expected() -> None:
    silent = [
        f"{module.name}:{node.lineno}"
        for module in MODULES
        for node in ast.walk(ast.parse(module.read_text()))
        if isinstance(node, ast.Assert) and node.msg is None
    ]
    assert silent == []


def test_no_test_of_the_suite_hides_another() -> None:
    names = [
        node.name
        for module in MODULES
        for node in ast.parse(module.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    assert len(set(names)) == len(names)
    imported = Path(__file__).with_name("test_suite.py").read_text()
    assert [module.stem for module in MODULES if f"vibrocast.harness.conformance.{module.stem} " not in imported] == []


def test_list_of_requirements_is_up_to_date() -> None:
    written = page.PAGE.read_text()
    assert written == page.with_requirements(written), "run `python -m vibrocast.harness.conformance.page`"
