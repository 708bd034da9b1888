"""Each subcommand answers in JSON, and keeps a log where asked: for CI jobs that read neither screens nor pages."""

import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest

from tests.command import OAK, ROOT, answer, failure, run
from vibrocast.harness.measurements import MEASUREMENTS
from vibrocast.host.cli.command_line import main
from vibrocast.host.cli.commands import subcommands


def test_every_subcommand_has_the_option() -> None:
    ctx = click.Context(main)
    commands: list[tuple[str, click.Command]] = []
    for name in subcommands():
        command = main.get_command(ctx, name)
        assert command is not None
        commands += [*command.commands.items()] if isinstance(command, click.Group) else [(name, command)]
    assert len(commands) > 25
    for name, command in commands:
        assert "--json" in [option for parameter in command.params for option in parameter.opts], name


def test_files_are_described(tmp_path: Path) -> None:
    coded, decoded, drive = tmp_path / "oak.vct", tmp_path / "oak.wav", tmp_path / "drive.wav"
    assert answer("encode", OAK, coded)["quality"]["snr_db"] == pytest.approx(14.8, abs=0.5)
    assert answer("info", coded)["codec"] == "mdct"
    assert answer("decode", coded, decoded)["rate_hz"] == 2800
    assert answer("render", coded, drive, "--actuator", "lra")["limited"]["power_limited"] >= 0
    assert answer("generate", "taps", tmp_path / "taps.wav", "--seconds", "1")["seconds"] == 1.0
    assert "sim" in answer("devices")


def test_a_log_is_kept_in_a_file(tmp_path: Path) -> None:
    log = tmp_path / "bench.log"
    assert run("--log", log, "play", OAK).exit_code == 0
    assert run("--log", log, "play", OAK, "--device", "serial:nowhere").exit_code == 3
    lines = log.read_text().splitlines()
    assert all(
        re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (DEBUG|INFO|ERROR) vibrocast\.", line) for line in lines
    )
    assert any("session with simulated" in line for line in lines)
    assert any("set up: codec" in line for line in lines)
    assert next(line for line in lines if "ERROR" in line).endswith("exit code 3")
    assert run("--log", tmp_path / "no" / "folder" / "log", "devices").exit_code == 2


def test_an_interrupted_command_answers_with_the_figures_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a stream, of measurements, and of the tests of a controller."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    def cut(*arguments: object) -> Any:
        told = failure(130, *arguments)
        assert told["error"] == "interrupted"
        return told

    with monkeypatch.context() as patch:
        patch.setattr("vibrocast.host.live_playback.LivePlayback._note", interrupted)
        told = cut("live", "rough", "--seconds", "30")
        assert 0 < told["seconds"] < 30 and told["quality"]["snr_db"] is None
    out = tmp_path / "out"
    out.mkdir()
    (out / "measured.json").write_text('{"earlier": "run"}')
    os.utime(out / "measured.json", (1.0, 1.0))
    with monkeypatch.context() as patch:
        patch.setitem(MEASUREMENTS, "gap", interrupted)
        assert cut("measure", "--only", "throughput,gap", "--out", out)["measured"]["throughput"]
        (out / "measured.json").write_text('{"earlier": "run"}')
        os.utime(out / "measured.json", (1.0, 1.0))
        assert cut("measure", "--only", "gap", "--out", out) == {"error": "interrupted", "exit_code": 130}
    tested: list[str] = []

    def sections(_part: float, section: str) -> None:
        tested.append(section)
        if len(tested) == 20:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("vibrocast.progress.bar", lambda _: contextlib.nullcontext(sections))
        found = cut("conformance", "--quick")["requirements"]
    assert {each["outcome"] for each in found[:10]} == {"pass"}
    assert found[-1]["outcome"] == "not tested" and found[-1]["reason"] == "the suite was interrupted"


def test_a_command_that_is_killed_while_a_library_computes_answers_in_json() -> None:
    """Also before it has parsed a single option."""
    code = (
        "import sys, signal; sys.argv = ['vibrocast', 'codecs', '--json'];"
        "from vibrocast.host.cli import entry; entry._leave(signal.SIGTERM, None)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert ended.returncode == 143
    assert json.loads(ended.stdout) == {"error": "interrupted", "exit_code": 143}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("measure", "--only", "foo"), "is no measurement"),
        (("live", "rough", "--seconds", "nan"), "finite number"),
        (("proxy", "sim", "--lost", "2"), "from 0 to 1"),
        (("play", OAK, "--no-such-option"), "No such option"),
        (("play", OAK, "--report", "/nope/r.json"), "the folder /nope does not exist"),
        (("play", OAK, "--bench", "{bench}"), "min_snr_db"),
        (("no-such-command",), "No such command"),
        (("keys", "no-such-command"), "No such command"),
        (("--trace", "frames.txt", "devices"), "must end in"),
        (("--log", "/nope/log", "devices"), "the folder /nope does not exist"),
    ],
)
def test_an_option_that_cannot_be_read_is_an_error_in_the_answer(
    arguments: tuple[object, ...], told: str, tmp_path: Path
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text('[[controllers]]\nname = "it"\naddress = "sim"\n[limits]\nmin_snr_db = nan\n')
    assert told in failure(2, *(str(argument).format(bench=bench) for argument in arguments))["error"]


def test_json_behind_two_dashes_is_an_argument() -> None:
    result = run("encode", "--", "--json", "out.vct")
    assert result.exit_code == 2 and not result.stdout
