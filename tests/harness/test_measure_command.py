"""`vibrocast measure`: the files that it writes, its comparison, and its errors."""

import hashlib
import json
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tests import command
from tests.harness.runs import LATENCY
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import LIMIT_MISSED, NO_DEVICE, REGRESSION
from vibrocast.harness import measurements, response
from vibrocast.harness.load import Throughput
from vibrocast.host.report import Timing
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.serial_port import serial_port

SENSOR = """
[[sensors]]
name = "laser"
kind = "laser"
command = ["{python}", "-c", "{program}", "{{file}}"]
"""


run = partial(command.run, "measure")


def bench_file(folder: Path, program: str = "") -> Path:
    path = folder / "bench.toml"
    text = '[[controllers]]\nname = "it"\naddress = "sim"\n[[textures]]\ngenerate = "rough"\nseconds = 0.5\n'
    path.write_text(text + (SENSOR.format(python=sys.executable, program=program) if program else ""))
    return path


def test_a_run_is_written_and_compared_with_itself_and_a_better_one(tmp_path: Path) -> None:
    arguments = ("--bench", bench_file(tmp_path), "--only", "fidelity", "--out", tmp_path / "out")
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    assert "rough: DAC as computed: yes" in first.output
    written = tmp_path / "out" / "measured.json"
    assert (tmp_path / "out" / "measured.html").read_text().startswith("<!doctype html>")
    assert run(*arguments, "--compare", written).exit_code == 0
    document = json.loads(written.read_text())
    document["measured"]["fidelity"][0]["report"]["quality"]["skin"]["playing_snr_db"] += 20
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps(document))
    worse = run(*arguments, "--compare", earlier)
    assert worse.exit_code == REGRESSION
    assert f"error: not as in {earlier}: rough: SNR without the codec, dB (worse)" in worse.output


def test_controllers_of_a_bench_play_at_once_and_each_as_computed(tmp_path: Path) -> None:
    path = bench_file(tmp_path)
    path.write_text('[[controllers]]\nname = "other"\naddress = "sim"\n' + path.read_text())
    result = run("--bench", path, "--only", "together", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert document["measured"]["together"] == [
        {"name": name, "as_computed": True, "underruns": 0, "failure": None} for name in ("other", "it")
    ]


def test_a_missed_limit_fails_and_is_named_and_the_fitted_actuator_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(response, "measure_response", partial(response.measure_response, seconds=1.0))
    path = bench_file(tmp_path)
    path.write_text(path.read_text() + "[limits]\nmin_snr_db = 99\nmax_bad_frames = 0\n")
    result = run("--bench", path, "--only", "fidelity,response", "--out", tmp_path / "out")
    assert result.exit_code == LIMIT_MISSED
    assert re.search(r"error: limits missed: rough: snr_db = [\d.]+, min_snr_db = 99; see \[limits\]", result.output)
    document = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert len(document["missed"]) == 1
    fitted = actuator_files.find(tmp_path / "out" / "actuator.toml")
    assert fitted.corner_hz == document["measured"]["response"]["fit"]["corner_hz"]
    assert document["run"]["bench_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_another_actuator_than_the_bench_has_is_rejected_before_measuring(tmp_path: Path) -> None:
    with serial_port(Controller(Settings(actuator=ACTUATORS["lra"]))) as port:
        path = tmp_path / "bench.toml"
        path.write_text(
            f'[[controllers]]\nname = "it"\naddress = "serial:{port.name}"\n[[actuators]]\nmodel = "piezo-stack"\n'
        )
        result = run("--bench", path, "--only", "throughput", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "it drives lra, and the bench has piezo-stack there: a resonance instead of a low-pass" in result.output


def test_what_is_worse_as_the_computer_was_busy_is_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = iter([1000.0, 100.0, 1000.0, 100.0, 100.0, 100.0])
    monkeypatch.setattr(
        measurements,
        "MEASUREMENTS",
        {"throughput": lambda *_: Throughput(next(taken), 1.0, 0)},
    )
    earlier = tmp_path / "earlier" / "measured.json"
    arguments = ("--only", "throughput", "--out")
    assert run(*arguments, tmp_path / "earlier").exit_code == 0
    once = run(*arguments, tmp_path / "once", "--compare", earlier)
    assert once.exit_code == 0
    assert "worse, measured again: throughput" in once.output
    lasting = run(*arguments, tmp_path / "lasting", "--compare", earlier)
    assert lasting.exit_code == REGRESSION
    assert "throughput to the controller" in lasting.output
    assert next(taken, None) is None


def test_losses_of_a_first_take_stay_where_times_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = replace(LATENCY.report, timing=Timing(end_to_end_ms=99.0), lost_packets=3)
    takes = iter([LATENCY, replace(LATENCY, report=late), LATENCY])
    monkeypatch.setattr(measurements, "MEASUREMENTS", {"latency": lambda *_: next(takes)})
    monkeypatch.setattr("vibrocast.harness.page.write", lambda *_: None)
    arguments = ("--only", "latency", "--out")
    assert run(*arguments, tmp_path / "earlier").exit_code == 0
    result = run(*arguments, tmp_path / "now", "--compare", tmp_path / "earlier" / "measured.json")
    assert "worse, measured again: latency" in result.output
    assert result.exit_code == REGRESSION
    assert "live: lost packets, % (worse)" in result.output and "latency, ms (worse)" not in result.output


def test_what_was_measured_before_the_cable_was_pulled_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pulled(*_: object) -> None:
        raise TransportError("the cable is out")

    monkeypatch.setattr(measurements, "MEASUREMENTS", {**measurements.MEASUREMENTS, "response": pulled})
    bench = bench_file(tmp_path)
    result = run("--bench", bench, "--only", "fidelity,response", "--out", tmp_path / "out")
    assert result.exit_code == NO_DEVICE
    assert result.output.splitlines()[-1] == "error: the cable is out"
    document = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert list(document["measured"]) == ["fidelity"]
    assert document["failed"] == {"the rest": "the cable is out"}


@pytest.mark.slow
def test_a_sensor_that_fails_leaves_the_other_measurements(tmp_path: Path) -> None:
    # One byte of the complaint is no text.
    bench = bench_file(tmp_path, "import os; os.write(2, bytes([255])); raise SystemExit('no microphone')")
    result = run("--bench", bench, "--allow-programs", "--only", "throughput,fidelity", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "not all could be measured: fidelity: sensor laser: " in result.output and "no microphone" in result.output
    assert "throughput to the host: " in result.output


def test_a_bench_file_starts_no_program_unasked(tmp_path: Path) -> None:
    bench = bench_file(tmp_path, "open('started', 'w')")
    result = run("--bench", bench, "--only", "fidelity", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert f"sensor laser starts the program {sys.executable!r}" in result.output
    assert "pass --allow-programs if you trust it" in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--device", "nowhere"], "'nowhere' is no controller"),
        (["--bench", "nowhere.toml"], "nowhere.toml: No such file or directory"),
        (["--only", "taste"], "'taste' is no measurement; give some of latency, "),
        (["--compare", "nowhere.json"], "nowhere.json: No such file or directory"),
    ],
)
def test_bad_input_is_reported_in_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    result = run(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.output
    assert len(result.output.strip().splitlines()) == 1
