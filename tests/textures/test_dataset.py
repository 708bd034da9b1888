"""Tests of a folder as single traces: what is a trace, and the seeded split."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast import textures
from vibrocast.textures import TextureError
from vibrocast.textures.dataset import DatasetError, Trace, load, split, traces
from vibrocast.textures.generate import wood

REFERENCE = [
    f"Direct_-_{tool}_-_{material}_-_{speed}"
    for tool in ("1spike_Probe", "3x3_Probe", "1x4_Probe", "3x1_Probe", "big_Probe", "small_Probe", "finger")
    for material in ("polyesterPad", "Paper", "Foam", "cork", "felt", "rubber", "aluminumGrid", "kitchenSponge")
    for speed in ("slow", "slower", "medium", "fast", "faster")
]

names = st.builds("Direct_-_probe_-_{}_-_{}".format, st.sampled_from("abcdefg"), st.integers(0, 10**6))


def named(wanted: list[str]) -> list[Trace]:
    return [Trace(name, Path(name)) for name in sorted(wanted)]


def write_axes(folder: Path, trace: str, axes: str) -> None:
    samples = np.random.default_rng(0).normal(size=200)
    for number, axis in enumerate(axes):
        np.savetxt(folder / f"{trace}_{axis}.txt", samples * (number + 1))


def test_every_kind_of_file_is_a_trace_and_three_axes_are_one(tmp_path: Path) -> None:
    textures.save(tmp_path / "wood.wav", wood(0, 0.1))
    np.save(tmp_path / "wood.npy", np.zeros(10))
    write_axes(tmp_path, REFERENCE[0], "XYZ")
    write_axes(tmp_path, REFERENCE[1], "Z")
    for other in ("notes.md", ".hidden.wav", "sound.mp3"):
        (tmp_path / other).touch()
    (tmp_path / "deeper").mkdir()
    found = traces(tmp_path)
    assert [trace.name for trace in found] == sorted(["wood.npy", "wood.wav", REFERENCE[0], f"{REFERENCE[1]}_Z"])
    together, single = (next(each for each in found if each.name.startswith(name)) for name in REFERENCE[:2])
    assert load(together, unit="m/s^2").rate_hz == 2800
    x, z = (load(trace, unit="m/s^2", axis=axis) for trace, axis in ((together, "X"), (single, None)))
    np.testing.assert_allclose(x.samples, z.samples)
    assert together.material == single.material == "polyesterpad"


def test_a_hand_speed_is_for_profiles_and_the_rate_becomes_whole(tmp_path: Path) -> None:
    textures.save(tmp_path / "wood.wav", wood(0, 0.1))
    textures.save_profile(tmp_path / "profile.csv", textures.surface_profile("grating", seconds=0.1, rate_hz=3000))
    profile, recording = traces(tmp_path)
    assert load(recording, hand_speed_mm_s=50).rate_hz == 2800
    with pytest.raises(TextureError, match="`stream_rate_hz`"):
        load(profile, hand_speed_mm_s=33.3)
    resampled = load(profile, stream_rate_hz=2800, hand_speed_mm_s=33.3)
    assert (resampled.rate_hz, resampled.unit) == (2800, "um")


def test_a_name_that_is_no_text_is_escaped(tmp_path: Path) -> None:
    try:
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.csv")).write_text("# rate_hz: 2800\n# unit: um\n1\n2\n")
    except OSError:
        pytest.skip("this file system has no such names")
    (trace,) = traces(tmp_path)
    assert trace.name == "\\udcff"
    assert load(trace).rate_hz == 2800


def test_folders_without_recordings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        traces(tmp_path / "missing")
    with pytest.raises(DatasetError, match="no recordings"):
        traces(tmp_path)
    (tmp_path / "picture.png").touch()
    (tmp_path / "folder.wav").mkdir()
    with pytest.raises(DatasetError, match="no recordings"):
        traces(tmp_path)


def test_the_reference_set_is_split_into_224_and_56() -> None:
    everything = named(REFERENCE)
    train, test = split(everything, "train"), split(everything, "test")
    assert (len(train), len(test)) == (224, 56)
    assert sorted([*train, *test], key=lambda trace: trace.name) == everything
    assert split(everything, "all") == everything
    assert split(everything, "test", seed=1) != test


def test_the_split_is_the_same_everywhere() -> None:
    everything = named([f"trace {number}" for number in range(10)])
    assert [trace.name for trace in split(everything, "test", seed=7)] == ["trace 2", "trace 3"]


def test_the_split_by_material_of_the_reference_set() -> None:
    everything = named(REFERENCE)
    test = split(everything, "test", by_material=True)
    assert len(test) == 70  # 8 materials of 35 traces: two are nearer to 56 than one
    assert len({trace.material for trace in test}) == 2
    assert len({frozenset(t.material for t in split(everything, "test", seed, True)) for seed in range(20)}) > 5


@given(st.lists(names, min_size=2, unique=True), st.integers(0, 5), st.booleans())
def test_the_parts_share_nothing_and_make_the_whole(wanted: list[str], seed: int, by_material: bool) -> None:
    everything = named(wanted)
    materials = {trace.material for trace in everything}
    if by_material and len(materials) == 1:
        with pytest.raises(DatasetError, match="only one material"):
            split(everything, "test", seed, by_material)
        return
    train, test = (split(everything, part, seed, by_material) for part in ("train", "test"))
    assert train and test
    assert not {trace.name for trace in train} & {trace.name for trace in test}
    assert len(train) + len(test) == len(everything)
    if by_material:
        assert not {trace.material for trace in train} & {trace.material for trace in test}
    else:
        assert len(test) == max(1, round(len(everything) / 5))


def test_what_cannot_be_split_is_refused() -> None:
    with pytest.raises(DatasetError, match="only one trace"):
        split(named(["single"]), "test")
    with pytest.raises(DatasetError, match="first: its name does not state the material"):
        split(named(["first", "second"]), "train", by_material=True)
