"""The measures of quality: published values, what leaves them unchanged, and what has none or is rejected."""

import math
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vibromaf.metrics.spqi import spqi
from vibromaf.metrics.stsim import st_sim

from vibrocast import codec
from vibrocast.codec import Signal
from vibrocast.codec.metrics import BLOCK_SAMPLES, Quality, measure

RATE_HZ = 2800
NOTHING = Quality(*[None] * 7)


def tones() -> Signal:
    t = np.arange(2100) / RATE_HZ
    sines = ((0.5, 60, 0.0), (0.2, 250, 0.3), (0.05, 700, 0.0))
    tone: Signal = np.sum([a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in sines], axis=0)[:, None]
    return tone


def noise(samples: int = 2048, seed: int = 0) -> Signal:
    return np.random.default_rng(seed).normal(size=(samples, 1))


def close(quality: Quality, expected: Quality) -> bool:
    return astuple(quality) == pytest.approx(astuple(expected), rel=1e-9, abs=1e-9)


def test_published_values() -> None:
    x = tones()
    coarse = measure(x, np.round(16 * x) / 16, RATE_HZ)
    assert coarse.st_sim_8000 == pytest.approx(0.9970137066756, abs=1e-12)
    assert coarse.st_sim_2800 == pytest.approx(1.0053741643363, abs=1e-12)
    assert coarse.spqi == pytest.approx(0.999515912972, abs=1e-12)
    assert coarse.snr_db == pytest.approx(26.3637133687, abs=1e-10)
    half = measure(x, 0.5 * x, RATE_HZ)
    assert half.st_sim_8000 == pytest.approx(0.9819166375871, abs=1e-12)
    assert half.spqi == pytest.approx(0.0373136811084, abs=1e-12)
    assert half.snr_db == pytest.approx(20 * math.log10(2), abs=1e-12)


def test_peak_is_the_largest_magnitude_of_the_reference() -> None:
    x = np.array([[3.0], [-4.0], [0.0], [1.0]])
    assert measure(x, x + 0.5, RATE_HZ).psnr_db == pytest.approx(10 * math.log10(4**2 / 0.5**2))


def test_spectral_distance_of_silence_comes_from_the_floor() -> None:
    """A bin-centred tone has power 1/6, 4/6, 1/6 in three of the band's 77 bins; all other bins are at the floor."""
    x = np.sin(2 * np.pi * 250 * np.arange(2800) / RATE_HZ)[:, None]
    over_floor_db = 60 + 10 * np.log10(77 * np.array([1, 4, 1]) / 6)
    distance = measure(x, 0 * x, RATE_HZ).log_spectral_distance_db
    assert distance == pytest.approx(math.sqrt(np.sum(over_floor_db**2) / 77), rel=1e-6)


def test_spectral_distance_heeds_the_tactile_band_alone() -> None:
    t = np.arange(8000) / 8000
    x, outside = (np.sin(2 * np.pi * f * t)[:, None] for f in (200, 1500))
    assert measure(x, x + outside, 8000).log_spectral_distance_db == pytest.approx(0, abs=1e-3)


def test_distances_of_a_gain_are_the_gain_in_every_unit() -> None:
    """White noise fills the band far above the floor, so that every bin differs by the gain."""
    for unit in ("full scale", "um", "m/s^2"):
        for gain_db in (-6.0, 3.0):
            quality = measure(1e4 * noise(), 1e4 * 10 ** (gain_db / 20) * noise(), RATE_HZ, unit)
            assert quality.log_spectral_distance_db == pytest.approx(abs(gain_db))
            assert quality.third_octave_distance_db == pytest.approx(abs(gain_db))


def test_third_octave_distance_heeds_bands_and_not_where_in_them() -> None:
    """Two takes of one noise are far from each other in bins, not in bands; another band is far in both."""
    t = np.arange(28_000)[:, None] / RATE_HZ
    near, far = (np.sin(2 * np.pi * f * t) for f in (255, 330))
    x = np.sin(2 * np.pi * 245 * t)
    other_take = measure(noise(28_000), noise(28_000, 1), RATE_HZ)
    other_tone, other_band = measure(x, near, RATE_HZ), measure(x, far, RATE_HZ)
    assert other_take.log_spectral_distance_db is not None and other_take.third_octave_distance_db is not None
    assert 3 < other_take.third_octave_distance_db < other_take.log_spectral_distance_db - 3
    assert other_tone.third_octave_distance_db is not None and other_band.third_octave_distance_db is not None
    assert other_tone.third_octave_distance_db < 0.6 * other_band.third_octave_distance_db


