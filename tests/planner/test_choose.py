"""Choosing: the choice meets the targets at the least cost; the error names the limits that cannot be kept."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.planner.scenes import ASKED, CONTROLLER, scene
from vibrocast.codec.source import live_framing
from vibrocast.errors import InputError
from vibrocast.planner.choose import Evaluator, TextureChoice, choose, plan, why_not
from vibrocast.textures import Recording, save


@pytest.fixture(scope="module")
def evaluator(tmp_path_factory: pytest.TempPathFactory) -> Evaluator:
    read = scene(tmp_path_factory.mktemp("scene"))
    return Evaluator(read, read.textures[0])


@pytest.fixture(scope="module")
def choice(evaluator: Evaluator) -> TextureChoice:
    return choose(evaluator)


def test_the_choice_is_the_cheapest_that_meets_the_requirements(choice: TextureChoice) -> None:
    assert choice.chosen.meets and choice.chosen.measured.snr_db is not None
    assert choice.chosen.measured.snr_db >= 10
    assert all(each.cost >= choice.chosen.cost for each in choice.candidates if each.meets)
    assert len({each.measured.option.codec for each in choice.candidates}) >= 4


def test_the_alternatives_are_the_nearest_and_their_reasons_fit_their_costs(
    choice: TextureChoice, evaluator: Evaluator
) -> None:
    asked = evaluator.scene.asked
    why = r"cheapest of (\d+) options that meet SNR 10 dB; the next costs (\d+ % more|about the same)"
    assert re.fullmatch(why, choice.why)
    assert len(choice.alternatives) == 3 and all(each.meets for each in choice.alternatives)
    assert choice.chosen.measured.option not in [each.measured.option for each in choice.alternatives]
    for each in choice.alternatives:
        assert re.fullmatch(r"higher cost \([\d.]+ vs [\d.]+\)", why_not(asked, each, choice.compared))
    missing = min((each for each in choice.candidates if each.shortfall > 0), key=lambda each: each.cost)
    reason = why_not(asked, missing, choice.compared)
    assert reason.startswith("lower cost (") and "misses the target: SNR" in reason


@pytest.mark.slow
def test_a_plan_is_the_same_every_time_and_codes_as_it_forecasts(tmp_path: Path) -> None:
    read = scene(tmp_path)
    (first,), (second,) = plan(read), plan(read)
    assert second.chosen == first.chosen
    stream, forecast = first.encode().stream, first.chosen.forecast
    seconds = len(stream.packets) * stream.packet_samples / first.subject.band.rate
    assert 8 * sum(map(len, stream.packets)) / seconds == pytest.approx(forecast.payload_bps)
    assert first.encode().quality.snr_db == pytest.approx(forecast.snr_db)


def test_weights_decide(evaluator: Evaluator, tmp_path: Path) -> None:
    def chosen(weights: str) -> TextureChoice:
        return choose(evaluator.in_scene(scene(tmp_path, weights="[weights]\n" + weights)))

    nothing_else = "per_kilobyte = 0\nper_million_instructions_per_second = 0\n"
    few_bits = chosen(nothing_else + "per_millisecond = 0\n").chosen.forecast
    quick = chosen(nothing_else + "per_kilobit_per_second = 0\n").chosen.forecast
    assert few_bits.wire_bps < quick.wire_bps and few_bits.delay_ms > quick.delay_ms


def test_only_a_limit_of_the_delay_allows_packets_longer_than_those_of_a_live_stream(
    choice: TextureChoice, evaluator: Evaluator, tmp_path: Path
) -> None:
    usual = live_framing(choice.subject.band.rate).packet_samples
    assert all(each.measured.packet_samples <= usual for each in choice.candidates)
    read = scene(tmp_path, asked=ASKED + "delay_limit_ms = 300\n", weights="[weights]\nper_millisecond = 0\n")
    allowed = choose(evaluator.in_scene(read)).chosen
    assert allowed.measured.packet_samples > usual
    assert allowed.forecast.wire_bps < choice.chosen.forecast.wire_bps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "limit"),
    [
        ({"asked": ASKED + "rate_limit_bps = 900\n"}, "[asked] rate_limit_bps"),
        ({"asked": ASKED + "delay_limit_ms = 20\n"}, "[asked] delay_limit_ms"),
        ({"controller": CONTROLLER + "ram_bytes = 60_000\n"}, "[[controllers]] one: ram_bytes"),
        ({"controller": CONTROLLER + "flash_bytes = 50_000\n"}, "[[controllers]] one: flash_bytes"),
        ({"controller": CONTROLLER + "clock_hz = 1_000_000\n"}, "[[controllers]] one: clock_hz"),
        ({"link": "[link]\nbytes_per_second = 120\n"}, "[link] bytes_per_second"),
    ],
)
def test_an_impossible_scene_names_the_limit_and_a_value_that_works(
    changed: dict[str, str], limit: str, evaluator: Evaluator, tmp_path: Path
) -> None:
    read = scene(tmp_path, **changed)
    with pytest.raises(InputError) as raised:
        choose(evaluator.in_scene(read))
    named = re.search(
        rf"with {re.escape(limit)} = [\d.e+]+; .* needs {limit.split()[-1]} = ([\d.e+]+); ", str(raised.value)
    )
    assert named is not None, str(raised.value)
    value = float(named[1])
    given: dict[str, Any] = {limit.split()[-1]: value}
    if limit.startswith("[asked]"):
        mended = replace(read, asked=structs.replace(read.asked, **given))
    elif limit.startswith("[link]"):
        mended = replace(read, link=replace(read.link, bytes_per_second=value))
    else:
        mended = replace(read, controllers=(structs.replace(read.controllers[0], **given),))
    assert choose(evaluator.in_scene(mended)).chosen.meets


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"asked": "[asked]\nsnr_db = 89\n"},
            r"wood: no codec reaches SNR 89 dB; the best within all limits is SNR ([\d.]+) dB \(.*\); lower snr_db to ",
        ),
        (
            {"controller": CONTROLLER + "flash_bytes = 20_000\n", "asked": ASKED + "rate_limit_bps = 100\n"},
            r"with \[asked\] rate_limit_bps = 100 and \[\[controllers\]\] one: flash_bytes = 20000; .* needs .*; "
            r"no setting keeps all limits; raise the limits to these values$",
        ),
    ],
)
def test_an_impossible_scene_says_how_near_it_comes(
    changed: dict[str, str], message: str, evaluator: Evaluator, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        choose(evaluator.in_scene(scene(tmp_path, **changed)))


@pytest.mark.slow
@pytest.mark.parametrize("rate_limit_bps", [1500, 4000])
def test_the_quality_that_the_error_offers_can_be_planned(rate_limit_bps: int, tmp_path: Path) -> None:
    read = scene(tmp_path, asked=f"[asked]\nsnr_db = 30\n{rate_limit_bps = }\n")
    evaluator = Evaluator(read, read.textures[0])
    with pytest.raises(InputError, match=r"or lower snr_db to [\d.]+$") as raised:
        choose(evaluator.in_scene(read))
    lower = float(str(raised.value).split()[-1])
    assert choose(evaluator.in_scene(replace(read, asked=structs.replace(read.asked, snr_db=lower)))).chosen.meets


@pytest.mark.slow
def test_a_texture_may_be_coded_for_touch_where_the_required_quality_gains(tmp_path: Path) -> None:
    for asked, touches in (
        ("imperceptible = true", {0, 1}),
        ("spqi = 0.5", {0, 0.25, 1}),
        ("snr_db = 10", {0}),
    ):
        read = scene(tmp_path, asked=f"[asked]\n{asked}\n")
        evaluator = Evaluator(read, read.textures[0])
        options = evaluator.options()
        if asked == "imperceptible = true":
            error_db = choose(evaluator.in_scene(read)).chosen.forecast.error_over_threshold_db
            assert error_db is not None and error_db <= -8
        assert {option.touch for option in options} == touches
        for option in options:
            assert (option.touch > 0) == (", touch " in option.name)
            if option.touch:
                assert all(setting["shape"] != "flat" for _, setting in evaluator.settings(option))


def test_a_texture_that_nobody_can_feel_is_an_error(tmp_path: Path) -> None:
    save(tmp_path / "weak.wav", Recording(np.random.default_rng(0).normal(size=(2800, 1)), 2800, "full scale", ""))
    read = scene(tmp_path, texture='[[textures]]\nfile = "weak.wav"\nunit = "nm"\nfull_scale = 0.001\n')
    with pytest.raises(InputError, match="weak: no part of it can be felt: at best, the texture lies"):
        plan(read)


@pytest.mark.slow
def test_a_profile_is_planned_over_position(tmp_path: Path) -> None:
    heights = "".join(f"{10 * place},{3 * np.sin(place / 8):.3f}\n" for place in range(4000))
    (tmp_path / "profile.csv").write_text("position_um,height_um\n" + heights)
    read = scene(
        tmp_path,
        texture='[[textures]]\nfile = "profile.csv"\n',
        hand="[hand]\nspeed_mm_s = [0, 300]\n",
        controller=CONTROLLER + "reads_position = true\n",
    )
    (planned,) = plan(read)
    assert planned.subject.over_position and planned.chosen.buffer_ms == 0
    assert planned.encode().stream.header.unit == "um over position"
    assert planned.chosen.forecast.delay_ms < 50
