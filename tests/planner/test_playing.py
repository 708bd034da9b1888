"""A played plan gives its forecast; misfits and deviations from the forecast are reported."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.planner.scenes import CONTROLLER, scene
from vibrocast import textures
from vibrocast.codec.rate_control import added_bytes
from vibrocast.errors import InputError
from vibrocast.host.live import LiveCoding
from vibrocast.host.live_playback import play_live
from vibrocast.planner import choose, comparison, playing
from vibrocast.planner.plan_file import Plan, read_plan, write_plan

SIMULATED = CONTROLLER.replace("cortex-m4", "sim-usb")
TWO = (
    '[[controllers]]\nname = "left"\naddress = "sim"\n[[controllers]]\nname = "right"\naddress = "sim-usb"\n'
    '[[actuators]]\nmodel = "piezo-stack"\ncontroller = "left"\n'
)
LRA = '[[actuators]]\nmodel = "lra"\ncontroller = "right"\n'


def texture(kind: str, controller: str) -> str:
    return f'[[textures]]\ngenerate = "{kind}"\nseconds = 0.6\nrate_hz = 2800\ncontroller = "{controller}"\n'


def planned(folder: Path, **changed: str) -> Plan:
    """Plan a small scene, and read the plan from its file."""
    plan, _ = choose.plan(scene(folder, **changed))
    write_plan(folder / "plan.toml", plan)
    return read_plan(folder / "plan.toml")


@pytest.mark.slow
def test_what_an_emulated_processor_plays_is_what_was_forecast(tmp_path: Path) -> None:
    pytest.importorskip("unicorn")
    played = playing.play(planned(tmp_path))
    rows = {row.figure.key: row for row in comparison.rows(played)}
    assert comparison.failures(played, list(rows.values())) == []
    assert played[0].report.decoded_equals_offline and played[0].report.dac_equals_offline
    for name in ("payload_bps", "wire_bps", "instructions_per_second", "load_percent", "snr_db"):
        assert rows[name].within, name
    assert rows["delay_ms"].measured == pytest.approx(rows["delay_ms"].forecast, rel=0.03)
    assert rows["flash_bytes"].measured is None and rows["flash_bytes"].within is None
    board = playing.play(planned(tmp_path, controller=CONTROLLER.replace("cortex-m4", "stm32f405")))
    (load,) = (row for row in comparison.rows(board) if row.figure.key == "load_percent")
    assert load.within and load.deviation == pytest.approx(0, abs=0.08)


@pytest.mark.slow
def test_controllers_play_one_after_another_and_one_that_fails_holds_no_other_up(tmp_path: Path) -> None:
    plan = planned(tmp_path, texture=texture("wood", "left") + texture("ridges", "right"), controller=TWO, actuator=LRA)
    played = playing.play(plan)
    assert [each.texture.name for each in played] == ["wood", "ridges"]
    rows = comparison.rows(played)
    assert comparison.failures(played, rows) == []
    # A computer's load is not forecast, and so not compared.
    assert "load_percent" not in {row.figure.key for row in rows}
    assert [each.texture.name for each in playing.play(plan, ["ridges"])] == ["ridges"]
    left, right = plan.controllers
    plan = replace(plan, controllers=(left, structs.replace(right, address="serial:/dev/no-such-port")))
    with pytest.raises(playing.PartlyPlayedError, match="right: cannot open") as failed:
        playing.play(plan)
    (first,) = failed.value.played
    assert first.texture.name == "wood" and first.report.dac_equals_offline


@pytest.mark.slow
def test_a_loud_second_is_planned_with_a_capped_rate_and_keeps_the_limit(tmp_path: Path) -> None:
    wood = textures.GENERATORS["wood"](hand_speed_mm_s=60, seconds=5, rate_hz=1600)
    samples = wood.samples.copy()
    samples[3200:4800] *= 2.5
    textures.save(tmp_path / "loud.wav", replace(wood, samples=samples))
    limited = scene(
        tmp_path,
        texture='[[textures]]\nfile = "loud.wav"\n',
        controller='[[controllers]]\nname = "one"\naddress = "sim-usb"\ncore = "M4F"\nclock_hz = 168e6\n',
        asked="[asked]\nsnr_db = 8\nrate_limit_bps = 2000\n",
    )
    plan, (choice,) = choose.plan(limited)
    enough = [each for each in choice.candidates if each.measured.target is None and each.shortfall <= 0]
    assert enough and not any(each.meets for each in enough)
    write_plan(tmp_path / "plan.toml", plan)
    plan = read_plan(tmp_path / "plan.toml")
    (texture,) = plan.textures
    assert texture.capped_rate_bps is not None and texture.forecast.snr_db is not None and texture.forecast.snr_db >= 8
    played = playing.play(plan)
    assert comparison.failures(played, comparison.rows(played)) == []
    assert played[0].report.decoded_equals_offline and played[0].report.dac_equals_offline
    sizes = [len(packet) + added_bytes(packet) for packet in texture.encode().stream.packets]
    run = math.ceil(2 * texture.rate / texture.packet_samples)
    bits_per_second = 8 * np.convolve(sizes, np.ones(run), "valid") / run * texture.rate / texture.packet_samples
    assert len(sizes) > run and np.max(bits_per_second) <= 2000


def test_deviations_from_the_forecast_are_reported_and_written(tmp_path: Path) -> None:
    plan = planned(tmp_path, controller=SIMULATED)
    (wood,) = plan.textures
    wrong = structs.replace(
        wood.forecast, wire_bps=1.2 * wood.forecast.wire_bps, snr_db=(wood.forecast.snr_db or 0) - 0.5
    )
    played = playing.play(replace(plan, textures=(structs.replace(wood, forecast=wrong),)))
    rows = comparison.rows(played)
    assert comparison.failures(played, rows) == ["wood: on the wire deviates by -16.7 % from its forecast"]
    assert sum("OFF" in line for line in comparison.lines(rows)) == 1
    comparison.write_csv(tmp_path / "forecast.csv", rows)
    lines = (tmp_path / "forecast.csv").read_text().splitlines()
    assert lines[0] == "texture,quantity,forecast,measured,deviation,within"
    assert [line for line in lines if line.endswith("False")] == [line for line in lines if "wire_bps" in line]


def test_a_texture_that_is_over_at_once_has_no_delay_to_be_measured(tmp_path: Path) -> None:
    short = texture("wood", "one").replace("0.6", "0.1")
    (played,) = playing.play(planned(tmp_path, texture=short, controller=SIMULATED))
    assert played.measured["delay_ms"] is None and not played.report.lost_anything and played.report.dac_equals_offline
    assert played.measured["wire_bps"] == pytest.approx(played.texture.forecast.wire_bps, rel=1e-5)


def test_a_plan_and_a_live_stream_state_one_delay(tmp_path: Path) -> None:
    plan = planned(tmp_path, controller=SIMULATED)
    (wood,) = plan.textures
    (played,) = playing.play(plan)
    coding = LiveCoding(
        wood.codec, wood.setting, packet_samples=wood.packet_samples, refresh_packets=wood.refresh_packets
    )
    with playing.opened("sim-usb", plan.bench().actuator("one")) as (session, _):
        report = play_live(session, wood.recording(), coding=coding, playout_delay_s=wood.buffer_ms / 1e3).report
    assert report.timing.end_to_end_ms == pytest.approx(played.measured["delay_ms"], abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"codec": "opus", "setting": {}}, "wood is planned for the codec opus, one decodes"),
        ({"packet_samples": 1 << 20}, "needs a buffer of 1048591 samples, and one holds 32768"),
    ],
)
def test_a_plan_for_another_controller_is_rejected(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    pytest.importorskip("unicorn")
    plan = planned(tmp_path)
    with pytest.raises(InputError, match=message):
        playing.play(replace(plan, textures=(structs.replace(plan.textures[0], **change),)))
