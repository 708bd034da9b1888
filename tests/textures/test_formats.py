"""Tests of every format that is read and written: what it states, what it holds, what is rejected before it is read."""

import json
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
import pandas
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from matio import save_to_mat
from scipy.io import savemat

from tests.textures.damage import check_damaged
from vibrocast.memory import available_bytes
from vibrocast.textures import Recording, TextureError, apart, load, save

NOISE = np.random.default_rng(0).uniform(-0.9, 0.9, (50, 2))


def write_v73(path: Path, variables: dict[str, np.ndarray | str]) -> None:
    """Write variables as MATLAB's `save -v7.3` does: axes reversed, a text as numbers, the class as an attribute."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            array = np.array([[ord(letter) for letter in value]], np.uint16) if isinstance(value, str) else value
            dataset = file.create_dataset(name, data=array.T)
            kinds = {"float64": "double", "float32": "single"}
            kind = "char" if isinstance(value, str) else kinds.get(str(array.dtype), str(array.dtype))
            dataset.attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(510) + b"\x00\x02IM"[2:])


def write_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("samples", data=NOISE, compression="gzip")
        file.attrs.update({"fs": 2800, "unit": "m/s^2"})


def write_p1918(path: Path) -> None:
    path.mkdir()
    for axis in "XYZ":
        np.savetxt(path / f"Direct_-_probe_-_cork_-_slow_{axis}.txt", NOISE[:, 0] / np.sqrt(3))


def write_profile(path: Path) -> None:
    np.savetxt(
        path,
        np.column_stack([np.arange(50.0), NOISE[:, 0]]),
        delimiter=",",
        header="position_um,height_um",
        comments="",
    )


def write_sound(path: Path) -> None:
    exact = path.suffix in (".wav", ".au", ".caf", ".w64")
    kind = "AIFF" if path.suffix == ".aif" else None
    soundfile.write(path, NOISE, 2800, "DOUBLE" if exact else "PCM_24", format=kind)


TABLE = "".join(
    f"{index / 2800:.6f}{{0}}{left!r}{{0}}{right!r}\n" for index, (left, right) in enumerate(NOISE.tolist())
)
FORMATS: dict[str, tuple[str, Callable[[Path], Any], dict[str, Any]]] = {
    **{
        suffix: (f"a.{suffix}", write_sound, {"unit": "m/s^2", "full_scale": 1})
        for suffix in ("wav", "aif", "aiff", "au", "caf", "flac", "w64")
    },
    "csv": ("a.csv", lambda path: path.write_text("time_s,left (m/s^2),right (m/s^2)\n" + TABLE.format(",")), {}),
    "txt": ("a.txt", lambda path: path.write_text("# unit: m/s^2\ntime left right\n" + TABLE.format(" ")), {}),
    "tsv": ("a.tsv", lambda path: path.write_text("t\tleft\tright\n" + TABLE.format("\t")), {"unit": "m/s^2"}),
    "npy": ("a.npy", lambda path: np.save(path, NOISE), {"rate_hz": 2800, "unit": "m/s^2"}),
    "npz": ("a.npz", lambda path: np.savez(path, data=NOISE, Fs=2800, units="m/s^2"), {}),
    "mat v5": (
        "a.mat",
        lambda path: savemat(path, {"acc": NOISE, "Fs": 2800, "unit": "m/s^2"}, do_compression=True),
        {},
    ),
    "mat v4": ("a.mat", lambda path: savemat(path, {"acc": NOISE, "fs": 2800.0}, format="4"), {"unit": "m/s^2"}),
    "mat v7.3": (
        "a.mat",
        lambda path: write_v73(path, {"acc": NOISE, "fs": np.array([[2800.0]]), "unit": "m/s^2"}),
        {},
    ),
    "h5": ("a.h5", write_h5, {}),
    "hdf5": ("a.HDF5", write_h5, {"key": "/samples"}),
    "p1918 folder": ("trace", write_p1918, {"unit": "m/s^2"}),
    "height profile": ("a.csv", write_profile, {"hand_speed_mm_s": 2.8}),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read(tmp_path: Path, name: str) -> None:
    file, write, options = FORMATS[name]
    write(tmp_path / file)
    recording = load(tmp_path / file, **options)
    assert (recording.rate_hz, recording.name) == (2800, Path(file).stem)
    if name == "height profile":
        assert (recording.unit, recording.samples.shape) == ("um", (50, 1))
        return
    assert recording.unit == "m/s^2"
    channels = 1 if name == "p1918 folder" else 2
    tolerance = 2**-23 if name in ("aif", "aiff", "flac") else 1e-12  # 24 bits
    np.testing.assert_allclose(recording.samples, NOISE[:, :channels], rtol=1e-12, atol=tolerance)


def test_a_lossy_sound_file_is_read(tmp_path: Path) -> None:
    tone = np.sin(2 * np.pi * 250 * np.arange(8000) / 8000)
    soundfile.write(tmp_path / "a.ogg", tone, 8000)
    recording = load(tmp_path / "a.ogg", unit="drive")
    assert recording.rate_hz == 8000
    assert np.std(recording.samples[:, 0] - tone) < 0.1 * np.std(tone)


@pytest.mark.parametrize("suffix", [".wav", ".csv", ".npy", ".mat", ".h5", ".CSV", ".NPY", ".MAT", ".H5"])
@pytest.mark.parametrize(("unit", "rate_hz"), [("m/s^2", 2800), ("um", 44_100), ("full scale", 1000)])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_what_is_saved_loads_again(tmp_path: Path, suffix: str, unit: str, rate_hz: float, channels: int) -> None:
    samples = np.random.default_rng(1).normal(size=(70, channels)).astype(np.float32).astype(np.float64)
    samples[:, 0] = np.arange(70)  # a ramp, which could be a time
    recording = Recording(samples, rate_hz, unit, "saved")
    assert save(tmp_path / f"saved{suffix}", recording) == 1.0
    options: dict[str, Any] = {"rate_hz": rate_hz, "unit": unit} if suffix.lower() == ".npy" else {}
    loaded = load(tmp_path / f"saved{suffix}", **options)
    assert (loaded.rate_hz, loaded.unit, loaded.name, loaded.axes) == (rate_hz, unit, "saved", ())
    np.testing.assert_array_equal(loaded.samples, samples)


def test_csv_keeps_axes_and_any_rate_exactly(tmp_path: Path) -> None:
    recording = Recording(np.random.default_rng(2).normal(size=(9, 3)), 2800 / 3, "um", "a", ("X", "Y", "Z"))
    save(tmp_path / "a.csv", recording)
    loaded = load(tmp_path / "a.csv")
    assert (loaded.rate_hz, loaded.axes) == (recording.rate_hz, recording.axes)
    np.testing.assert_array_equal(loaded.samples, recording.samples)


def test_what_no_format_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Recording(NOISE, 2800, "um", "a")
    with pytest.raises(TextureError, match=r"saved as \.wav, \.csv, \.npy, \.mat, \.h5; give one of these"):
        save(tmp_path / "a.flac", recording)
    with pytest.raises(TextureError, match="resample first"):
        save(tmp_path / "a.wav", Recording(NOISE, 2800.5, "um", "a"))
    with pytest.raises(TextureError, match="`sixteen_bit` is for a"):
        save(tmp_path / "a.csv", recording, sixteen_bit=True)
    for suffix in (".wav", ".csv", ".npy", ".mat", ".h5"):
        with pytest.raises(TextureError, match=r"cannot be written .*; free some space, or write elsewhere"):
            save(tmp_path / "missing" / f"a{suffix}", recording)
    monkeypatch.setattr("vibrocast.textures.mat.MAX_BYTES", 100)
    with pytest.raises(TextureError, match=r"more than the 2 GiB that a \.mat file holds"):
        save(tmp_path / "a.mat", recording)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_vectors_and_integers_of_matlab(tmp_path: Path, version: str) -> None:
    path = tmp_path / "a.mat"
    write: Any = write_v73 if version == "7.3" else savemat
    vector, rate = np.arange(40.0)[:, None], np.array([[500.0]])
    for array in (vector, vector.T):
        write(path, {"x": array, "sample_rate": rate, "subject": np.array([[7.0]])})
        np.testing.assert_array_equal(load(path, unit="um").samples, vector)
    # MATLAB stores whole numbers of a double as small integers; they stay numbers, not parts of full scale.
    write(path, {"x": vector, "fs": rate})
    np.testing.assert_array_equal(load(path, unit="drive").samples, vector)
    write(path, {"x": np.array([[16384], [-32768]], np.int16), "fs": rate})
    assert load(path, unit="drive").samples.tolist() == [[0.5], [-1]]


def test_doubles_that_matlab_stores_as_small_integers(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"x": np.arange(40, dtype=np.uint8)[:, None], "fs": 500})
    data = bytearray(path.read_bytes())
    flags = data.index(b"\x06\x00\x00\x00\x08\x00\x00\x00") + 8
    assert data[flags] == 9  # the class uint8
    data[flags] = 6  # the class double, of bytes
    path.write_bytes(data)
    np.testing.assert_array_equal(load(path, unit="drive").samples[:, 0], np.arange(40))


CELL = np.empty(2, object)
CELL[:] = [NOISE, NOISE]


@pytest.mark.parametrize(
    ("variables", "options", "message"),
    [
        (
            {"trial": {"acc": NOISE}, "b": NOISE},
            {"key": "trial"},
            "no array of numbers `key`=trial; there are trial.acc",
        ),
        ({"trial": {"acc": NOISE, "gyr": NOISE}}, {}, "choose an array with `key`; there are trial.acc, trial.gyr"),
        ({"trials": CELL, "name": "oak"}, {}, r"with `key`; there are trials\(1\), trials\(2\)"),
        ({"trial": {"name": "oak"}}, {}, "holds no array of numbers; give another file"),
        ({"on": np.array([True, False])}, {}, "on is a logical, not"),
        ({"level": 3.0}, {}, "level is one number, not an array of numbers; save the samples"),
        ({"a": 1, "b": 2, "name": "oak"}, {}, "a is one number, b is one number, name is a char, not an array"),
        ({"acc": np.zeros(0)}, {}, "acc is empty, not"),
        (
            {"a": NOISE, "Fs": 1000, "rate_hz": 2000},
            {},
            "several rates, Fs 1000, rate_hz 2000; choose one with `rate_hz`",
        ),
        ({"a": NOISE, "Fs": 1000, "rate_hz": 2000}, {"rate_hz": 3000}, "several rates"),
    ],
)
def test_variables_of_matlab_rejected_with_what_to_do(
    tmp_path: Path, variables: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    savemat(tmp_path / "a.mat", variables)
    with pytest.raises(TextureError, match=message):
        load(tmp_path / "a.mat", **options)


@pytest.mark.parametrize("key", ["trial.acc.x", "trial/acc/x", None])
def test_a_field_of_a_struct_states_its_rate_next_to_it(tmp_path: Path, key: str | None) -> None:
    trial = {"fs": 2800, "acc": {"x": NOISE[:, 0], "unit": "g"}}
    savemat(tmp_path / "a.mat", {"trial": trial, "fs": 100} if key else {"trial": trial})
    recording = load(tmp_path / "a.mat", key=key, rate_hz=None)
    assert (recording.rate_hz, recording.unit) == (2800, "m/s^2")
    np.testing.assert_allclose(recording.samples[:, 0], NOISE[:, 0] * 9.80665)


@pytest.mark.parametrize("version", ["v7", "v7.3"])
@pytest.mark.filterwarnings("ignore:duration_to_mat")
def test_tables_and_timetables_of_matlab(tmp_path: Path, version: str) -> None:
    frame = pandas.DataFrame({"x": NOISE[:, 0], "y": NOISE[:, 1], "name": "oak"})
    timed = frame.set_index(pandas.to_timedelta(np.arange(50) / 1000, unit="s"))
    save_to_mat(str(tmp_path / "table.mat"), {"trial": frame, "fs": 1000.0}, version=version)
    save_to_mat(str(tmp_path / "timed.mat"), {"trial": timed}, version=version)
    for name in ("table.mat", "timed.mat"):
        for key in (None, "trial"):
            recording = load(tmp_path / name, unit="um", key=key)
            assert recording.rate_hz == 1000
            np.testing.assert_array_equal(recording.samples, NOISE)
        np.testing.assert_array_equal(load(tmp_path / name, unit="um", key="trial.y").samples, NOISE[:, 1:])
        with pytest.raises(TextureError, match="no array of numbers `key`=name; there are x, y"):
            load(tmp_path / name, unit="um", key="trial.name")


def test_an_element_of_a_cell_or_of_an_array_of_structs(tmp_path: Path) -> None:
    structs = np.array([(NOISE[:, 0], 100), (NOISE[:, 1], 200)], [("acc", object), ("fs", object)])
    savemat(tmp_path / "a.mat", {"trials": structs, "cells": CELL})
    assert load(tmp_path / "a.mat", key="trials(2).acc", unit="um").rate_hz == 200
    np.testing.assert_array_equal(load(tmp_path / "a.mat", 100, "um", key="cells(1)").samples, NOISE)


@pytest.mark.parametrize("kind", [20, 21, 25, 45, 60, 200, 5000, 65535])
def test_a_file_that_crashes_its_reader_is_rejected_and_the_next_one_is_read(tmp_path: Path, kind: int) -> None:
    savemat(tmp_path / "good.mat", {"a": NOISE, "fs": 2800, "unit": "um"})
    data = bytearray((tmp_path / "good.mat").read_bytes())
    place = data.index(b"a\0\0\0\x09\0\0\0") + 4  # the type of the array's numbers: 9, double
    data[place : place + 4] = kind.to_bytes(4, "little")
    (tmp_path / "bad.mat").write_bytes(data)
    with pytest.raises(TextureError, match=r"bad\.mat: (its reader crashes|not a \.mat file)"):
        load(tmp_path / "bad.mat", 2800, "um")
    np.testing.assert_array_equal(load(tmp_path / "good.mat").samples, NOISE)


def test_a_reader_that_takes_too_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savemat(tmp_path / "a.mat", {"a": NOISE, "fs": 2800, "unit": "um"})
    apart.READERS.end()  # a new process needs time to start
    monkeypatch.setattr(apart, "SECONDS", 0.0)
    with pytest.raises(TextureError, match=r"reading it takes longer than 0 s; save it as \.npy or \.wav"):
        load(tmp_path / "a.mat")


def test_an_interrupted_request_leaves_no_answer_to_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("first", 1.0), ("second", 2.0)):
        savemat(tmp_path / f"{name}.mat", {"a": np.full(40, value), "fs": 2800, "unit": "um"})

    def interrupted(process: Any, request: Any) -> NoReturn:
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(apart, "_line_for", interrupted)
        load(tmp_path / "first.mat")
    assert load(tmp_path / "second.mat").samples[0] == 2


def test_one_of_several_stated_rates_is_chosen(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"a": NOISE, "b": NOISE[:, :1], "Fs": 1000, "rate_hz": 2000, "unit": "g"})
    recording = load(tmp_path / "a.mat", key="b", rate_hz=2000)
    assert (recording.rate_hz, recording.unit, recording.channels) == (2000, "m/s^2", 1)


def test_the_nearest_statement_of_an_hdf5_file_counts(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = 1000
        file["units"] = "um"
        file["first/acc"] = NOISE
        file["first/Fs"] = [2000.0]
        file["second/acc"] = NOISE[:, 0]
        file["second/acc"].attrs["rate_hz"] = 3000.0
        file["third"] = NOISE.astype(">f4")
        file["notes"] = "oak"
    for key, rate_hz in (("first/acc", 2000), ("/second/acc", 3000), ("third", 1000)):
        recording = load(path, key=key)
        assert (recording.rate_hz, recording.unit) == (rate_hz, "um")
        np.testing.assert_allclose(recording.samples[:, 0], NOISE[:, 0], rtol=1e-6)
    with pytest.raises(TextureError, match="choose an array with `key`; there are first/acc, second/acc, third"):
        load(path)
    with pytest.raises(TextureError, match="notes is a dataset of type object, not an array of numbers"):
        load(path, key="notes")


def test_structs_of_matlab_7_3_are_chosen_by_path(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    write_v73(path, {"trial/acc": NOISE, "trial/fs": np.array([[2800.0]]), "other": NOISE, "trial/unit": "g"})
    recording = load(path, key="trial/acc")
    assert (recording.rate_hz, recording.unit) == (2800, "m/s^2")
    np.testing.assert_allclose(recording.samples, NOISE * 9.80665)


def test_hdf5_whose_numbers_are_elsewhere_is_rejected(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("samples", (50,), "f8", external=[("/dev/zero", 0, 400)])
        file["link"] = h5py.ExternalLink("/dev/zero", "samples")
    with pytest.raises(TextureError, match="samples has its numbers in other files; save them in this one"):
        load(tmp_path / "a.h5", rate_hz=100, unit="um")


def huge_npz(path: Path) -> None:
    np.savez_compressed(path, samples=np.zeros((4_000_000, 1)), rate_hz=100)


def huge_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("samples", (2**40,), "f8", chunks=(1000,))


def huge_chunk(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("samples", (10,), "f8", maxshape=(None,), chunks=(4_000_000,), compression="gzip")[:] = 1


def huge_v73(path: Path) -> None:
    huge_h5(path)
    with h5py.File(path, "r+") as file:
        file["samples"].attrs["MATLAB_class"] = np.bytes_("double")


HUGE: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "wav": ("a.wav", lambda path: soundfile.write(path, np.zeros(4_000_000), 2800, "PCM_U8")),
    "csv": ("a.csv", lambda path: path.write_bytes(b"0\n" * 6_000_000)),
    "npy": ("a.npy", lambda path: np.save(path, np.zeros(4_000_000, np.int8))),
    "npz": ("a.npz", huge_npz),
    "mat v5": ("a.mat", lambda path: savemat(path, {"samples": np.zeros(4_000_000)})),
    "mat v7.3": ("a.mat", huge_v73),
    "h5": ("a.h5", huge_h5),
    "chunk of h5": ("a.h5", huge_chunk),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_file_that_does_not_fit_into_memory_is_rejected_unread(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, write = HUGE[name]
    write(tmp_path / file)
    monkeypatch.setattr("vibrocast.memory.available_bytes", lambda: 10_000_000)
    tracemalloc.start()
    with pytest.raises(
        TextureError, match=r"needs .* GiB of memory, and only 0.00931 GiB are free; close other programs, or cut"
    ):
        load(tmp_path / file, rate_hz=100, unit="um")
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 5_000_000


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        ("(1000000000, 3000)", "GiB of memory"),
        ("(9223372036854775808,)", "GiB of memory"),
        ("(3, 99999999999999999999999)", "GiB of memory"),
        ("(25000000,)", "bytes of it"),
    ],
)
@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_header_that_declares_more_than_memory_or_file_hold(
    tmp_path: Path, shape: str, reason: str, name: str
) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + bytes((len(header), 0)) + header.encode() + bytes(80)
    if name == "a.npy":
        (tmp_path / name).write_bytes(data)
    else:
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("samples.npy", data)
    with pytest.raises(TextureError, match=reason):
        load(tmp_path / name, rate_hz=100, unit="um")


def test_files_that_could_unpack_into_large_arrays_are_rejected(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("samples.npy", b"")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("samples", (25_000_000,), "f8", chunks=(1000,))
    for name, reason in (("a.npz", "a way that NumPy does not write"), ("a.h5", "bytes of it")):
        with pytest.raises(TextureError, match=reason):
            load(tmp_path / name, rate_hz=2800, unit="um")


def test_silence_that_is_packed_as_well_as_can_be_is_no_bomb(tmp_path: Path) -> None:
    samples = np.zeros(3_000_000)
    np.savez_compressed(tmp_path / "a.npz", samples=samples)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("samples", data=samples, compression="gzip", compression_opts=9)
    savemat(tmp_path / "a.mat", {"samples": samples}, do_compression=True)
    for name in ("a.npz", "a.h5", "a.mat"):
        assert len(load(tmp_path / name, rate_hz=2800, unit="um").samples) == len(samples)


@pytest.mark.parametrize(
    ("line", "folder", "limit", "statistics"),
    [
        ("0::/job", "job", "memory.max", "anon 300\nfile 600"),
        ("0::/job", "", "memory.max", "anon 300\nfile 600"),
        ("4:memory:/job", "memory/job", "memory.limit_in_bytes", "cache 600\ntotal_rss 300"),
    ],
)
def test_the_limit_of_a_control_group_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, folder: str, limit: str, statistics: str
) -> None:
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / folder / limit).write_text("1000\n")
    (tmp_path / folder / "memory.stat").write_text(statistics)
    (tmp_path / "cgroup").write_text(f"3:cpu:/\n{line}\n")
    monkeypatch.setattr("vibrocast.memory.CONTROL_GROUPS", tmp_path)
    monkeypatch.setattr("vibrocast.memory.GROUPS_OF_PROCESS", tmp_path / "cgroup")
    assert available_bytes() == 700
    (tmp_path / folder / limit).write_text("max\n")
    assert available_bytes() > 1000


HEADS = [b"", b"RIFF", b"\x93NUMPY\x01\x00", b"PK\x03\x04", b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"]
CHANGES = st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=8)


@given(changes=CHANGES, cut=st.integers(0, 300))
@pytest.mark.parametrize("name", ["wav", "npy", "npz", "mat v5", "mat v7.3", "h5"])
def test_a_damaged_file_loads_or_is_rejected(
    tmp_path_factory: pytest.TempPathFactory, name: str, changes: list[tuple[int, int]], cut: int
) -> None:
    file, write, _ = FORMATS[name]
    path = tmp_path_factory.getbasetemp() / f"damaged-{file}"
    write(path)
    check_damaged(path, changes, cut)


@given(data=st.binary(max_size=400), head=st.sampled_from(HEADS))
@pytest.mark.parametrize("name", ["any.wav", "any.npy", "any.npz", "any.mat", "any.h5", "any.txt"])
def test_any_bytes_are_rejected(tmp_path_factory: pytest.TempPathFactory, name: str, head: bytes, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(head + data)
    with pytest.raises(TextureError):
        load(path)
