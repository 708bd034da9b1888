"""Tests of the generators: seeds, bounds, bands, the physics they claim, and rejected parameters."""

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrocast.textures import GENERATORS, Recording, TextureError, load, load_profile, save_profile
from vibrocast.textures.generate import (
    SURFACES,
    grating,
    ridges,
    rough,
    rough_profile,
    stick_slip,
    surface_profile,
    taps,
    varying_speed,
    wood,
)

EXAMPLES = Path(__file__).parents[2] / "examples"


def spectrum(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    windowed = recording.samples[:, 0] * np.hanning(len(recording.samples))
    return np.fft.rfftfreq(len(windowed), 1 / recording.rate_hz), np.abs(np.fft.rfft(windowed)) ** 2


@pytest.mark.parametrize("kind", sorted(GENERATORS))
def test_equal_seeds_make_equal_textures(kind: str) -> None:
    first, again, other = (GENERATORS[kind](seed, 1.0, 40.0, 2800.0) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.samples, again.samples)
    assert np.abs(first.samples - other.samples).max() > 0.1
    assert (first.rate_hz, first.channels, len(first.samples)) == (2800, 1, 2800)


@given(
    kind=st.sampled_from(sorted(GENERATORS)),
    seed=st.integers(0, 2**40),
    seconds=st.floats(0.01, 2),
    mean_mm_s=st.floats(1, 200),
    variation=st.floats(0, 3),
    rate_hz=st.sampled_from([1000.0, 2800.0, 8000.0]),
)
@settings(max_examples=50)
def test_any_sweep_is_bounded_or_rejected(
    kind: str, seed: int, seconds: float, mean_mm_s: float, variation: float, rate_hz: float
) -> None:
    speed = varying_speed(seconds, rate_hz, mean_mm_s, variation)
    try:
        recording = GENERATORS[kind](seed, seconds, speed, rate_hz)
    except TextureError as error:
        assert "cannot be shown" in str(error)
    else:
        assert recording.samples.shape == (round(seconds * rate_hz), 1)
        assert np.abs(recording.samples).max() < 1000


@pytest.mark.parametrize("generator", [grating, ridges, rough])
def test_sweeps_do_not_alias(generator: Any) -> None:
    frequency_hz, power = spectrum(generator(3, 2.0, varying_speed(2.0, 2800, 120.0, 0.9), 2800.0))
    assert power[frequency_hz > 0.47 * 2800].sum() < 1e-4 * power.sum()


@pytest.mark.parametrize(
    ("recording", "strongest_hz", "tolerance_hz"),
    [
        (grating(seconds=2, hand_speed_mm_s=60, pitch_mm=0.5), 60 / 0.5, 0.5),
        (ridges(seconds=4, hand_speed_mm_s=60, pitch_mm=1.5, jitter=0), 60 / 1.5, 0.5),
        (stick_slip(seconds=4, hand_speed_mm_s=40, slip_mm=0.4, jitter=0), 40 / 0.4, 0.5),
        (wood(1, 8.0, 60.0, 2800.0, resonance_hz=300, damping_ratio=0.05), 300, 25),
    ],
    ids=["grating", "ridges", "stick-slip", "wood"],
)
def test_a_texture_is_strongest_at_its_pitch_slip_or_resonance(
    recording: Recording, strongest_hz: float, tolerance_hz: float
) -> None:
    frequency_hz, power = spectrum(recording)
    assert frequency_hz[np.argmax(power)] == pytest.approx(strongest_hz, abs=tolerance_hz)


def test_a_faster_hand_feels_the_same_surface_faster() -> None:
    slow = grating(5, 4.0, 30.0, 2800.0, slope_fraction=0.5)
    fast = grating(5, 2.0, 60.0, 2800.0, slope_fraction=0.5)
    np.testing.assert_allclose(fast.samples[:-1], slow.samples[::2][:-1], atol=0.5)


@pytest.mark.parametrize("hurst", [0.3, 0.8])
def test_a_rough_surface_has_its_hurst_exponent_and_roughness(hurst: float) -> None:
    profile = rough_profile(1, length_mm=400, spacing_um=5, hurst=hurst, roll_off_mm=1, rms_um=8)
    assert len(profile.heights_um) == 80001
    assert np.std(profile.heights_um) == pytest.approx(8, rel=0.02)
    power = np.abs(np.fft.rfft(profile.heights_um * np.hanning(80001))) ** 2
    wavenumber = np.fft.rfftfreq(80001, 0.005)
    bands = np.geomspace(3, 80, 12)
    levels = [power[(wavenumber >= low) & (wavenumber < high)].mean() for low, high in pairwise(bands)]
    slope = np.polyfit(np.log(bands[:-1]), np.log(levels), 1)[0]
    assert slope == pytest.approx(-(1 + 2 * hurst), abs=0.15)


@pytest.mark.parametrize("kind", sorted(SURFACES))
def test_the_profile_of_a_surface_is_what_a_sweep_feels(kind: str, tmp_path: Path) -> None:
    profile = surface_profile(kind, 7, 1.0, 40.0, 2000.0)
    felt = SURFACES[kind](7, 1.0, 40.0, 2000.0).samples[:, 0]
    np.testing.assert_array_equal(profile.heights_um, felt)
    assert profile.spacing_um == 20
    assert profile.length_mm == pytest.approx(40, abs=0.021)
    save_profile(tmp_path / "profile.csv", profile)
    loaded = load_profile(tmp_path / "profile.csv")
    assert loaded.spacing_um == pytest.approx(20)
    np.testing.assert_allclose(loaded.heights_um, felt, atol=0.00051)
    assert load(tmp_path / "profile.csv", hand_speed_mm_s=40).rate_hz == pytest.approx(2000)


@pytest.mark.parametrize(
    ("generator", "options", "message"),
    [
        (rough, {"seed": -1}, "seed"),
        (rough, {"seconds": 0}, "seconds"),
        (rough, {"seconds": 1e9}, "a recording has 1 to"),
        (rough, {"rate_hz": float("nan")}, "rate_hz"),
        (taps, {"rate_hz": 2.0**31, "seconds": 1e-8}, "sample rate 2.14748e[+]09 Hz"),
        (rough, {"hand_speed_mm_s": 0}, "hand speed"),
        (rough, {"hand_speed_mm_s": np.ones(3)}, "give one number or 11200"),
        (rough, {"hurst": 1.0}, "hurst"),
        (rough, {"roll_off_mm": 0}, "roll_off_mm"),
        (rough_profile, {"length_mm": 1e9}, "shorten it"),
        (rough_profile, {"spacing_um": 0}, "spacing_um"),
        (surface_profile, {"kind": "taps"}, "choose one of grating, ridges, rough, wood"),
        (surface_profile, {"kind": "rough", "seconds": 1e-3}, "at least 8 heights"),
        (grating, {"pitch_mm": 0.001}, "cannot be shown"),
        (grating, {"slope_fraction": 0.6}, "slope_fraction"),
        (ridges, {"pitch_mm": 0.001}, "cannot be shown"),
        (ridges, {"jitter": 1.1}, "jitter"),
        (wood, {"resonance_hz": 1400}, "resonance_hz"),
        (stick_slip, {"slip_mm": 0.001}, "cannot be shown"),
        (taps, {"frequency_hz": 1400}, "cannot be shown"),
        (varying_speed, {"seconds": 1, "rate_hz": 10, "period_s": 0}, "period_s"),
    ],
)
def test_parameters_out_of_range(generator: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(TextureError, match=message):
        generator(**options)


def test_examples_are_what_their_script_makes(tmp_path: Path) -> None:
    specification = importlib.util.spec_from_file_location("make_examples", EXAMPLES / "make_examples.py")
    assert specification is not None and specification.loader is not None
    script = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(script)
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        script.make_examples(folder)
    for made in (tmp_path / "first").iterdir():
        assert made.read_bytes() == (tmp_path / "second" / made.name).read_bytes()
        assert made.stat().st_size < 50_000
        speed = 50.0 if made.suffix == ".csv" else None
        shipped, again = (load(path, hand_speed_mm_s=speed) for path in (EXAMPLES / made.name, made))
        assert (shipped.rate_hz, shipped.unit, shipped.channels) == (again.rate_hz, again.unit, again.channels)
        # Another machine's sine may differ in the last bit, and so may a rounded sample.
        np.testing.assert_allclose(again.samples, shipped.samples, rtol=0, atol=np.abs(shipped.samples).max() / 10000)
