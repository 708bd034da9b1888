"""`monitor`, `replay` and `proxy`: what passes a wire is shown, sent again, and damaged."""

import contextlib
import json
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.command import OAK, fails, run, started, succeeds
from vibrocast.device_protocol.trace import read_trace
from vibrocast.errors import HOST_BUSY, LIMIT_MISSED
from vibrocast.simulated_device.serial_port import has_pseudo_terminals

needs_terminals = pytest.mark.skipif(not has_pseudo_terminals(), reason="the port is a pseudo-terminal")


@contextlib.contextmanager
def serving(*arguments: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run a command that serves a port; yield the address that it prints first, and the process."""
    with started(*arguments) as process:
        # Standard output of `monitor` is for frames alone.
        told = process.stderr if arguments[0] == "monitor" else process.stdout
        assert told is not None
        address = told.readline().strip()
        try:
            yield address, process
        finally:
            process.kill()


@needs_terminals
def test_what_passes_is_shown_with_state_credit_buffer_and_counters(tmp_path: Path) -> None:
    link = tmp_path / "port"
    with serving("monitor", "sim", "--link", str(link)) as (address, process):
        assert address == f"serial:{link}"
        played = run("play", OAK, "--device", address)
        process.send_signal(signal.SIGINT)
        shown, errors = process.communicate(timeout=30)
    assert played.exit_code in (0, LIMIT_MISSED, HOST_BUSY), played.output  # a busy computer may lose packets
    assert errors.strip() == "error: interrupted"
    assert re.search(r"^ +0\.000000  host -> controller +#\d+ +Hello +major 2, minor 2$", shown, re.MULTILINE)
    assert re.search(
        r"controller -> host +#?\d* +Status +playing, stream \d+, position \d+, credit until \d+, buffered \d+", shown
    )
    assert "SinglePacket" in shown and "DAMAGED" not in shown
    assert not link.exists()


@needs_terminals
def test_a_proxy_damages_frames_and_pulls_the_cable(tmp_path: Path) -> None:
    schedule = tmp_path / "faults.toml"
    schedule.write_text("[[faults]]\nflipped = 0.1\ndirection = 'to_controller'\n")
    with serving("proxy", "sim", "--faults", str(schedule)) as (address, _):
        damaged = run("live", "rough", "--seconds", "2", "--device", address)
    assert damaged.exit_code in (
        LIMIT_MISSED,
        HOST_BUSY,
    )  # other programs ran meanwhile, so that the limit proves nothing
    assert re.search(r"damaged frames [1-9]\d* there, 0 back", damaged.output)
    schedule.write_text("[[faults]]\nat_s = 0.2\nfor_s = 60\ncut = true\n")
    with serving("proxy", "sim", "--faults", str(schedule)) as (address, _):
        cut = run("live", "rough", "--seconds", "2", "--device", address)
    assert cut.exit_code == 3
    assert re.search("cannot open serial port|broke off", cut.output)  # it may notice while it opens the port again


def test_a_trace_is_shown_and_sent_again(tmp_path: Path) -> None:
    trace = tmp_path / "trace.jsonl"
    assert run("--trace", trace, "play", OAK).exit_code == 0
    frames = list(read_trace(trace))
    shown = run("replay", trace).output.splitlines()
    assert len(shown) == len(frames)
    as_json = [json.loads(line) for line in run("replay", trace, "--json").output.splitlines()]
    assert as_json == [frame.as_json() for frame in frames]
    again = [json.loads(line) for line in run("replay", trace, "--device", "sim", "--json").output.splitlines()]
    sent = [each["frame"] for each in again if each["from"] == "host"]
    assert sent == [frame.encoded.hex() for frame in frames if frame.from_host]
    assert [each["fields"]["state"] for each in again if each["message"] == "Status"][-1] == "FINISHED"


def test_another_file_is_no_trace(tmp_path: Path) -> None:
    (tmp_path / "x.pcapng").write_bytes(b"RIFF")
    assert "no trace; give one that `vibrocast --trace FILE` wrote" in fails(2, "replay", tmp_path / "x.pcapng")


def test_a_trace_is_decoded_as_the_controller_did(tmp_path: Path) -> None:
    trace, heard, coded = tmp_path / "trace.pcapng", tmp_path / "heard.npy", tmp_path / "oak.vct"
    succeeds("encode", OAK, coded)
    succeeds("--trace", trace, "play", coded)
    succeeds("replay", trace, "--decode", heard)
    succeeds("decode", coded, tmp_path / "oak.npy")
    assert np.array_equal(np.load(heard), np.load(tmp_path / "oak.npy"))
    live = tmp_path / "live.pcapng"
    # A busy computer misses limits of a live stream; its trace is whole all the same.
    assert run("--trace", live, "live", "rough", "--seconds", "0.5", "--playout-delay-ms", "300").exit_code in (
        0,
        LIMIT_MISSED,
        HOST_BUSY,
    )
    assert "0.5" in run("replay", live, "--decode", tmp_path / "live.wav").output
    succeeds("--trace", live, "status")
    assert "no stream was set up in it" in fails(2, "replay", live, "--decode", heard)


@pytest.mark.parametrize("given", [("replay", "{trace}"), ("status", "--log={trace}"), ("play", OAK, "--nonsense")])
def test_a_trace_that_is_there_already_survives_a_command_that_is_rejected(
    given: tuple[object, ...], tmp_path: Path
) -> None:
    trace = tmp_path / "trace.pcapng"
    assert run("--trace", trace, "status").exit_code == 0
    before = trace.read_bytes()
    result = run("--trace", trace, *(str(part).format(trace=trace) for part in given))
    assert result.exit_code == 2, result.output
    assert trace.read_bytes() == before
    if given[0] == "replay":
        assert "are the same file; give the output another name" in result.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a full disk is simulated on Linux alone")
@pytest.mark.parametrize("option", ["--trace", "--log"])
def test_a_full_disk_is_one_line(option: str, tmp_path: Path) -> None:
    full = tmp_path / "full.pcapng"
    full.symlink_to("/dev/full")
    result = run(option, full, "status", "--json")
    assert result.exit_code == 2 and not isinstance(result.exception, OSError), result.exception
    (line,) = result.stderr.splitlines()
    assert line.endswith("full.pcapng: No space left on device; free some space, or write elsewhere")
    assert json.loads(result.stdout)["exit_code"] == 2


@needs_terminals
@pytest.mark.parametrize("command", ["monitor", "proxy", "simulate"])
def test_commands_that_serve_answer_in_lines_of_json(command: str) -> None:
    """Also at their end, where somebody reads them line by line."""
    target = () if command == "simulate" else ("sim",)
    with serving(command, *target, "--json") as (address, process):
        assert run("status", "--device", json.loads(address)["address"]).exit_code == 0
        if command == "monitor":
            assert process.stdout is not None
            assert "time_ns" in json.loads(process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        shown, _ = process.communicate(timeout=30)
    *frames, last = map(json.loads, shown.splitlines())
    assert last == {"error": "interrupted", "exit_code": 143}
    assert command == "monitor" or not frames
    failed = run(command, *(("serial:nowhere",) if target else ("--public-key", "/nope")), "--json")
    (line,) = failed.stdout.splitlines()
    assert json.loads(line)["exit_code"] == failed.exit_code
