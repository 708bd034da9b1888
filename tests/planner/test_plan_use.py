"""Use of plans by the commands: one command plans and plays example scenes; plans are played and coded."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from tests.planner.scenes import CONTROLLER, written
from vibrocast.codec.stream import read_stream
from vibrocast.host.cli.command_line import main

SCENES = Path(__file__).parents[2] / "examples" / "scenes"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a plan file of one texture on a simulated controller."""
    folder = tmp_path_factory.mktemp("planned")
    path = written(folder, controller=CONTROLLER.replace("cortex-m4", "sim"))
    assert run("plan", path, "--out", folder / "out").exit_code == 0
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
    assert {each["dac_as_computed"] for each in document} == {True}
    for each in document:
        assert each["measured"]["wire_bps"] == pytest.approx(each["forecast"]["wire_bps"], rel=0.1)
        assert each["measured"]["snr_db"] == pytest.approx(each["forecast"]["snr_db"], abs=0.8)
    loads = [line.split(",") for line in (tmp_path / "forecast.csv").read_text().splitlines() if "load_percent" in line]
    assert [fields[-1] for fields in loads] == (["True"] * 3 if name == "one-piezo" else [])


def test_a_texture_of_a_plan_is_played_and_coded_as_planned(plan: Path, tmp_path: Path) -> None:
    result = run("play", "wood", "--plan", plan, "--report", tmp_path / "played.json")
    assert result.exit_code == 0, result.stderr
    (played,) = json.loads((tmp_path / "played.json").read_text())
    assert played["texture"] == "wood" and "on the wire" in result.stdout
    result = run("encode", "wood", tmp_path / "wood.vct", "--plan", plan)
    assert result.exit_code == 0, result.stderr
    stream = read_stream(tmp_path / "wood.vct")
    seconds = len(stream.packets) * stream.decoder().packet_samples / stream.header.rate_hz
    assert 8 * sum(map(len, stream.packets)) / seconds == pytest.approx(played["measured"]["payload_bps"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("play", "oak"), "the plan has no texture 'oak'; choose from wood"),
        (("play", "--loop", "2"), "--loop contradicts the plan; drop it, or change"),
        (("play", "--snr-db", "5"), "--snr-db contradicts the plan; drop it, or change"),
        (("play", "--device", "nowhere"), "'nowhere' is no address; give sim"),
        (("encode", "wood", "out.vct", "--rate-bps", "500"), "--rate-bps contradicts the plan; drop it"),
        (("flash", "mdct-textures"), "MODEL contradicts the plan; drop it"),
        (("measure", "--bench", "bench.toml"), "--plan and --bench both name controllers and actuators"),
    ],
)
def test_what_contradicts_a_plan_is_rejected(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments, "--plan", plan)
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.splitlines()) == 1


def test_without_a_plan_its_options_are_required() -> None:
    assert "missing FILE; pass it, or --plan" in run("play").stderr
    assert "missing MODEL; pass it, or --plan" in run("flash").stderr


def test_a_plan_that_needs_no_model_says_so(plan: Path, tmp_path: Path) -> None:
    text = re.sub(r'^model = ".*"\n', "", plan.read_text(), flags=re.MULTILINE)
    none = tmp_path / "none.toml"
    none.write_text(text.replace("../scene.toml", str(plan.parent.parent / "scene.toml")))
    result = run("flash", "--plan", none)
    assert (result.exit_code, result.stdout) == (0, f"{none}: no texture needs a model; nothing to upload\n")


def test_a_plan_says_what_to_flash_and_no_more_than_a_controller_runs(plan: Path, tmp_path: Path) -> None:
    text = re.sub(r'^model = ".*"\n', "", plan.read_text(), flags=re.MULTILINE)
    text = text.replace('codec = "', 'model = "eva-16-4"\ncodec = "')
    one = tmp_path / "one.toml"
    one.write_text(text.replace("../scene.toml", str(plan.parent.parent / "scene.toml")))
    result = run("flash", "--plan", one)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("one: eva-16-4 ") and "confirmed" in result.stdout
    another = (
        text[text.index("[[textures]]") :].replace('name = "wood"', 'name = "oak"').replace("eva-16-4", "eva-16-5")
    )
    (tmp_path / "two.toml").write_text(text + another)
    result = run("flash", "--plan", tmp_path / "two.toml")
    assert result.exit_code == 2
    assert "one runs one model at a time, and its textures need eva-16-4 and eva-16-5" in result.stderr


def test_what_is_measured_of_a_bench_is_measured_of_a_plan(plan: Path, tmp_path: Path) -> None:
    result = run("measure", "--plan", plan, "--out", tmp_path, "--only", "fidelity")
    assert result.exit_code == 0, result.stderr
    measured = json.loads((tmp_path / "measured.json").read_text())
    assert [each["texture"] for each in measured["measured"]["fidelity"]] == ["wood"]


def test_json_does_not_contradict_a_plan(plan: Path, tmp_path: Path) -> None:
    result = run("encode", "wood", tmp_path / "wood.vct", "--plan", plan, "--json")
    assert result.exit_code == 0 and json.loads(result.stdout)["out"] == str(tmp_path / "wood.vct")


def test_a_plan_that_plays_otherwise_leaves_its_last_frames(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.host.planner.comparison.failures", lambda *_: ["wood is not as planned"])
    result = run("play", "--plan", plan, "--report", tmp_path / "played.json", "--json")
    assert (result.exit_code, (tmp_path / "played.pcapng").exists()) == (1, True), result.output
    told = json.loads(result.stdout)
    assert told["error"] == "wood is not as planned" and told["results"][0]["texture"] == "wood"
