"""The subcommand `plan` plays and uploads what it chose."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.command import run
from tests.planner.scenes import CONTROLLER, written
from vibrocast.codec.stream import read_stream
from vibrocast.planner import choose, playing
from vibrocast.planner.choose import TextureChoice
from vibrocast.planner.scene import Scene

SCENES = Path(__file__).parents[2] / "examples" / "scenes"


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
        assert (each["measured"].get("load_percent") is not None) == (name == "one-piezo")


def test_a_choice_is_played_as_its_stream_was_coded(tmp_path: Path) -> None:
    scene = written(tmp_path, controller=CONTROLLER.replace("cortex-m4", "sim"))
    result = run("plan", scene, "--play", "--upload", "--texture", "wood", "--device", "sim-usb", "--out", tmp_path)
    assert result.exit_code == 0, result.stderr
    assert "no texture needs a model; nothing to upload" in result.stdout
    (played,) = json.loads((tmp_path / "forecast.json").read_text())
    assert played["texture"] == "wood" and played["report"]["device"]["address"] == "sim-usb"
    assert "on the wire" in result.stdout
    stream = read_stream(tmp_path / "wood.vct")
    seconds = len(stream.packets) * stream.packet_samples / stream.header.rate_hz
    assert 8 * sum(map(len, stream.packets)) / seconds == pytest.approx(played["measured"]["payload_bps"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--texture", "oak"), "there is no texture 'oak'; choose from wood"),
        (("--play", "--device", "nowhere"), "no device nowhere; `vibrocast devices` lists"),
        (
            ("--play", "--device", "sim", "--device", "sim"),
            "the scene has 1 controllers, and --device is given 2 times",
        ),
        (("--device", "sim"), "--device says where to play; add --play or --upload"),
    ],
)
def test_what_a_scene_cannot_do_is_rejected(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    result = run("plan", written(tmp_path), *arguments)
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.splitlines()) == 1


def test_each_controller_is_sent_the_one_model_that_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texture = '[[textures]]\ngenerate = "wood"\nseconds = 0.6\nrate_hz = 2800\nname = "{}"\n'
    scene = written(
        tmp_path,
        texture=texture.format("wood") + texture.format("oak"),
        controller=CONTROLLER.replace("cortex-m4", "sim"),
    )
    wood, oak = "eva-16-4", "eva-16-4"

    def with_models(scene: Scene, update: choose.Progress) -> tuple[TextureChoice, ...]:
        return tuple(
            replace(each, chosen=replace(each.chosen, measured=replace(each.chosen.measured, model=model)))
            for each, model in zip(planned(scene, update), (wood, oak), strict=True)
        )

    planned = choose.plan
    monkeypatch.setattr(choose, "plan", with_models)
    result = run("plan", scene, "--upload")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.count("one: eva-16-4 ") == 1 and "confirmed" in result.stdout
    oak = "eva-16-5"
    result = run("plan", scene, "--upload")
    assert result.exit_code == 2
    assert "one runs one model at a time, and its textures need eva-16-4 and eva-16-5" in result.stderr


def test_what_plays_otherwise_leaves_its_last_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = written(tmp_path, controller=CONTROLLER.replace("cortex-m4", "sim"))
    monkeypatch.setattr(playing.Played, "failures", lambda _: ["wood is not as planned"])
    result = run("plan", scene, "--play", "--out", tmp_path, "--json")
    assert (result.exit_code, (tmp_path / "plan.pcapng").exists()) == (1, True), result.output
    told = json.loads(result.stdout)
    assert told["error"] == "wood is not as planned" and told["results"][0]["texture"] == "wood"
