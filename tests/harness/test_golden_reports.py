"""The JSON reports of play, live, measure and plan, in simulated time, against those in golden_reports/.

`GOLDEN=write python -m pytest tests/harness/test_golden_reports.py` writes them again, after a change that you declare.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from tests import command
from tests.conftest import noise, texture
from tests.planner.scenes import CONTROLLER, written
from vibrocast import textures

GOLDEN = Path(__file__).with_name("golden_reports")
CHANGES = {
    "run_id",
    "date",
    "version",
    "bench_sha256",
    "python",
    "numpy",
    "build",
    "processor",
    "system",
    "vibrocast",
    "device_time_us",
}
"""Keys whose values differ from run to run, or from computer to computer."""
HAND = ("--hand", "5", "--hand-speed-mm-s", "60")
BENCH = '[[controllers]]\nname = "it"\naddress = "sim"\n[[textures]]\ngenerate = "rough"\nseconds = 0.5\n'


def kept(value: Any) -> Any:
    """Return a document with nothing in place of the values of CHANGES, and without the controller's last Status."""
    if isinstance(value, dict):
        return {
            key: type(part)() if key in CHANGES and not isinstance(part, dict) else kept(part)
            for key, part in value.items()
            if key != "status"
        }
    return [kept(part) for part in value] if isinstance(value, list) else value


def assert_equal(found: Any, golden: Any, place: str = "") -> None:
    """Compare two documents; numbers may differ by what the libraries of another computer round otherwise."""
    if isinstance(golden, dict):
        assert list(found) == list(golden), place
        for key, value in golden.items():
            assert_equal(found[key], value, f"{place}.{key}")
    elif isinstance(golden, list):
        assert len(found) == len(golden), place
        for number, value in enumerate(golden):
            assert_equal(found[number], value, f"{place}[{number}]")
    else:
        assert found == (pytest.approx(golden, rel=1e-4, abs=1e-6) if isinstance(golden, float) else golden), place


def compare(name: str, document: Any) -> None:
    """Compare a document with its golden one, or write that."""
    golden, found = GOLDEN / f"{name}.json", kept(document)
    if os.environ.get("GOLDEN") == "write":
        golden.write_text(json.dumps(found, indent=1) + "\n")
    assert_equal(found, json.loads(golden.read_text()))


@pytest.mark.usefixtures("simulated_time")
def test_a_playback(tmp_path: Path) -> None:
    recording = texture(noise(0.5, rms=2.0))
    textures.save(tmp_path / "noise.wav", recording)
    command.succeeds("play", tmp_path / "noise.wav", "--report", tmp_path / "report.json")
    compare("play", json.loads((tmp_path / "report.json").read_text()))


@pytest.mark.usefixtures("simulated_time")
def test_a_hand_over_a_profile(tmp_path: Path) -> None:
    heights_um = noise(0.5, rms=5.0)[:, 0]
    textures.save_profile(tmp_path / "noise.csv", textures.Profile(heights_um, 10.0, "noise"))
    command.succeeds("play", tmp_path / "noise.csv", *HAND, "--report", tmp_path / "report.json")
    compare("hand", json.loads((tmp_path / "report.json").read_text()))


@pytest.mark.usefixtures("simulated_time")
def test_a_live_stream() -> None:
    compare("live", command.answer("live", "rough", "--seconds", "1"))


@pytest.mark.usefixtures("simulated_time")
def test_measurements(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(BENCH)
    only = "latency,fidelity,response"
    command.succeeds("measure", "--bench", tmp_path / "bench.toml", "--only", only, "--out", tmp_path)
    compare("measure", json.loads((tmp_path / "measured.json").read_text()))


def test_a_plan(tmp_path: Path) -> None:
    scene = written(tmp_path, controller=CONTROLLER.replace("cortex-m4", "sim"))
    command.succeeds("plan", scene, "--play", "--out", tmp_path / "planned")
    compare("plan", json.loads((tmp_path / "planned" / "forecast.json").read_text()))
