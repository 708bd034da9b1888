"""The band worth coding: what is felt, what can be made, and the rate that follows."""

from pathlib import Path

import numpy as np
import pytest

from vibrocast.codec.threshold import over_threshold_db, read_threshold, sites, threshold_amplitude
from vibrocast.errors import InputError
from vibrocast.output.actuator import LRA, PIEZO_STACK
from vibrocast.planner.band import MARGIN_DB, band_of, error_over_threshold_db, max_um
from vibrocast.textures import Profile, Recording

THRESHOLD = read_threshold()


def tone(frequency_hz: float, over_db: float, rate_hz: float = 4000) -> Recording:
    """A second of a tone so far above the detection threshold, in um."""
    (min_um,) = threshold_amplitude(THRESHOLD, np.array([frequency_hz]), "um")
    samples = min_um * 10 ** (over_db / 20) * np.sin(2 * np.pi * frequency_hz * np.arange(rate_hz) / rate_hz)
    return Recording(samples[:, None], rate_hz, "um", "tone")


@pytest.mark.parametrize("frequency_hz", [50.0, 200.0, 400.0])
def test_a_tone_is_as_far_above_the_threshold_as_it_was_made(frequency_hz: float) -> None:
    frequencies_hz, levels_db = over_threshold_db(tone(frequency_hz, 6.0).samples, 4000, THRESHOLD)
    at = int(np.argmin(np.abs(frequencies_hz - frequency_hz)))
    assert levels_db[at] == pytest.approx(6.0, abs=1.0)


def test_components_below_the_limit_are_dropped_and_those_just_above_kept() -> None:
    strong = tone(100.0, 20.0)
    for over_db, kept in ((MARGIN_DB + 2, True), (MARGIN_DB - 2, False)):
        both = Recording(strong.samples + tone(500.0, over_db).samples, 4000, "um", "both")
        band = band_of(both, PIEZO_STACK, THRESHOLD, (50, 50), False)
        assert (band.highest >= 500) == kept, over_db
        assert band.rate >= 2 * band.highest and band.lowest < 100


def test_the_rate_is_never_above_the_recordings_nor_below_what_controllers_play() -> None:
    noise = np.random.default_rng(0).normal(size=(1000, 1))
    assert band_of(Recording(noise, 700, "um", "noise"), PIEZO_STACK, THRESHOLD, (50, 50), False).rate == 700
    click = Recording(np.ones((1, 1)), 2800, "full scale", "click")
    assert band_of(click, PIEZO_STACK, THRESHOLD, (50, 50), False).rate >= 100
    with pytest.raises(InputError, match="recorded at 25 Hz, but controllers play at least 100 Hz"):
        band_of(Recording(np.ones((9, 1)), 25, "full scale", "slow"), PIEZO_STACK, THRESHOLD, (50, 50), False)


def test_what_the_actuator_cannot_make_is_not_worth_coding() -> None:
    felt = tone(40.0, 30.0)
    assert band_of(felt, PIEZO_STACK, THRESHOLD, (50, 50), False).highest > 40
    weak = type(LRA)(**{**vars(LRA), "stroke_um": 0.1})
    with pytest.raises(InputError, match="at best, the actuator's reach lies"):
        band_of(felt, weak, THRESHOLD, (50, 50), False)


def test_stroke_voltage_and_slew_limit_what_can_be_made() -> None:
    frequencies_hz = np.array([20.0, 270.0, 1000.0])
    free = max_um(PIEZO_STACK, frequencies_hz)
    assert free[0] == pytest.approx(40.0, rel=0.01) and free[1] == pytest.approx(40 / np.sqrt(2), rel=0.02)
    slow = type(PIEZO_STACK)(**{**vars(PIEZO_STACK), "slew_volts_per_second": 75 * 2 * np.pi * 500})
    assert max_um(slow, frequencies_hz)[2] == pytest.approx(free[2] * 75 * 2 * np.pi * 500 / 300_000, rel=0.01)
    half = type(PIEZO_STACK)(**{**vars(PIEZO_STACK), "volts_limit": 37.5})
    assert max_um(half, frequencies_hz)[0] == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize(
    ("at_hz", "texture_db", "error_db", "felt_db"),
    [
        (100.0, 40.0, 20.0, 20.0 - (40.0 - 6.8)),  # hidden by a texture in the same third octave
        (100.0, 5.0, 3.0, 3.0),  # a texture near the threshold hides nothing
        (300.0, 40.0, 20.0, 20.0),  # and one elsewhere neither
        (100.0, -200.0, 6.0, 6.0),
    ],
)
def test_a_texture_masks_errors_in_its_own_third_octave(
    at_hz: float, texture_db: float, error_db: float, felt_db: float
) -> None:
    texture, error = tone(at_hz, texture_db), tone(100.0, error_db)
    decoded = texture.samples - error.samples
    assert error_over_threshold_db(texture, decoded, PIEZO_STACK, THRESHOLD) == pytest.approx(felt_db, abs=1)


def test_a_texture_masks_only_while_it_lasts() -> None:
    texture, error = tone(100.0, 40.0), tone(100.0, 20.0)
    texture.samples[1000:] = 0
    decoded = texture.samples - error.samples
    assert error_over_threshold_db(texture, decoded, PIEZO_STACK, THRESHOLD) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("path", sites().values(), ids=sites())
def test_thresholds_of_other_sites_can_be_read(path: Path) -> None:
    rows = read_threshold(path)
    assert rows[0, 0] == 1
    assert np.all((rows[:, 1] > -30) & (rows[:, 1] < 45))
    assert path.read_text().startswith("# Detection threshold")


def test_a_profile_over_position_is_coded_for_its_slowest_and_its_fastest_hand() -> None:
    positions_mm = np.arange(4000) * 0.005
    heights_um = 5 * np.sin(2 * np.pi * positions_mm / 0.5)  # 2 periods per mm
    profile = Profile(heights_um, 5.0, "grating")
    band = band_of(profile, PIEZO_STACK, THRESHOLD, (20, 200), True)
    assert band.lowest <= 2000 <= band.highest
    assert 2 * band.highest <= band.rate <= 200_000
