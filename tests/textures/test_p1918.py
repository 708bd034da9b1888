"""Tests of IEEE P1918.1.1 recordings in their folders, and of the reduction of three axes to one."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vibrocast.textures import TextureError, load
from vibrocast.textures.axes import dft321

NAME = "Direct_-_1spike_Probe_-_cork_-_slow"
AXES = np.random.default_rng(0).normal(size=(300, 3))


def write_recording(folder: Path, name: str = NAME, axes: str = "XYZ", samples: int = 300) -> Path:
    for letter in axes:
        values = AXES[:samples, "XYZ".index(letter)]
        (folder / f"{name}_{letter}.txt").write_bytes(b"".join(b"   %.15e\r\n" % value for value in values))
    return folder / name


def test_a_folder_of_one_recording_is_reduced(tmp_path: Path) -> None:
    write_recording(tmp_path)
    (tmp_path / "readme.txt").write_text("not a recording")
    recording = load(tmp_path, unit="g")
    assert (recording.rate_hz, recording.unit, recording.channels) == (2800, "m/s^2", 1)
    np.testing.assert_allclose(recording.samples, dft321(AXES) * 9.80665)
    assert recording.axes == ()
    np.testing.assert_allclose(load(tmp_path, unit="g", reduce="dft321").samples, recording.samples)
    kept = load(tmp_path, unit="m/s^2", reduce="none")
    assert kept.axes == ("X", "Y", "Z")
    np.testing.assert_allclose(kept.samples, AXES)
    np.testing.assert_allclose(load(tmp_path, unit="m/s^2", reduce="norm").samples[:, 0], np.linalg.norm(AXES, axis=1))


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_one_axis_is_chosen(tmp_path: Path, axis: str) -> None:
    stem = write_recording(tmp_path)
    expected = AXES[:, ["XYZ".index(axis)]]
    np.testing.assert_allclose(load(tmp_path, unit="m/s^2", columns=axis.lower()).samples, expected)
    np.testing.assert_allclose(load(stem, unit="m/s^2", columns=axis.lower()).samples, expected)
    np.testing.assert_allclose(load(tmp_path / f"{NAME}_{axis}.txt", unit="m/s^2").samples, expected)


def test_one_of_several_recordings_is_named(tmp_path: Path) -> None:
    write_recording(tmp_path, NAME)
    stem = write_recording(tmp_path, NAME.replace("slow", "fast"), samples=200)
    with pytest.raises(TextureError, match=r"holds 2 recordings; give one of them, such as .*fast.*slow"):
        load(tmp_path, unit="g")
    assert load(stem, unit="g").samples.shape == (200, 1)
    assert load(stem, unit="g").name == stem.name


def test_other_names_do_not_state_a_rate(tmp_path: Path) -> None:
    write_recording(tmp_path, "mine")
    with pytest.raises(TextureError, match="give `rate_hz`"):
        load(tmp_path, unit="g")
    assert load(tmp_path, unit="g", rate_hz=1000).rate_hz == 1000


@pytest.mark.parametrize(
    ("name", "changed", "options", "message"),
    [
        (NAME, {}, {}, "give `unit`"),
        ("", {"Z": "1\n" * 299}, {"unit": "g"}, r"differ in length \(300, 300, 299 samples\)"),
        ("", {"Y": "1 2\n" * 300}, {"unit": "g"}, "several columns"),
        (
            f"{NAME}_X.txt",
            {},
            {"unit": "g", "columns": "Y"},
            r"holds axis X; for other `columns`.* give .*slow$",
        ),
        (
            f"{NAME}_X.txt",
            {},
            {"unit": "g", "reduce": "norm"},
            r"holds axis X; for other `columns`.* give .*slow$",
        ),
        ("cork", {}, {}, "no such file or recording"),
    ],
)
def test_rejected_with_what_to_do(
    tmp_path: Path, name: str, changed: dict[str, str], options: dict[str, str], message: str
) -> None:
    write_recording(tmp_path)
    for axis, text in changed.items():
        (tmp_path / f"{NAME}_{axis}.txt").write_text(text)
    with pytest.raises(TextureError, match=message):
        load(tmp_path / name, **options)  # type: ignore[arg-type]


def test_a_folder_that_holds_no_recording(tmp_path: Path) -> None:
    with pytest.raises(TextureError, match="a folder without files named"):
        load(tmp_path)


def test_a_missing_axis(tmp_path: Path) -> None:
    stem = write_recording(tmp_path, axes="XZ")
    with pytest.raises(TextureError, match=r"no file for axis Y; .* `columns`=x or z"):
        load(tmp_path, unit="g")
    with pytest.raises(TextureError, match="no file for axis Y"):
        load(stem, unit="g", columns="Y")
    assert load(tmp_path, unit="g", columns="z").channels == 1


@given(axes=arrays(np.float64, st.tuples(st.integers(1, 64), st.just(3)), elements=st.floats(-100, 100)))
def test_reduction_keeps_the_energy_at_every_frequency(axes: np.ndarray) -> None:
    reduced = dft321(axes)
    assert reduced.shape == (len(axes), 1)
    power = np.sum(np.abs(np.fft.rfft(axes, axis=0)) ** 2, axis=1)
    np.testing.assert_allclose(np.abs(np.fft.rfft(reduced[:, 0])) ** 2, power, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(np.sum(reduced**2), np.sum(axes**2), rtol=1e-9, atol=1e-9)


def test_reduction_of_one_moving_axis_is_that_axis() -> None:
    still = np.zeros((300, 3))
    still[:, 1] = AXES[:, 0]
    np.testing.assert_allclose(dft321(still)[:, 0], AXES[:, 0], atol=1e-12)
