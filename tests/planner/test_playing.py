"""What was planned plays as it was forecast; misfits and deviations from the forecast are reported."""

from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from tests.planner.scenes import CONTROLLER, scene
from vibrocast.errors import VibrocastError
from vibrocast.host.live import LiveCoding
from vibrocast.host.live_playback import play_live
from vibrocast.planner import choose, playing
from vibrocast.planner.playing import Played

SIMULATED = CONTROLLER.replace("cortex-m4", "sim-usb")
TWO = (
    '[[controllers]]\nname = "left"\naddress = "sim"\n[[controllers]]\nname = "right"\naddress = "sim-usb"\n'
    '[[actuators]]\nmodel = "piezo-stack"\ncontroller = "left"\n'
)
LRA = '[[actuators]]\nmodel = "lra"\ncontroller = "right"\n'


def texture(kind: str, controller: str) -> str:
    return f'[[textures]]\ngenerate = "{kind}"\nseconds = 0.6\nrate_hz = 2800\ncontroller = "{controller}"\n'


def played(folder: Path, **changed: str) -> list[Played]:
    """Plan a small scene, and play it."""
    read = scene(folder, **changed)
    return playing.play(read, choose.plan(read))


@pytest.mark.slow
def test_what_an_emulated_processor_plays_is_what_was_forecast(tmp_path: Path) -> None:
    pytest.importorskip("unicorn")
    (wood,) = played(tmp_path)
    rows = {row.figure.key: row for row in wood.rows()}
    assert not list(wood.failures())
    assert wood.report.decoded_equals_offline and wood.report.dac_equals_offline
    for name in ("payload_bps", "wire_bps", "instructions_per_second", "load_percent", "snr_db"):
        assert rows[name].within, name
    assert rows["delay_ms"].measured == pytest.approx(rows["delay_ms"].forecast, rel=0.03)
    assert rows["flash_bytes"].measured is None and rows["flash_bytes"].within is None
    (board,) = played(tmp_path, controller=CONTROLLER.replace("cortex-m4", "stm32f405"))
    (load,) = (row for row in board.rows() if row.figure.key == "load_percent")
    assert load.within and load.deviation == pytest.approx(0, abs=0.08)


@pytest.mark.slow
def test_controllers_play_one_after_another_and_one_that_fails_is_named(tmp_path: Path) -> None:
    read = scene(tmp_path, texture=texture("wood", "left") + texture("ridges", "right"), controller=TWO, actuator=LRA)
    choices = choose.plan(read)
    told: list[float] = []
    both = playing.play(read, choices, lambda part, _: told.append(part))
    assert [each.choice.name for each in both] == ["wood", "ridges"]
    assert told == sorted(told) and told[-1] == pytest.approx(1, abs=0.2)
    assert not [failure for each in both for failure in each.failures()]
    # A computer's load is not forecast, and so not compared.
    assert "load_percent" not in {row.figure.key for each in both for row in each.rows()}
    left, right = read.controllers
    broken = replace(read, controllers=(left, structs.replace(right, address="serial:/dev/no-such-port")))
    with pytest.raises(VibrocastError, match="cannot open serial port /dev/no-such-port"):
        playing.play(broken, choices)


def test_deviations_from_the_forecast_are_reported(tmp_path: Path) -> None:
    (wood,) = played(tmp_path, controller=SIMULATED)
    right = wood.choice.chosen.forecast
    wrong = replace(right, wire_bps=1.2 * right.wire_bps, snr_db=(right.snr_db or 0) - 0.5)
    wood = replace(wood, choice=replace(wood.choice, chosen=replace(wood.choice.chosen, forecast=wrong)))
    assert list(wood.failures()) == ["wood: on the wire deviates by -16.7 % from its forecast"]
    assert sum("OFF" in row.line() for row in wood.rows()) == 1


def test_a_texture_that_is_over_at_once_has_no_delay_to_be_measured(tmp_path: Path) -> None:
    short = texture("wood", "one").replace("0.6", "0.1")
    (wood,) = played(tmp_path, texture=short, controller=SIMULATED)
    assert wood.measured["delay_ms"] is None and not wood.report.lost_anything and wood.report.dac_equals_offline
    assert wood.measured["wire_bps"] == pytest.approx(wood.choice.chosen.forecast.wire_bps, rel=1e-5)


def test_a_plan_and_a_live_stream_state_one_delay(tmp_path: Path) -> None:
    (wood,) = played(tmp_path, controller=SIMULATED)
    chosen = wood.choice.chosen.measured
    coding = LiveCoding(
        chosen.option.codec,
        chosen.setting,
        packet_samples=chosen.packet_samples,
        refresh_packets=chosen.refresh_packets,
    )
    with playing.opened("sim-usb", wood.choice.subject.actuator) as (session, _):
        playout_delay_s = wood.choice.chosen.buffer_ms / 1e3
        live = play_live(session, wood.choice.subject.whole, coding=coding, playout_delay_s=playout_delay_s)
    assert live.report.timing.end_to_end_ms == pytest.approx(wood.measured["delay_ms"], abs=0.1)
