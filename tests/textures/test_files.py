"""Tests of WAV, NPY and NPZ files, of saving, and of paths that are no file."""

import os
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from vibrocast.textures import Recording, TextureError, load, save

NOISE = np.random.default_rng(0).uniform(-0.9, 0.9, (50, 2))


@pytest.mark.skipif(sys.platform != "linux", reason="only there files have such names")
def test_a_name_that_is_no_text_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"\xff.wav")
    path.touch()
    with pytest.raises(TextureError, match="its name holds bytes that are no characters; rename it"):
        load(path)


def test_a_wav_file_takes_its_physical_value_from_unit_and_full_scale(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", NOISE, 1000, "DOUBLE", format="WAV")
    recording = load(tmp_path / "a.wav", unit="g", full_scale=2)
    assert recording.unit == "m/s^2"
    np.testing.assert_allclose(recording.samples, NOISE * 2 * 9.80665)
    drive = load(tmp_path / "a.wav", unit="drive")
    assert drive.unit == "full scale"
    np.testing.assert_array_equal(drive.samples, NOISE)
    for options, message in (
        ({"unit": "g"}, "give `full_scale` too"),
        ({"full_scale": 2.0}, "give its `unit` too"),
        ({"rate_hz": 2800.0}, "states 1000 Hz; leave out `rate_hz`=2800"),
        ({"unit": "drive", "full_scale": 2.0}, "give its `unit` too"),
    ):
        with pytest.raises(TextureError, match=message):
            load(tmp_path / "a.wav", **options)


@pytest.mark.parametrize("sixteen_bit", [True, False])
@pytest.mark.parametrize(
    ("unit", "peak", "full_scale"), [("full scale", 0.5, 1), ("full scale", 3, 3), ("um", 40, 40), ("um", 0, 1)]
)
def test_a_saved_recording_states_its_unit(
    tmp_path: Path, sixteen_bit: bool, unit: str, peak: float, full_scale: float
) -> None:
    recording = Recording(NOISE / np.abs(NOISE).max() * peak, 2800.0, unit, "saved")
    stated = save(tmp_path / "saved.wav", recording, sixteen_bit)
    assert stated == (pytest.approx(full_scale) if sixteen_bit else 1)
    loaded = load(tmp_path / "saved.wav")
    assert (loaded.rate_hz, loaded.unit, loaded.name) == (2800, unit, "saved")
    np.testing.assert_allclose(loaded.samples, recording.samples, rtol=0, atol=full_scale * 1.01 / 32768)
    with soundfile.SoundFile(tmp_path / "saved.wav") as file:
        np.testing.assert_allclose(file.read() * stated, recording.samples, rtol=0, atol=full_scale * 1.01 / 32768)


@pytest.mark.parametrize(
    "comment", ["unit=um", "unit=volt; full_scale=3", "unit=um; full_scale=x", "unit=um; full_scale=-1", "hello"]
)
def test_other_comments_of_a_wav_file_say_nothing(tmp_path: Path, comment: str) -> None:
    with soundfile.SoundFile(tmp_path / "a.wav", "w", 1000, 1, "DOUBLE", format="WAV") as file:
        file.comment = comment
        file.write(NOISE[:, 0])
    recording = load(tmp_path / "a.wav")
    assert recording.unit == "full scale"
    np.testing.assert_array_equal(recording.samples[:, 0], NOISE[:, 0])


def test_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", NOISE)
    np.testing.assert_array_equal(load(tmp_path / "a.npy", rate_hz=100, unit="um").samples, NOISE)
    np.savez(tmp_path / "stated.npz", samples=np.asfortranarray(NOISE), rate_hz=500, unit="g", other=np.zeros(3))
    recording = load(tmp_path / "stated.npz")
    assert (recording.rate_hz, recording.unit) == (500, "m/s^2")
    np.testing.assert_allclose(recording.samples, NOISE * 9.80665)
    assert load(tmp_path / "stated.npz", key="other").samples.shape == (3, 1)
    np.savez_compressed(tmp_path / "only.npz", anything=np.float32(NOISE[:, 0]), rate_hz=500)
    assert load(tmp_path / "only.npz", unit="um").samples.shape == (50, 1)


def test_integers_of_an_array_are_numbers_or_full_scale(tmp_path: Path) -> None:
    np.save(tmp_path / "short.npy", np.array([16384, -32768], np.int16))
    path = tmp_path / "short.npy"
    assert load(path, rate_hz=100, unit="full scale").samples.tolist() == [[0.5], [-1]]
    assert load(path, rate_hz=100, unit="um").samples.tolist() == [[16384], [-32768]]
    assert load(path, rate_hz=100, unit="um", full_scale=40).samples.tolist() == [[20], [-40]]
    for dtype in (np.int64, np.uint8):
        np.save(tmp_path / "long.npy", np.array([1, 2], dtype))
        assert load(tmp_path / "long.npy", rate_hz=100, unit="um").samples.tolist() == [[1], [2]]
        with pytest.raises(TextureError, match="store them as int16"):
            load(tmp_path / "long.npy", rate_hz=100, unit="full scale")


@pytest.mark.parametrize(
    ("arrays", "options", "message"),
    [
        ({"a": [1.0], "b": [2.0]}, {}, "choose an array with `key`; there are a, b"),
        ({"rate_hz": 5}, {}, "holds no array of numbers; give another file"),
        ({"samples": [1.0], "rate_hz": 5, "unit": "furlong"}, {}, "unknown unit 'furlong'"),
        ({"samples": [1.0], "rate_hz": [5, 6]}, {"unit": "um"}, "rate_hz is not one number"),
        ({"samples": [1.0], "rate_hz": 0}, {"unit": "um"}, "sample rate 0"),
        ({"samples": 1.0}, {}, "holds one number, not an array"),
        ({"samples": np.zeros((3, 500)), "rate_hz": 5}, {"unit": "um"}, "rows must be samples"),
        ({"samples": [1j]}, {}, "type complex128"),
        ({"samples": np.array([{}], dtype=object)}, {}, "NumPy's format"),
    ],
)
def test_arrays_rejected_with_what_to_do(
    tmp_path: Path, arrays: dict[str, object], options: dict[str, object], message: str
) -> None:
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(TextureError, match=message):
        load(tmp_path / "a.npz", **options)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("samples", "options"),
    [
        (np.array([0.0, 0.5]), {"full_scale": 1e308, "unit": "g"}),
        (np.array([0.0, 1e308]), {"unit": "g"}),
        (np.array([0.0, np.longdouble(10) ** 4000]), {"unit": "um"}),
        (np.full((9, 3), 1e308), {"unit": "um", "reduce": "dft321"}),
        (np.array([0.0, 1e300]), {"unit": "um"}),
    ],
)
def test_numbers_that_overflow_are_one_error_and_no_warning(
    tmp_path: Path, samples: np.ndarray, options: dict[str, Any]
) -> None:
    np.savez(tmp_path / "a.npz", samples=samples, rate_hz=100)
    with pytest.raises(TextureError, match="at most 1e"):
        load(tmp_path / "a.npz", **options)


