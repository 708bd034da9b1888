"""The scene file: its content, and every mistake reported with its table and key."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.planner.scenes import ACTUATOR, ASKED, CONTROLLER, TEXTURE, scene, written
from vibrocast.codec.threshold import sites
from vibrocast.errors import InputError
from vibrocast.planner.choose import Evaluator
from vibrocast.planner.scene import read_scene
from vibrocast.textures import Recording, save


def test_a_scene_is_read(tmp_path: Path) -> None:
    read = scene(tmp_path, hand="[hand]\nspeed_mm_s = [20, 80]\n", link='[link]\nkind = "serial"\n')
    (texture,) = read.textures
    assert texture.name == "wood" and isinstance(texture.loaded, Recording)
    assert read.hand_speed_mm_s == (20.0, 80.0)
    assert read.controllers[0].core == "M4F" and read.controllers[0].clock_hz == 168e6
    assert read.link.bytes_per_second == 92160.0
    assert read.asked.measure == "snr_db" and read.asked.waveform
    assert read.actuator(texture).name == "piezo-stack"


def test_a_folder_is_a_texture_for_each_recording_and_a_list_is_played_together(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name, seconds in (("a", 0.2), ("b", 0.3)):
        noise = np.random.default_rng(1).normal(size=(round(2800 * seconds), 1))
        save(folder / f"{name}.wav", Recording(noise, 2800, "m/s^2", name))
    read = scene(tmp_path, texture='[[textures]]\nfile = "recordings"\n')
    assert [texture.name for texture in read.textures] == ["a", "b"]
    (both,) = scene(tmp_path, texture='[[textures]]\nfile = ["recordings/a.wav", "recordings/b.wav"]\n').textures
    assert both.channels == 2 and isinstance(both.loaded, Recording)
    assert both.loaded.samples.shape == (840, 2) and not both.loaded.samples[560:, 0].any()
    save(tmp_path / "axes.csv", Recording(np.ones((900, 3)), 2800, "um", "axes", ("X", "Y", "Z")))
    axes = '[[textures]]\nfile = "axes.csv"\n'
    with pytest.raises(InputError, match=r"three axes of one texture; pass `reduce`"):
        scene(tmp_path, texture=axes)
    assert scene(tmp_path, texture=axes + 'reduce = "norm"\n').textures[0].channels == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"texture": '[[textures]]\nfile = "none.wav"\n'}, "[[textures]] 1: file "),
        ({"texture": "[[textures]]\n"}, "give either file or generate"),
        ({"texture": TEXTURE + 'file = "a.wav"\n'}, "give either file or generate"),
        ({"texture": '[[textures]]\nfile = "scene.toml"\n'}, "[[textures]] 1: "),
        ({"hand": "[hand]\nspeed_mm_s = 0.05\n"}, "speed_mm_s = 0.05 is out of range: speed of the hand in mm/s"),
        ({"hand": "[hand]\nspeed_mm_s = [80, 20]\n"}, "the lowest speed, 80, is above the highest, 20; swap them"),
        ({"hand": "[hand]\nspeed_mm_s = [1, 2, 3]\n"}, "speed_mm_s must be a speed in mm/s, or the lowest and"),
        ({"controller": CONTROLLER.replace("cortex-m4", "elsewhere")}, "address must be an address: sim, "),
        ({"controller": CONTROLLER + 'core = "Z80"\n'}, "core must be one of M4F, M7, M33, not 'Z80'"),
        ({"controller": CONTROLLER.replace("cortex-m4", "serial:/dev/ttyX")}, "channels is missing; it must be"),
        (
            {"controller": CONTROLLER.replace("cortex-m4", "serial:/dev/ttyX") + 'channels = 1\ncore = "M7"\n'},
            "core M7 needs its clock_hz",
        ),
        ({"controller": CONTROLLER.replace("cortex-m4", "sim") + "clock_hz = 1e8\n"}, "clock_hz needs a core"),
        (
            {"actuator": ACTUATOR.replace("piezo-stack", "lra")},
            "cortex-m4 drives piezo-stack, compiled in: ",
        ),
        ({"actuator": ACTUATOR + "channel = 9\n"}, "channel 9, but one has 4 channels"),
        ({"actuator": ACTUATOR + "channel = 2\n"}, "wood needs an actuator on channel 1 of one, and"),
        ({"asked": "[asked]\n"}, "[asked]: no quality is given; give one of snr_db"),
        ({"asked": ASKED + "imperceptible = true\n"}, "snr_db and imperceptible are given; give one of"),
        ({"asked": ASKED + "waveform = false\n"}, "waveform = false contradicts snr_db, which parametric coding"),
        ({"skin": '[skin]\nthreshold = "none.csv"\n'}, "cannot be read as a detection threshold"),
        (
            {"weights": "[weights]\n" + "".join(f"{key} = 0\n" for key in (
                "per_kilobit_per_second", "per_million_instructions_per_second", "per_kilobyte", "per_millisecond",
            ))},
            "all weights are 0",
        ),
        ({"more": "[sound]\n"}, "there is no key sound; choose from textures"),
    ],
)  # fmt: skip
def test_a_mistake_is_reported_with_its_place(changed: dict[str, str], message: str, tmp_path: Path) -> None:
    path = written(tmp_path, **changed)
    with pytest.raises(InputError) as raised:
        read_scene(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)


def test_a_scene_names_a_threshold_that_ships_or_a_file_of_its_folder(tmp_path: Path) -> None:
    for name, path in sites().items():
        assert scene(tmp_path, skin=f'[skin]\nthreshold = "{name}"\n').threshold_path == path
    (tmp_path / "own.csv").write_text("frequency_hz,threshold_db_re_1um_peak\n1,0\n")
    assert scene(tmp_path, skin='[skin]\nthreshold = "own.csv"\n').threshold_path == tmp_path / "own.csv"


def test_a_profile_over_a_range_of_speeds_needs_a_controller_that_knows_the_hand(tmp_path: Path) -> None:
    profile = "position_um,height_um\n" + "".join(f"{10 * place},{place % 7}\n" for place in range(100))
    (tmp_path / "profile.csv").write_text(profile)
    changed = {"texture": '[[textures]]\nfile = "profile.csv"\n', "hand": "[hand]\nspeed_mm_s = [0, 300]\n"}
    with pytest.raises(InputError, match="profile is a height profile, and the hand moves at 0 to 300 mm/s"):
        scene(tmp_path, **changed)
    knows_hand = CONTROLLER + "reads_position = true\n"
    with pytest.raises(InputError, match="rendered by the hand's position up to 300 mm/s"):
        scene(tmp_path, **{**changed, "hand": "[hand]\nspeed_mm_s = [0, 500]\n"}, controller=knows_hand)
    knows = scene(tmp_path, **changed, controller=knows_hand)
    assert knows.textures[0].channels == 1


PLACES = {
    "speed_mm_s": ("hand", "[hand]\n", ""),
    "clock_hz": ("controller", CONTROLLER, ""),
    "channels": ("controller", CONTROLLER, ""),
    "snr_db": ("asked", "[asked]\n", ""),
    "delay_ms": ("link", "[link]\n", ""),
    "bytes_per_second": ("link", "[link]\n", ""),
    "file": ("texture", "[[textures]]\n", ""),
    "weights": ("texture", "", TEXTURE),
}
_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("ab"), inner, max_size=2),
    max_leaves=4,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(
    key=st.sampled_from(list(PLACES)),
    value=_VALUES,
)
def test_no_value_makes_anything_but_a_scene_or_an_error(key: str, value: object, tmp_path: Path) -> None:
    part, before, after = PLACES[key]
    try:
        read = read_scene(written(tmp_path, **{part: f"{before}{key} = {json.dumps(value)}\n{after}"}))
    except InputError:
        return
    assert read.textures


def test_an_offset_changes_no_plan_but_of_a_drive_signal(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).normal(size=(2800, 1))
    workbenches = []
    for number, ends in enumerate(((0.0, 0.0), (9.81, 9.81), (-2.0, 3.0))):
        added = np.linspace(*ends, 2800)[:, None]
        save(tmp_path / f"{number}.wav", Recording(noise + added, 2800, "m/s^2", "noise"))
        read = scene(tmp_path, texture=f'[[textures]]\nname = "noise"\nfile = "{number}.wav"\n')
        workbenches.append(Evaluator(read, read.textures[0]).subject)
    still = workbenches[0]
    for moved in workbenches[1:]:
        assert (moved.band.lowest, moved.band.highest, moved.band.rate) == (
            still.band.lowest,
            still.band.highest,
            still.band.rate,
        )
        np.testing.assert_allclose(moved.whole.samples, still.whole.samples, atol=1e-5)
    np.save(tmp_path / "drive.npy", 0.1 * noise + 0.5)
    (drive,) = scene(tmp_path, texture='[[textures]]\nfile = "drive.npy"\nunit = "drive"\nrate_hz = 2800\n').textures
    assert isinstance(drive.loaded, Recording) and np.mean(drive.loaded.samples) == pytest.approx(0.5, abs=0.02)
