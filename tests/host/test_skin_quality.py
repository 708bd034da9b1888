"""Quality at the skin: true figures where the codec or the actuator changes low frequencies, and who limits it."""

import numpy as np
import pytest

import vibrocast
from tests.conftest import RATE_HZ, linked, noise, texture
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.threshold import PHYSICAL_UNITS, felt_error, read_threshold, skin_snr_db, threshold_amplitude
from vibrocast.host import playback
from vibrocast.host.devices import session_with
from vibrocast.host.playback import AlignmentError, compare_channels, compare_skin, limit_note
from vibrocast.output.actuator import ACTUATORS, PIEZO_STACK, VOICE_COIL, followed_band_hz, octave_gains_db
from vibrocast.simulated_device.controller import Settings

TIME_S = np.arange(4 * RATE_HZ) / RATE_HZ


def tone(frequency_hz: float, amplitude: float) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * frequency_hz * TIME_S)


def test_an_error_at_low_frequencies_does_not_count_where_touch_is_sensitive() -> None:
    sent, decoded = tone(25, 5) + tone(200, 1), tone(25, 2) + tone(200, 1)
    quality, laid, _ = compare_skin(sent, decoded, decoded, RATE_HZ, perceptual=False)
    weighted_db = skin_snr_db(sent[:, None], decoded[:, None], RATE_HZ, "um", read_threshold())
    assert weighted_db == pytest.approx(26.3, abs=0.1)
    assert quality.weighted_snr_db == pytest.approx(weighted_db, abs=0.05)
    assert quality.snr_db == pytest.approx(quality.decoded_snr_db, abs=0.05)
    assert quality.gain == pytest.approx(1, abs=1e-3)
    assert laid.drift_ppm == 0
    assert quality.weighted_playing_snr_db is None or quality.weighted_playing_snr_db > 60


@pytest.mark.parametrize("gain", [0.25, -3.0])
def test_lag_and_gain_are_those_of_playing_alone(gain: float) -> None:
    rng = np.random.default_rng(1)
    decoded = rng.standard_normal(3 * RATE_HZ)
    sent = decoded + 0.3 * rng.standard_normal(3 * RATE_HZ)
    skin = gain * np.concatenate([np.zeros(28), decoded])
    quality, laid, aligned = compare_skin(sent, decoded, skin, RATE_HZ, perceptual=False)
    assert quality.gain == pytest.approx(gain, rel=1e-3)
    assert laid.lag_s == pytest.approx(0.01, abs=1e-5)
    assert quality.weighted_snr_db == pytest.approx(quality.weighted_decoded_snr_db, abs=0.1)
    assert np.std(aligned[100:-100] - decoded[100:-100]) < 0.05


def test_a_texture_that_is_cut_in_its_movement_is_aligned() -> None:
    """A step at the end would outweigh what touch is sensitive to."""
    moved = tone(25, 20) + tone(190, 0.1)
    skin = np.concatenate([moved, np.zeros(RATE_HZ)])
    quality, *_ = compare_skin(moved[:9000], moved[:9000], skin[:9000], RATE_HZ, perceptual=False)
    assert abs(moved[8999]) > 5
    assert quality.gain == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("rate_hz", [2800, 2000, 997])
def test_any_length_of_a_recording_is_compared(rate_hz: int) -> None:
    """The duration in seconds times the rate need not give the number of samples again."""
    for samples in (7593, 1999, 333):
        encoding = encode_recording(texture(noise(samples / RATE_HZ), "m/s^2", rate_hz), rate_hz, live=True)
        outcome = playback.play(session_with(linked()[1], "sim"), "odd", encoding.stream, encoding)
        assert outcome.report.quality.felt_error is not None


def test_a_skin_that_does_not_follow_has_no_figures() -> None:
    rng = np.random.default_rng(2)
    decoded, other = rng.standard_normal((2, RATE_HZ))
    with pytest.raises(AlignmentError, match="does not contain the texture"):
        compare_skin(None, decoded, other, RATE_HZ)
    assert compare_channels([decoded[:, None]], RATE_HZ, np.zeros((4 * RATE_HZ, 1)), 4.0 * RATE_HZ) is None


