"""Tests of height profiles: loading, form removal and sweeping."""

from pathlib import Path

import numpy as np
import pytest

from vibrocast.textures import Profile, TextureError, load, load_profile, resample

HEIGHTS_UM = np.random.default_rng(0).normal(size=400)


def write_profile(folder: Path, header: str = "position_um,height_um", position_factor: float = 2.0) -> Path:
    path = folder / "profile.csv"
    lines = [f"{index * position_factor:.4f},{height:.4f}" for index, height in enumerate(HEIGHTS_UM)]
    path.write_text("\n".join([header, *lines]))
    return path


@pytest.mark.parametrize(
    ("header", "position_factor", "height_factor"),
    [
        ("position_um,height_um", 2.0, 1),
        ("position_mm,height_nm", 0.002, 1e-3),
        ("Position (um),z (mm)", 2.0, 1000),
    ],
)
def test_columns_and_units(tmp_path: Path, header: str, position_factor: float, height_factor: float) -> None:
    profile = load_profile(write_profile(tmp_path, header, position_factor))
    assert profile.spacing_um == pytest.approx(2)
    assert profile.length_mm == pytest.approx(0.798)
    np.testing.assert_allclose(profile.heights_um, np.round(HEIGHTS_UM, 4) * height_factor)


def test_form_is_removed() -> None:
    position = np.arange(400)
    form = 5 - 0.3 * position + 0.002 * position**2
    rough = Profile(HEIGHTS_UM, 2, "rough").without_form()
    np.testing.assert_allclose(Profile(HEIGHTS_UM + form, 2, "tilted").without_form(), rough, atol=1e-9)
    np.testing.assert_allclose(Profile(form, 2, "form").without_form(), 0, atol=1e-9)
    assert abs(np.mean(rough)) < 1e-12


def test_a_wave_is_felt_at_speed_over_wavelength() -> None:
    wave = Profile(3 * np.sin(2 * np.pi * np.arange(20000) * 0.5 / 400), 0.5, "wave of 0.4 mm")
    swept = resample(wave.recording(50), 2800)
    assert swept.unit == "um"
    assert swept.seconds == pytest.approx(0.2)
    spectrum = np.abs(np.fft.rfft(swept.samples[:, 0]))
    assert np.argmax(spectrum) * 2800 / len(swept.samples) == pytest.approx(50 / 0.4)
    assert np.abs(swept.samples[100:-100]).max() == pytest.approx(3, rel=0.03)


def test_load_sweeps_at_the_given_speed(tmp_path: Path) -> None:
    recording = load(write_profile(tmp_path), hand_speed_mm_s=50)
    assert recording.unit == "um"
    assert recording.rate_hz == pytest.approx(25000)
    np.testing.assert_allclose(recording.samples[:, 0], load_profile(tmp_path / "profile.csv").without_form())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give `hand_speed_mm_s`, the speed of the hand"),
        ({"hand_speed_mm_s": float("nan")}, "must be positive"),
        ({"hand_speed_mm_s": 1e12}, "sample rate 5e[+]14 Hz.*correct .* the hand speed"),
        ({"hand_speed_mm_s": 50, "unit": "um"}, "no other option"),
    ],
)
def test_options(tmp_path: Path, options: dict[str, float], message: str) -> None:
    with pytest.raises(TextureError, match=message):
        load(write_profile(tmp_path), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("position_um,height_um\n0,1\n1,2\n", "at least 8 heights"),
        ("position_um,height_um,other_um\n0,1,1\n1,2,1\n", "two columns"),
        ("position,height_um\n0,1\n1,2\n", "must state a length: position_nm"),
        ("position_um,height_um\n0,1\n1,2\n1,2\n7,1\n", "repeats in line 4; remove"),
        ("position_um,height_um\n0,1\n1,2\n2,2\n7,1\n", "column of positions: a gap of 5 after line 4"),
        ("position_um,height_um\n" + "".join(f"{n},nan\n" for n in range(9)), "not numbers"),
    ],
)
def test_rejected_with_what_to_do(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "profile.csv"
    path.write_text(text)
    with pytest.raises(TextureError, match=message):
        load_profile(path)


def test_only_text_holds_a_profile(tmp_path: Path) -> None:
    with pytest.raises(TextureError, match="a height profile is saved as"):
        load_profile(tmp_path / "profile.wav")
    with pytest.raises(TextureError, match="cannot be read"):
        load_profile(tmp_path / "missing.csv")
