"""Use of plans by the commands: one command plans and plays example scenes; plans are played and coded."""

import json
import re
from pathlib import Path

import pytest

from tests.command import run
from tests.planner.scenes import CONTROLLER, written
from vibrocast.codec.stream import read_stream

SCENES = Path(__file__).parents[2] / "examples" / "scenes"


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a plan file of one texture on a simulated controller."""
    folder = tmp_path_factory.mktemp("planned")
    path = written(folder, controller=CONTROLLER.replace("cortex-m4", "sim"))
    planned = run("plan", path, "--out", folder / "out")
    assert planned.exit_code == 0, planned.stderr
    return folder / "out" / "plan.toml"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["one-piezo", "glove", "workstation"])
def test_an_example_scene_plays_as_it_was_forecast(tmp_path: Path, name: str) -> None:
    if name == "one-piezo":
        pytest.importorskip("unicorn")
    result = run("plan", SCENES / f"{name}.toml", "--out", tmp_path, "--play", "--json")
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    assert document == json.loads((tmp_path / "forecast.json").read_text())
    assert {each["report"]["dac_equals_offline"] for each in document} == {True}
    for each in document:
        assert each["measured"]["wire_bps"] == pytest.approx(each["forecast"]["wire_bps"], rel=0.1)
        assert each["measured"]["snr_db"] == pytest.approx(each["forecast"]["snr_db"], abs=0.8)
    loads = [line.split(",") for line in (tmp_path / "forecast.csv").read_text().splitlines() if "load_percent" in line]
    assert [fields[-1] for fields in loads] == (["True"] * 3 if name == "one-piezo" else [])


def test_a_texture_of_a_plan_is_played_and_coded_as_planned(plan: Path, tmp_path: Path) -> None:
    result = run("plan", plan, "--play", "--texture", "wood", "--out", tmp_path)
    assert result.exit_code == 0, result.stderr
    (played,) = json.loads((tmp_path / "forecast.json").read_text())
    assert played["texture"] == "wood" and "on the wire" in result.stdout
    stream = read_stream(plan.parent / "wood.vct")
    seconds = len(stream.packets) * stream.packet_samples / stream.header.rate_hz
    assert 8 * sum(map(len, stream.packets)) / seconds == pytest.approx(played["measured"]["payload_bps"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--play", "--texture", "oak"), "the plan has no texture 'oak'; choose from wood"),
        (("--play", "--device", "nowhere"), "'nowhere' is no address; give sim"),
        (("--play", "--device", "sim", "--device", "sim"), "the plan has 1 controllers, and --device is given 2 times"),
        (("--device", "sim"), "--texture and --device say how to play; add --play or --upload"),
        ((), "is a plan; add --play or --upload, or give a scene"),
    ],
)
def test_what_a_plan_cannot_do_is_rejected(plan: Path, arguments: tuple[str, ...], message: str) -> None:
    result = run("plan", plan, *arguments)
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.splitlines()) == 1


def rewritten(plan: Path, path: Path, model: str) -> str:
    """Write a plan whose textures name a model, or none, and return its text."""
    text = re.sub(r'^model = ".*"\n', "", plan.read_text(), flags=re.MULTILINE)
    text = text.replace('codec = "', f'{model}codec = "').replace(
        "../scene.toml", str(plan.parent.parent / "scene.toml")
    )
    path.write_text(text)
    return text


def test_a_plan_says_what_to_upload_and_no_more_than_a_controller_runs(plan: Path, tmp_path: Path) -> None:
    rewritten(plan, tmp_path / "none.toml", "")
    result = run("plan", tmp_path / "none.toml", "--upload")
    assert (result.exit_code, result.stdout) == (0, "no texture needs a model; nothing to upload\n")
    one = rewritten(plan, tmp_path / "one.toml", 'model = "eva-16-4"\n')
    result = run("plan", tmp_path / "one.toml", "--upload")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("one: eva-16-4 ") and "confirmed" in result.stdout
    another = one[one.index("[[textures]]") :].replace('name = "wood"', 'name = "oak"').replace("eva-16-4", "eva-16-5")
    (tmp_path / "two.toml").write_text(one + another)
    result = run("plan", tmp_path / "two.toml", "--upload")
    assert result.exit_code == 2
    assert "one runs one model at a time, and its textures need eva-16-4 and eva-16-5" in result.stderr


def test_a_plan_that_plays_otherwise_leaves_its_last_frames(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.planner.comparison.failures", lambda *_: ["wood is not as planned"])
    result = run("plan", plan, "--play", "--out", tmp_path, "--json")
    assert (result.exit_code, (tmp_path / "plan.pcapng").exists()) == (1, True), result.output
    told = json.loads(result.stdout)
    assert told["error"] == "wood is not as planned" and told["results"][0]["texture"] == "wood"
