"""`vibrocast measure`: the files that it writes, its comparison, and its errors."""

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.cli.command_line import main
from vibrocast.host.harness import measurements

SENSOR = """
[[sensors]]
name = "laser"
kind = "laser"
command = ["{python}", "-c", "{program}", "{{file}}"]
"""


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["measure", *arguments])


def bench_file(folder: Path, program: str = "") -> Path:
    path = folder / "bench.toml"
    text = '[[controllers]]\nname = "it"\naddress = "sim"\n[[textures]]\ngenerate = "rough"\nseconds = 0.5\n'
    path.write_text(text + (SENSOR.format(python=sys.executable, program=program) if program else ""))
    return path


def test_a_run_is_written_and_compared_with_itself_and_a_better_one(tmp_path: Path) -> None:
    arguments = ("--bench", str(bench_file(tmp_path)), "--only", "fidelity", "--out", str(tmp_path / "out"))
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    assert "rough: DAC as computed: yes" in first.output
    written = tmp_path / "out" / "measured.json"
    assert (tmp_path / "out" / "measured.html").read_text().startswith("<!doctype html>")
    assert run(*arguments, "--compare", str(written)).exit_code == 0
    document = json.loads(written.read_text())
    document["measured"]["fidelity"][0]["playing_snr_db"] += 20
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps(document))
    worse = run(*arguments, "--compare", str(earlier))
    assert worse.exit_code == 1
    assert f"error: worse than in {earlier}: rough: SNR without the codec, dB" in worse.output


def test_what_is_worse_as_the_computer_was_busy_is_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = iter([1000.0, 100.0, 1000.0, 100.0, 100.0, 100.0])
    monkeypatch.setattr(
        measurements,
        "MEASUREMENTS",
        {
            "throughput": lambda *_: {
                "to_controller_bytes_per_s": next(taken),
                "to_host_bytes_per_s": 1.0,
                "bad_frames": 0,
            }
        },
    )
    earlier = str(tmp_path / "earlier" / "measured.json")
    arguments = ("--only", "throughput", "--out")
    assert run(*arguments, str(tmp_path / "earlier")).exit_code == 0
    once = run(*arguments, str(tmp_path / "once"), "--compare", earlier)
    assert once.exit_code == 0
    assert "worse, measured again: throughput" in once.output
    lasting = run(*arguments, str(tmp_path / "lasting"), "--compare", earlier)
    assert lasting.exit_code == 1
    assert "throughput to the controller" in lasting.output
    assert next(taken, None) is None


def test_what_was_measured_before_the_cable_was_pulled_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pulled(*_: object) -> None:
        raise TransportError("the cable is out")

    monkeypatch.setattr(measurements, "MEASUREMENTS", {**measurements.MEASUREMENTS, "response": pulled})
    bench = str(bench_file(tmp_path))
    result = run("--bench", bench, "--only", "fidelity,response", "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert result.output.splitlines()[-1] == "error: the cable is out"
    document = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert list(document["measured"]) == ["fidelity"]
    assert document["failed"] == {"the rest": "the cable is out"}


@pytest.mark.slow
def test_a_sensor_that_fails_leaves_the_other_measurements(tmp_path: Path) -> None:
    bench = str(bench_file(tmp_path, "raise SystemExit('no microphone')"))
    result = run("--bench", bench, "--only", "throughput,fidelity", "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "not measured: fidelity: sensor laser: " in result.output and "no microphone" in result.output
    assert "throughput to the host: " in result.output


def test_an_undecodable_complaint_of_a_sensor_is_reported(tmp_path: Path) -> None:
    bench = str(bench_file(tmp_path, "import os; os.write(2, bytes([255])); raise SystemExit(1)"))
    result = run("--bench", bench, "--only", "fidelity", "--out", str(tmp_path / "out"))
    assert "not measured: fidelity: sensor laser: " in result.output


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
    result = run(*arguments, "--out", str(tmp_path / "out"))
    assert result.exit_code == 2
    assert message in result.output
    assert len(result.output.strip().splitlines()) == 1