@pytest.mark.parametrize("actuator", ACTUATORS)
def test_a_resonance_is_aligned_where_it_moves_as_asked(actuator: str) -> None:
    """An LRA or a voice coil follows part of the band only: the aligner must not leave the right place."""
    samples = np.cumsum(noise(2.0, seed=3))
    samples -= np.linspace(samples[0], samples[-1], len(samples))
    encoding = encode_recording(texture(samples / 20, "m/s^2"), live=True)
    _, controller = linked(Settings(actuator=ACTUATORS[actuator]))
    report = playback.play(session_with(controller, "sim"), "rough", encoding.stream, encoding).report
    skin = report.quality.skin
    assert skin is not None and skin.gain is not None and skin.weighted_playing_snr_db is not None
    assert 0.2 < skin.gain < 2
    assert report.actuator.follows_hz == followed_band_hz(ACTUATORS[actuator])
    assert (skin.weighted_playing_snr_db > 20) == (actuator == "piezo-stack")
    assert skin.weighted_playing_snr_db > 3


def test_the_actuator_is_named_where_it_is_the_limit() -> None:
    sent, decoded = tone(90, 2) + tone(300, 0.5), tone(90, 2.02) + tone(300, 0.5)
    heard, *_ = compare_skin(sent, decoded, tone(90, 2) + tone(300, 0.1), RATE_HZ, perceptual=False)
    gains_db = octave_gains_db(VOICE_COIL)
    assert limit_note(heard, gains_db, 0) == (
        "the actuator is the limit: +6 dB at 31.5 Hz, +3 dB at 63 Hz, -3 dB at 125 Hz, -11 dB at 250 Hz, "
        "-22 dB at 500 Hz"
    )
    assert (limit_note(heard, gains_db, 7) or "").endswith("-22 dB at 500 Hz, its limits held back 7 DAC samples")
    assert limit_note(heard, {"250": -0.4}, 0) == "the actuator is the limit: it begins and ends at rest"
    exact, *_ = compare_skin(sent, decoded, decoded, RATE_HZ, perceptual=False)
    assert limit_note(exact, octave_gains_db(PIEZO_STACK), 0) is None


@pytest.mark.parametrize("unit", PHYSICAL_UNITS)
def test_the_error_that_is_felt_is_stated_beside_the_texture(unit: str) -> None:
    (least,) = threshold_amplitude(read_threshold(), np.array([250.0]), unit)
    texture, error = tone(250, 20 * least)[:, None], tone(250, 2 * least)[:, None]
    found = felt_error(texture, texture + error, RATE_HZ, unit)
    assert found is not None
    assert found.level_db == pytest.approx(6, abs=0.6)
    assert found.texture_db == pytest.approx(26, abs=0.6)
    assert found.frequency_hz == pytest.approx(250, rel=0.15)
    assert felt_error(texture, texture, RATE_HZ, unit) is None


def test_energy_above_the_band_is_stated() -> None:
    """Of noise from 1.5 kHz on, almost nothing is left at 2800 Hz."""
    from scipy.signal import butter, sosfilt

    noise = np.random.default_rng(4).standard_normal(20000)
    high = sosfilt(butter(6, 1500, "high", fs=10000, output="sos"), noise)
    quality = vibrocast.encode(high, rate_hz=10000, unit="m/s^2", snr_db=15).quality
    assert quality is not None
    assert quality.lowpass_hz == 1400
    assert quality.removed_above == pytest.approx(0.995, abs=0.01)
    low = sosfilt(butter(6, 500, fs=10000, output="sos"), noise)
    kept = vibrocast.encode(low, rate_hz=10000, unit="m/s^2", snr_db=15).quality
    assert kept is not None and kept.removed_above < 0.005