def test_third_octave_distance_counts_only_what_can_be_felt() -> None:
    """A lost tone counts by its level above the threshold, and below it not at all."""
    t = np.arange(2800)[:, None] / RATE_HZ
    felt, faint = np.sin(2 * np.pi * 250 * t), 0.003 * np.sin(2 * np.pi * 60 * t)
    assert measure(felt + faint, felt, RATE_HZ, "um").third_octave_distance_db == pytest.approx(0, abs=0.01)
    halves = [measure(level * felt, 0 * felt, RATE_HZ, "um").third_octave_distance_db for level in (1.0, 0.5)]
    assert halves[0] is not None and halves[1] is not None and halves[0] > halves[1] > 0
    assert measure(faint, felt * 0, RATE_HZ, "um").third_octave_distance_db is None


@given(seed=st.integers(0, 1000), samples=st.integers(512, 1500), error=st.floats(0.01, 2))
def test_as_the_authors_code_on_signals_without_silence(seed: int, samples: int, error: float) -> None:
    x = noise(samples, seed)
    y = x + error * noise(samples, seed + 1)
    quality = measure(x, y, RATE_HZ)
    assert quality.snr_db == codec.snr_db(x, y)
    assert quality.spqi == pytest.approx(spqi(y[:, 0], x[:, 0]), rel=1e-12)
    assert quality.st_sim_8000 == pytest.approx(st_sim(y[:, 0], x[:, 0]), rel=1e-12)


@given(seed=st.integers(0, 1000), samples=st.integers(1, 1500), channels=st.integers(1, 3))
def test_a_copy_has_the_best_values(seed: int, samples: int, channels: int) -> None:
    x = np.random.default_rng(seed).normal(size=(samples, channels))
    similarity = 1.0 if samples >= BLOCK_SAMPLES else None
    distance_db = 0.0 if samples >= 280 else None
    scores = (math.inf, math.inf, similarity, similarity, similarity, distance_db, distance_db)
    assert measure(x, x, RATE_HZ) == Quality(*scores)


def test_sign_is_nothing_to_a_spectrum() -> None:
    """The mean correlation is -1, whose power 2/3 is complex."""
    flipped = measure(noise(), -noise(), RATE_HZ)
    assert (flipped.st_sim_2800, flipped.st_sim_8000) == (0.0, 0.0)
    assert flipped.spqi == pytest.approx(1)
    assert flipped.log_spectral_distance_db == flipped.third_octave_distance_db == 0


def test_silence_decoded_from_sound() -> None:
    lost = measure(noise(), 0 * noise(), RATE_HZ)
    assert (lost.snr_db, lost.st_sim_2800, lost.st_sim_8000) == (0.0, 0.0, 0.0)
    assert lost.spqi == pytest.approx((1 - math.tanh(2)) / 2)


def test_silent_blocks_of_the_reference_are_left_out() -> None:
    good = measure(tones()[:2048], np.round(16 * tones()[:2048]) / 16, RATE_HZ)
    x = np.concatenate([np.zeros((512, 1)), tones()[:2048], np.full((512, 1), 0.25), 1e-9 * noise(512)])
    y = np.concatenate([1e-3 * noise(512), np.round(16 * tones()[:2048]) / 16, np.full((1024, 1), 0.25)])
    padded = measure(x, y, RATE_HZ)
    assert (padded.st_sim_2800, padded.st_sim_8000, padded.spqi) == (good.st_sim_2800, good.st_sim_8000, good.spqi)
    assert padded.snr_db is not None and good.snr_db is not None
    assert padded.snr_db < good.snr_db - 10


