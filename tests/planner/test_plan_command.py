"""The subcommand `plan`: its answer and its files; a bad scene is an error of one line."""

import csv
import json
import re
from functools import partial
from pathlib import Path

import pytest

from tests import command
from tests.planner.scenes import CONTROLLER, TEXTURE, written

run = partial(command.run, "plan")


def test_a_plan_its_streams_candidates_and_reasons(tmp_path: Path) -> None:
    # Parametric coding looks far ahead: it is the cheapest where delay costs nothing.
    asked, weights = "[asked]\nthird_octave_distance_db = 4.5\n", "[weights]\nper_millisecond = 0\n"
    done = run(written(tmp_path, asked=asked, weights=weights), "--out", tmp_path / "planned")
    assert done.exit_code == 0, done.output
    names = {path.name for path in (tmp_path / "planned").iterdir()}
    assert names == {"plan.json", "candidates.csv", "wood.vct"}
    (plan,) = json.loads((tmp_path / "planned" / "plan.json").read_text())
    assert plan["choice"]["codec"] == "parametric", "the cheapest rate point where a measure blind to phase allows it"
    assert plan["choice"]["forecast"]["snr_db"] < 5
    with (tmp_path / "planned" / "candidates.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["chosen"] == "True" for row in rows) == 1
    assert re.search(r"^wood: parametric", done.output, re.MULTILINE) and "higher cost (" in done.output
    assert len(re.findall(r"^  rejected ", done.output, re.MULTILINE)) == 3
    assert re.search(r"quality +SNR [-0]", done.output), "the answer shows the SNR that parametric coding gives up"
    assert done.stdout.splitlines()[-1] == f"{tmp_path / 'planned'}: plan.json, candidates.csv, wood.vct"


def test_a_waveform_is_kept_where_it_is_asked_for(tmp_path: Path) -> None:
    scene = written(tmp_path, asked="[asked]\nthird_octave_distance_db = 4.5\nwaveform = true\n")
    done = run(scene, "--out", tmp_path / "planned", "--json")
    assert done.exit_code == 0, done.output
    (answer,) = json.loads(done.stdout)
    assert answer["texture"] == "wood" and len(answer["alternatives"]) == 3
    assert answer["reason"].startswith("cheapest of ")
    forecast = answer["choice"]["forecast"]
    assert forecast["wire_bps"] > forecast["payload_bps"] > 0 and "parametric" not in done.output
    assert json.loads((tmp_path / "planned" / "plan.json").read_text()) == [answer]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"texture": TEXTURE.replace("0.6", "600000")}, "seconds = 600000 is out of range"),
        ({"controller": CONTROLLER + "clock_hz = 168e9\n"}, "are the units mixed up?"),
        ({"controller": CONTROLLER + "flash_bytes = 20_000\n"}, "one: flash_bytes = "),
    ],
)
def test_a_bad_scene_is_one_line_and_nothing_is_written(changed: dict[str, str], message: str, tmp_path: Path) -> None:
    path = written(tmp_path, **changed)
    done = run(path, "--out", tmp_path / "planned")
    assert done.exit_code == 2 and message in done.output
    assert len(done.output.splitlines()) == 1 + done.output.count("planning ")
    assert not (tmp_path / "planned").exists()
    assert "No such file" in command.fails(2, "plan", tmp_path / "none.toml", "--out", tmp_path)
