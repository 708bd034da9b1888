"""The study file and the stimuli that it asks for: what is rejected, levels at the skin, limits, and what is kept."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import noise
from tests.study.small_study import CODED, REFERENCE, stimuli_of, study_of, text_of
from vibrocast.errors import InputError
from vibrocast.output.actuator import LRA, PIEZO_STACK
from vibrocast.output.rendering import render
from vibrocast.study import stimuli
from vibrocast.study.stimuli import skin_level_db
from vibrocast.study.study_file import METHODS, read_study
from vibrocast.study.trials import Stimulus
from vibrocast.textures import Recording, save

EXAMPLES = Path(__file__).parents[2] / "examples" / "studies"


@pytest.mark.parametrize("method", METHODS)
def test_each_texture_is_coded_under_each_condition(method: str, folder: Path) -> None:
    study = study_of(folder, method)
    made = stimuli_of(method, folder)
    assert len(made) == len(study.textures) * len(study.conditions)
    stream = made[0].stream
    codes, counts = render(
        stream.header, stream.decode_integers(), stream.delay_samples, PIEZO_STACK, loops=made[0].loops
    )
    assert made[0].facts["limited"] == stimuli.limited_part(counts, codes)
    assert made[0].facts["level_db"] == skin_level_db(codes, PIEZO_STACK)
    for texture in study.textures:
        group = [each for each in made if each.texture == texture.name]
        assert np.ptp([each.facts["level_db"] for each in group]) < 0.2, "levels are matched"
        assert len({each.stream.samples * each.loops for each in group}) == 1
    assert stimuli.problems(study, PIEZO_STACK, made) == []


def test_the_metrics_compare_with_the_reference(folder: Path) -> None:
    by_condition = {each.condition: each.facts for each in stimuli_of("degradation", folder)}
    again, fine, coarse = (by_condition[name]["snr_db"] for name in ("recording again", "fine", "coarse"))
    assert again is not None and fine is not None and coarse is not None
    assert again > 55
    assert fine == pytest.approx(20, abs=0.7)
    assert coarse == pytest.approx(6, abs=0.7)


def test_a_level_at_the_threshold_is_0_db() -> None:
    threshold_um = 10 ** (-20 / 20)  # 250 Hz
    time_s = np.arange(8 * LRA.dac_rate_hz) / LRA.dac_rate_hz
    flat = replace(PIEZO_STACK, dac_rate_hz=LRA.dac_rate_hz, corner_hz=3500.0, stroke_um=40.0)
    sine = threshold_um * np.sin(2 * np.pi * 250 * time_s)
    codes = np.rint(sine / flat.excursion_um * flat.full_scale).astype(np.int16)[:, None]
    assert skin_level_db(codes, flat) == pytest.approx(0, abs=0.3)
    assert skin_level_db(10 * codes, flat) == pytest.approx(20, abs=0.3)
    assert skin_level_db(0 * codes, flat) == -math.inf


def test_limits_that_act_unequally_are_rejected_with_a_level_that_fits(folder: Path) -> None:
    path = folder / "loud.toml"
    path.write_text(text_of("degradation").replace("gain_db = -12", "gain_db = 12\nmatch_levels = false"))
    loud = read_study(path)
    made = stimuli.prepare(loud, PIEZO_STACK)
    found = stimuli.problems(loud, PIEZO_STACK, made)
    assert found
    assert "set gain_db = " in found[0].text
    gain_db = min(float(each.text.partition("set gain_db = ")[2]) for each in found if "set gain_db" in each.text)
    path.write_text(path.read_text().replace("gain_db = 12", f"gain_db = {gain_db}"))
    quiet = read_study(path)
    assert not stimuli.problems(quiet, PIEZO_STACK, stimuli.prepare(quiet, PIEZO_STACK))


def test_kept_stimuli_are_the_same_and_changed_ones_are_rejected(folder: Path, tmp_path: Path) -> None:
    made = stimuli_of("mushra", folder)
    kept = tmp_path / "stimuli"
    stimuli.save(kept, made, PIEZO_STACK)
    loaded = stimuli.load(kept, PIEZO_STACK)

    def finite(each: Stimulus) -> dict[str, object]:
        facts = {key: None if value is None or math.isinf(value) else value for key, value in each.facts.items()}
        return {**vars(each), "facts": facts}

    assert list(map(finite, loaded)) == list(map(finite, made))
    with pytest.raises(InputError, match="another actuator"):
        stimuli.load(kept, LRA)
    (kept / "002.vct").write_bytes((kept / "003.vct").read_bytes())
    with pytest.raises(InputError, match=r"002\.vct has changed"):
        stimuli.load(kept)
    (kept / "stimuli.json").write_text(json.dumps({"actuator": asdict(PIEZO_STACK), "stimuli": [{}]}))
    with pytest.raises(InputError, match="not the stimuli"):
        stimuli.load(kept)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('method = "abx"', 'method = "abc"', "method must be one of"),
        ('role = "reference"\n', "", "needs a reference"),
        ('"abx"', '"mushra"', "two anchors"),
        (CODED, "", "nothing is rated"),
        (CODED, CODED + REFERENCE.replace("recording", "other"), "only one can"),
        ('"abx"', '"staircase"', "belong together"),
        (text_of("abx"), text_of("paired_comparison").replace(CODED, ""), "at least 3"),
        ('name = "fine"', 'name = "coarse"', "two [[conditions]] are named"),
        ('codec = "mdct"', 'codec = "mp3"', "there is no codec 'mp3'"),
        ("snr_db = 20", "snr_db = 20\nrate_bps = 100", "both given"),
        ('name = "fine"', 'name = "a/b"', "without / and ="),
        ('surface = "rough"', 'surface = "rough"\nfile = "x.wav"', "file does not go with surface"),
        ('surface = "rough"\nseconds = 0.3', 'file = "missing.wav"', "does not exist"),
        ("hand_speed_mm_s = 50", "", "hand_speed_mm_s is missing"),
        ("[[textures]]", "[hand]\nspeed_mm_s = 40\nplays = true\n[[textures]]", "must be that of [hand], 40"),
        ('name = "fine"', 'name = "fine"\ntextures = ["oak"]', "no [[textures]] is named so; choose of rough, wood"),
        ('role = "reference"', 'role = "reference"\ntextures = ["wood"]', "goes with the role 'condition'"),
        ("seed = 5", "seed = 5\ntextures_per_participant = 3", "and there are 2 [[textures]]; lower it"),
    ],
)
def test_a_wrong_study_file_is_rejected_and_the_examples_are_read(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    assert all(read_study(path).recordings() for path in EXAMPLES.glob("*.toml"))
    text = text_of("abx")
    assert old in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new, 1 if old == "[[textures]]" else -1))
    with pytest.raises(InputError) as error:
        read_study(path).recordings()
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_texture_without_a_unit_is_rejected(tmp_path: Path) -> None:
    save(tmp_path / "plain.wav", Recording(noise(), 2800, "full scale", "plain"))
    path, generated = tmp_path / "study.toml", 'surface = "rough"\nseconds = 0.3\nhand_speed_mm_s = 50'
    path.write_text(text_of("abx").replace(generated, 'file = "plain.wav"'))
    with pytest.raises(ValueError, match="unit"):
        stimuli.prepare(read_study(path), PIEZO_STACK)