def test_silent_frames_of_the_reference_are_left_out_of_the_spectral_distance() -> None:
    """All but the frames that the sound reaches into, where both differ by its gain again."""
    x = np.concatenate([np.zeros((2800, 1)), noise(2800), np.zeros((2800, 1))])
    assert measure(x, 2 * x, RATE_HZ).log_spectral_distance_db == pytest.approx(20 * math.log10(2))


def test_channels_count_alike_and_silent_ones_not() -> None:
    x = np.concatenate([noise(seed=0), np.zeros((2048, 1)), 1000 * noise(seed=1)], axis=1)
    y = x + 0.1 * np.concatenate([noise(seed=2), noise(seed=3), 5000 * noise(seed=4)], axis=1)
    each = [astuple(measure(x[:, [channel]], y[:, [channel]], RATE_HZ)) for channel in (0, 2)]
    assert close(measure(x, y, RATE_HZ), Quality(*np.mean(each, axis=0)))
    assert measure(x[:, [1]], y[:, [1]], RATE_HZ) == NOTHING


@given(exponent=st.integers(-3, 60), seed=st.integers(0, 100))
def test_level_changes_only_what_is_compared_with_thresholds(exponent: int, seed: int) -> None:
    x, y = noise(seed=seed), noise(seed=seed) + 0.3 * noise(seed=seed + 1)
    here, there = measure(x, y, RATE_HZ), measure(2.0**exponent * x, 2.0**exponent * y, RATE_HZ)
    for name in ("snr_db", "psnr_db", "spqi", "log_spectral_distance_db", "third_octave_distance_db"):
        assert getattr(there, name) == pytest.approx(getattr(here, name))
    assert there.st_sim_8000 is not None and there.st_sim_8000 > 0.5


@pytest.mark.parametrize(("rate_hz", "known"), [(2.0, False), (60.0, False), (100.0, True), (1e3, True), (48e3, False)])
def test_spectral_distance_needs_a_frame_and_a_bin(rate_hz: float, known: bool) -> None:
    quality = measure(noise(), noise(seed=1), rate_hz)
    assert (quality.log_spectral_distance_db is not None) == known
    assert quality.spqi is not None


@pytest.mark.parametrize("constant", [1.0, -0.1])
def test_a_reference_that_never_varies_has_no_similarity(constant: float) -> None:
    x = np.full((2048, 1), constant)
    quality = measure(x, x + 0.01 * noise(), RATE_HZ)
    assert (quality.st_sim_2800, quality.st_sim_8000, quality.spqi) == (None, None, None)
    assert quality.log_spectral_distance_db is None
    assert quality.snr_db == quality.psnr_db


@pytest.mark.parametrize(
    ("reference", "decoded", "rate_hz", "message"),
    [
        (noise(), noise(2047), RATE_HZ, "delay"),
        (noise()[:, 0], noise()[:, 0], RATE_HZ, r"\(n, channels\)"),
        (noise(), noise() * np.nan, RATE_HZ, "decoded signal holds NaN"),
        (noise() * np.inf, noise(), RATE_HZ, "reference holds NaN, infinity"),
        (noise() * 1e40, noise(), RATE_HZ, "above 2\\^127"),
        (noise() * 1e-40, noise(), RATE_HZ, "another unit"),
        (noise(), noise(), 0.0, "positive"),
        (noise(), noise(), math.nan, "positive"),
    ],
)
def test_rejected_with_what_to_do(reference: Signal, decoded: Signal, rate_hz: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure(reference, decoded, rate_hz)


@given(
    values=st.lists(st.floats(-(2.0**127), 2.0**127), min_size=2, max_size=40),
    samples=st.integers(0, 1200),
    rate_hz=st.floats(0.1, 1e6),
)
@pytest.mark.filterwarnings("error")
def test_any_numbers_have_values_or_are_rejected(values: list[float], samples: int, rate_hz: float) -> None:
    x, y = np.resize(values, (samples, 1)), np.resize(values[::-1], (samples, 1))
    try:
        quality = measure(x, y, rate_hz)
    except ValueError as error:
        assert "unit" in str(error)
        return
    assert not any(value is not None and math.isnan(value) for value in astuple(quality))
    assert samples or quality == NOTHING