def test_paths_that_are_no_recording(tmp_path: Path) -> None:
    (tmp_path / "a.mp3").write_bytes(b"ID3")
    (tmp_path / "flac.wav").write_bytes(b"RIFF")
    soundfile.write(tmp_path / "flac.flac", NOISE, 8000, format="FLAC")
    (tmp_path / "flac.flac").rename(tmp_path / "flac.wav")
    os.mkfifo(tmp_path / "pipe.wav")
    for name, message in (
        ("a.mp3", "unknown kind of file; known are .wav"),
        ("flac.wav", "FLAC in a .wav file"),
        ("pipe.wav", "not a file"),
        ("missing.wav", "no such file"),
        ("missing/at/all.wav", "no such file"),
        ("null\0.wav", "no such file"),
        ("x" * 5000 + ".wav", "cannot be read"),
    ):
        with pytest.raises(TextureError, match=message):
            load(tmp_path / name)


@pytest.mark.parametrize("stated_bytes", [0x7FFFF000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFF0, 0xFFFFFFFF])
def test_a_wav_file_written_into_a_pipe(tmp_path: Path, stated_bytes: int) -> None:
    save(tmp_path / "a.wav", Recording(NOISE, 2800, "um", "a"))
    data = bytearray((tmp_path / "a.wav").read_bytes())
    start = data.index(b"data") + 4
    data[start : start + 4] = struct.pack("<I", stated_bytes)
    (tmp_path / "a.wav").write_bytes(data)
    assert load(tmp_path / "a.wav").samples.shape == NOISE.shape


@pytest.mark.parametrize(("stated", "riff"), [(0, 0), (0, 8036), (400, 8036), (4000, 4036)])
def test_a_wav_file_with_an_unfinished_header_is_rejected(tmp_path: Path, stated: int, riff: int) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.full(4000, 0.1), 2800, "PCM_16")
    data = bytearray(path.read_bytes())
    data[4:8], data[40:44] = struct.pack("<I", riff), struct.pack("<I", stated)
    path.write_bytes(data)
    with pytest.raises(TextureError, match=f"header is unfinished: {8000 - stated} bytes follow"):
        load(path, unit="drive")


@pytest.mark.parametrize("suffix", ["aiff", "au", "caf", "flac", "w64"])
def test_a_sound_file_is_rejected_if_it_is_cut_off(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    soundfile.write(path, NOISE, 8000)
    path.write_bytes(path.read_bytes()[:-71])
    with pytest.raises(TextureError, match=r"cut off|malformed|lost sync"):
        load(path)


@pytest.mark.parametrize("container", ["WAV", "WAVEX", "RF64"])
@pytest.mark.parametrize(
    ("subtype", "tolerance"), [("PCM_16", 1e-4), ("PCM_24", 1e-6), ("FLOAT", 1e-7), ("ULAW", 0.03)]
)
@pytest.mark.parametrize("missing_bytes", [1, 71])
def test_a_wav_file_is_read_unless_it_is_cut_off(
    tmp_path: Path, container: str, subtype: str, tolerance: float, missing_bytes: int
) -> None:
    soundfile.write(tmp_path / "a.wav", NOISE, 2800, subtype, format=container)
    recording = load(tmp_path / "a.wav")
    assert (recording.rate_hz, recording.unit, recording.name) == (2800, "full scale", "a")
    np.testing.assert_allclose(recording.samples, NOISE, rtol=0, atol=tolerance)
    data = (tmp_path / "a.wav").read_bytes()
    (tmp_path / "a.wav").write_bytes(data[:-missing_bytes])
    with pytest.raises(TextureError, match=f"cut off, the last {missing_bytes} of .* are missing"):
        load(tmp_path / "a.wav")
