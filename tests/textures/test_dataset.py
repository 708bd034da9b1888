"""Tests of a folder as single entries: what is an entry, and the seeded split."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast import textures
from vibrocast.errors import InputError
from vibrocast.textures import TextureError
from vibrocast.textures.dataset import DatasetEntry, entries, load, read, split
from vibrocast.textures.generate import wood

REFERENCE = [
    f"Direct_-_{tool}_-_{material}_-_{speed}"
    for tool in ("1spike_Probe", "3x3_Probe", "1x4_Probe", "3x1_Probe", "big_Probe", "small_Probe", "finger")
    for material in ("polyesterPad", "Paper", "Foam", "cork", "felt", "rubber", "aluminumGrid", "kitchenSponge")
    for speed in ("slow", "slower", "medium", "fast", "faster")
]

names = st.builds("Direct_-_probe_-_{}_-_{}".format, st.sampled_from("abcdefg"), st.integers(0, 10**6))


def named(wanted: list[str]) -> list[DatasetEntry]:
    return [DatasetEntry(name, Path(name)) for name in sorted(wanted)]


def write_axes(folder: Path, entry: str, axes: str) -> None:
    samples = np.random.default_rng(0).normal(size=200)
    for number, axis in enumerate(axes):
        np.savetxt(folder / f"{entry}_{axis}.txt", samples * (number + 1))


def test_every_kind_of_file_is_a_recording_and_three_axes_are_one(tmp_path: Path) -> None:
    textures.save(tmp_path / "wood.wav", wood(0, 0.1))
    np.save(tmp_path / "wood.npy", np.zeros(10))
    write_axes(tmp_path, REFERENCE[0], "XYZ")
    write_axes(tmp_path, REFERENCE[1], "Z")
    for other in ("notes.md", ".hidden.wav", "sound.mp3"):
        (tmp_path / other).touch()
    (tmp_path / "deeper" / ".cache").mkdir(parents=True)
    textures.save(tmp_path / "deeper" / "wood.wav", wood(1, 0.1))
    textures.save(tmp_path / "deeper" / ".cache" / "wood.wav", wood(1, 0.1))
    (tmp_path / "manifest.csv").write_text("file\nwood.wav\n")
    found, skipped = read(tmp_path).entries, read(tmp_path).skipped
    assert [entry.name for entry in found] == sorted(
        ["deeper/wood", "wood.npy", "wood.wav", REFERENCE[0], f"{REFERENCE[1]}_Z"]
    )
    assert [each.file for each in skipped] == ["manifest.csv", "notes.md", "sound.mp3"]
    assert "manifest" in skipped[0].reason
    assert "skipped 3 files: manifest.csv" in read(tmp_path).remarks[0]
    assert "deeper/wood" not in [entry.name for entry in read(tmp_path, tmp_path / "deeper").entries]
    together, single = (next(each for each in found if each.name.startswith(name)) for name in REFERENCE[:2])
    assert load(together, unit="m/s^2").rate_hz == 2800
    x, z = (load(entry, unit="m/s^2", columns=columns) for entry, columns in ((together, "x"), (single, None)))
    np.testing.assert_allclose(x.samples, z.samples)
    assert together.material == single.material == "polyesterpad"


def test_a_hand_speed_is_for_profiles_and_the_rate_becomes_whole(tmp_path: Path) -> None:
    textures.save(tmp_path / "wood.wav", wood(0, 0.1))
    textures.save_profile(tmp_path / "profile.csv", textures.surface_profile("grating", seconds=0.1, rate_hz=3000))
    profile, recording = entries(tmp_path)
    assert load(recording, hand_speed_mm_s=50).rate_hz == 2800
    with pytest.raises(TextureError, match="`stream_rate_hz`"):
        load(profile, hand_speed_mm_s=33.33)
    resampled = load(profile, stream_rate_hz=2800, hand_speed_mm_s=33.33)
    assert (resampled.rate_hz, resampled.unit) == (2800, "um")


def test_text_without_numbers_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "wood.csv").write_text("# rate_hz: 100\nx_um\n1\n2\n")
    (tmp_path / "README.txt").write_text("Recorded on a desk.\n\nRates in Hz:\n3200\nSensor 2 was off.\n")
    (tmp_path / "LICENSE.txt").write_text("See the web.\n")
    (tmp_path / "subjects.csv").write_text("subject,material\nA,oak\nB,cork\n")
    (tmp_path / "empty.csv").touch()
    found = read(tmp_path)
    assert [entry.name for entry in found.entries] == ["wood"]
    assert {skipped.file: skipped.reason for skipped in found.skipped} == dict.fromkeys(
        ("LICENSE.txt", "README.txt", "empty.csv", "subjects.csv"), "text without numbers"
    )


def test_folders_without_recordings_and_other_files_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        entries(tmp_path / "missing")
    with pytest.raises(InputError, match="no recordings"):
        entries(tmp_path)
    (tmp_path / "picture.png").touch()
    (tmp_path / "folder.wav").mkdir()
    with pytest.raises(InputError, match="no recordings"):
        entries(tmp_path)
    with pytest.raises(InputError, match="neither a folder nor a manifest"):
        read(tmp_path / "picture.png")


def test_the_reference_set_is_split_into_224_and_56() -> None:
    everything = named(REFERENCE)
    train, test = split(everything, "train"), split(everything, "test")
    assert (len(train), len(test)) == (224, 56)
    assert sorted([*train, *test], key=lambda entry: entry.name) == everything
    assert split(everything, "all") == everything
    assert split(everything, "test", seed=1) != test
    test = split(everything, "test", by="material")
    assert len(test) == 70  # 8 materials of 35 traces: two are nearer to 56 than one
    assert len({entry.material for entry in test}) == 2


def test_the_split_is_the_same_everywhere() -> None:
    everything = named([f"trace {number}" for number in range(10)])
    assert [entry.name for entry in split(everything, "test", seed=7)] == ["trace 2", "trace 3"]


@given(st.lists(names, min_size=2, unique=True), st.integers(0, 5), st.booleans())
def test_the_parts_share_nothing_and_make_the_whole(wanted: list[str], seed: int, by_material: bool) -> None:
    everything = named(wanted)
    materials = {entry.material for entry in everything}
    by = "material" if by_material else "recording"
    if by_material and len(materials) == 1:
        with pytest.raises(InputError, match="only one material"):
            split(everything, "test", seed, by)
        return
    train, test = (split(everything, part, seed, by) for part in ("train", "test"))
    assert train and test
    assert not {entry.name for entry in train} & {entry.name for entry in test}
    assert len(train) + len(test) == len(everything)
    if by_material:
        assert not {entry.material for entry in train} & {entry.material for entry in test}
    else:
        assert len(test) == max(1, round(len(everything) / 5))


def test_what_cannot_be_split_is_rejected() -> None:
    with pytest.raises(InputError, match="only one recording"):
        split(named(["single"]), "test")
    with pytest.raises(InputError, match="first: its name does not state the material"):
        split(named(["first", "second"]), "train", by="material")


def test_options_are_for_the_files_that_leave_them_open(tmp_path: Path) -> None:
    """One folder of every kind: what a file states goes before an option, and the others get it."""
    plain = textures.Recording(wood(0, 0.1, rate_hz=8000).samples, 8000.0, "full scale", "plain")
    textures.save(tmp_path / "plain.wav", plain)
    textures.save(tmp_path / "stated.wav", wood(0, 0.1))
    (tmp_path / "stated.csv").write_text("time_s,x_g\n0,1\n0.001,2\n0.002,1\n")
    write_axes(tmp_path, REFERENCE[0], "XYZ")
    write_axes(tmp_path, REFERENCE[1], "X")
    np.save(tmp_path / "bare.npy", np.ones(20))
    textures.save_profile(tmp_path / "profile.csv", textures.surface_profile("grating", seconds=0.1, rate_hz=3000))
    found = {entry.name: entry for entry in entries(tmp_path)}
    options: dict[str, Any] = {"rate_hz": 1560.0, "unit": "um", "columns": "z", "key": "samples", "hand_speed_mm_s": 50}
    loaded = {name: load(entry, **options) for name, entry in found.items()}
    assert {name: (recording.rate_hz, recording.unit) for name, recording in loaded.items()} == {
        "plain": (8000, "full scale"),
        "stated.wav": (2800, "m/s^2"),
        "stated.csv": (1000, "m/s^2"),
        REFERENCE[0]: (2800, "um"),
        f"{REFERENCE[1]}_X": (2800, "um"),
        "bare": (1560, "um"),
        "profile": (3000, "um"),
    }
    z = textures.load(tmp_path / f"{REFERENCE[0]}_Z.txt", unit="um")
    np.testing.assert_array_equal(loaded[REFERENCE[0]].samples, z.samples)
    scaled = load(found["plain"], unit="um", full_scale=20)
    np.testing.assert_allclose(scaled.samples, 20 * load(found["plain"]).samples)
    assert load(found["bare"], rate_hz=100).unit == "full scale"
    with pytest.raises(TextureError, match="does not state its sample rate"):
        load(found["bare"], unit="um")


def manifest(folder: Path, text: str) -> Path:
    (folder / "manifest.csv").write_text(text)
    return folder / "manifest.csv"


def test_a_manifest_states_what_files_do_not(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    textures.save(tmp_path / "deep" / "a.wav", textures.Recording(np.ones((9, 1)) / 2, 2800.0, "full scale", "a"))
    np.savez(tmp_path / "b.npz", left=np.ones(9), right=2 * np.ones(9))
    write_axes(tmp_path, REFERENCE[0], "XYZ")
    path = manifest(
        tmp_path,
        "file,unit,rate_hz,full_scale,columns,key,material,subject,kind\n"
        "deep/a.wav,m/s^2,,8,,,Cork,anna,tool\n"
        "b.npz,um,1000,,,left,felt,ben,\n"
        "b.npz,um,1000,,,right,felt,ben,\n"
        f"{REFERENCE[0]},g,,,X,,,,\n",
    )
    found = read(path)
    assert found.notes and "columns not used: kind" in found.notes[0] and not found.skipped
    by_name = {entry.name: entry for entry in found.entries}
    assert list(by_name) == sorted(["deep/a", "b:left", "b:right", f"{REFERENCE[0]}_X"])
    recordings = {name: load(entry, unit="mm", rate_hz=500) for name, entry in by_name.items()}
    assert recordings["deep/a"].samples[0, 0] == pytest.approx(4) and recordings["deep/a"].unit == "m/s^2"
    assert recordings["b:right"].samples[0, 0] == 2 and recordings["b:right"].rate_hz == 1000
    assert recordings[f"{REFERENCE[0]}_X"].unit == "m/s^2"
    assert (by_name["deep/a"].material, by_name["deep/a"].subject) == ("cork", "anna")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name\na.wav\n", "no column file; a manifest is"),
        ("file,unit,unit\na.wav,um,um\n", "two columns 'unit'"),
        ("file\n", "lists no recordings"),
        ("file,unit\na.wav\n", "row 2: not one value for each of the 2 columns"),
        ("file,unit\n,um\n", "row 2, file: empty"),
        ("file\na.wav\nb.wav\n\nc.wav\n", "row 3, file: b.wav does not exist, nor do those of 1 other rows"),
        ("file,unit\na.wav,furlong\n", "row 2, unit: unknown unit 'furlong'"),
        ("file,rate_hz\na.wav,fast\n", "row 2, rate_hz: 'fast' is no positive number"),
        ("file,reduce\na.wav,w\n", "row 2, reduce: 'w' is none of dft321"),
        ("file,split\na.wav,validation\n", "row 2, split: 'validation' is neither train nor test"),
        ("file\na.wav\na.wav\n", "is in several rows"),
        ('file\n"a.wav\n', "not a CSV file in UTF-8"),
    ],
)
def test_a_wrong_manifest_is_rejected_by_row_and_column(tmp_path: Path, text: str, message: str) -> None:
    textures.save(tmp_path / "a.wav", wood(0, 0.1))
    with pytest.raises(InputError, match=message):
        read(manifest(tmp_path, text))


def stated(*rows: tuple[str, str, str, str]) -> list[DatasetEntry]:
    return [DatasetEntry(name, Path(name), {}, material, subject, part) for name, material, subject, part in rows]


def test_the_split_of_a_manifest_goes_before_any_other() -> None:
    everything = stated(("a", "cork", "", "test"), ("b", "felt", "", "train"), ("c", "foam", "", ""))
    assert [[entry.name for entry in split(everything, part)] for part in ("train", "test")] == [["b"], ["a"]]
    assert len(split(everything, "all")) == 3
    assert len(split(everything, "test", by="material")) == 1
    with pytest.raises(InputError, match="marks no recording as train"):
        split(everything[:1], "train")


def test_materials_of_a_manifest_are_never_torn() -> None:
    everything = stated(*((f"{number:02}", "cork" if number % 4 else "felt", "", "") for number in range(20)))
    assert {entry.material for entry in split(everything, "test")} == {"felt"}
    with pytest.raises(InputError, match='split by "material"'):
        split(everything, "test", by="recording")
    with pytest.raises(InputError, match="x: its name does not state the material"):
        split([*everything, DatasetEntry("x", Path("x"))], "test")


def test_a_split_by_subject() -> None:
    everything = stated(*((f"{number:02}", "cork", "anna" if number % 4 else "ben", "") for number in range(20)))
    assert {entry.subject for entry in split(everything, "test", by="subject")} == {"ben"}
    with pytest.raises(InputError, match="x: states no subject"):
        split([*everything, DatasetEntry("x", Path("x"))], "test", by="subject")


def test_a_material_in_both_parts_is_reported(tmp_path: Path) -> None:
    for name in "ab":
        textures.save(tmp_path / f"{name}.wav", wood(0, 0.1))
    found = read(manifest(tmp_path, "file,material,split\na.wav,cork,train\nb.wav,Cork,test\n"))
    assert "puts 1 material into both parts: cork first" in found.remarks[0]
