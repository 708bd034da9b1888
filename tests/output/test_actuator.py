"""The actuators' response, its inverse and the limits that follow from their descriptions."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from vibrocast.output.actuator import (
    ACTUATORS,
    LRA,
    PIEZO_STACK,
    Actuator,
    Samples,
)


def gain_at(coefficients: tuple[np.ndarray, np.ndarray], frequency_hz: float, rate_hz: float) -> float:
    _, response = signal.freqz(*coefficients, worN=[frequency_hz], fs=rate_hz)
    return float(abs(response[0]))


def test_piezo_stack_is_that_of_the_paper() -> None:
    rate_hz = 300_000.0
    assert PIEZO_STACK.excursion_um == 40.0
    assert gain_at(PIEZO_STACK.response(rate_hz), 1.0, rate_hz) == pytest.approx(1.0, abs=1e-4)
    assert gain_at(PIEZO_STACK.response(rate_hz), 270.0, rate_hz) == pytest.approx(2**-0.5, abs=1e-3)
    assert gain_at(PIEZO_STACK.response(rate_hz), 400.0, rate_hz) == pytest.approx(0.559, abs=1e-3)


def test_a_resonant_actuator_peaks_at_its_resonance_by_its_stroke() -> None:
    rate_hz = 800_000.0
    frequencies_hz = np.linspace(50.0, 400.0, 351)
    _, response = signal.freqz(*LRA.response(rate_hz), worN=frequencies_hz, fs=rate_hz)
    gains = np.abs(response)
    assert frequencies_hz[int(np.argmax(gains))] == pytest.approx(LRA.corner_hz, abs=1.0)
    assert max(gains) == pytest.approx(1.0, rel=2e-3)
    lower_hz, upper_hz = LRA.band_hz
    assert upper_hz - lower_hz == pytest.approx(LRA.corner_hz / 15.0)


def followed(actuator: Actuator, frequencies_hz: Samples) -> NDArray[np.complex128]:
    """The fundamental of the compensated displacement, between the DAC's samples too, over that asked for.

    Multiples of 20 Hz, and rates of which each has whole samples in 50 ms. The first 150 ms settle.
    """
    rate_hz, oversampling, asked = actuator.dac_rate_hz, 16, 0.05
    seconds = np.arange(rate_hz // 5 * oversampling)[:, None] / (rate_hz * oversampling)
    wanted = asked * np.sin(2 * np.pi * frequencies_hz * seconds[::oversampling])
    drive = signal.lfilter(*actuator.inverse(), wanted, axis=0)
    codes = np.rint(drive * actuator.full_scale).astype(np.int16)
    skin = actuator.displacement_um(codes, oversampling) / actuator.excursion_um
    settled = slice(len(skin) * 3 // 4, None)
    turning = np.exp(-2j * np.pi * frequencies_hz * seconds[settled])
    return np.asarray(2j * np.mean(skin[settled] * turning, axis=0) / asked)


@pytest.mark.parametrize("dac_rate_hz", [1000, 2000, 3000, 8000, 48_000])
@pytest.mark.parametrize("corner_hz", [100.0, 270.0, 1000.0, 5000.0])
def test_compensated_displacement_follows_between_the_samples_too(corner_hz: float, dac_rate_hz: int) -> None:
    actuator = replace(PIEZO_STACK, corner_hz=corner_hz, dac_rate_hz=dac_rate_hz)
    gains = np.abs(followed(actuator, np.arange(20.0, min(400, dac_rate_hz / 5) + 1, 20.0)))
    assert np.abs(20 * np.log10(gains)).max() < 0.07
    assert 20 * np.log10(gains[-1]) == pytest.approx(0.0, abs=0.01)


def test_compensated_piezo_stack_follows_up_to_400_hz() -> None:
    rate_hz = PIEZO_STACK.dac_rate_hz
    frequencies_hz = np.arange(20.0, 401.0, 20.0)
    gains = followed(PIEZO_STACK, frequencies_hz)
    assert np.abs(20 * np.log10(np.abs(gains))).max() < 0.06
    assert np.abs(gains * np.exp(2j * np.pi * frequencies_hz / rate_hz * 1.7) - 1).max() < 0.032
    delay_samples = -np.angle(gains[0]) / (2 * np.pi * frequencies_hz[0] / rate_hz)
    # The hold, the response and its inverse: 1 - d / 12 samples, d = 2 pi corner / rate.
    beside = 1 - 2 * np.pi * PIEZO_STACK.corner_hz / rate_hz / 12
    assert delay_samples == pytest.approx(beside + PIEZO_STACK.low_pass_delay_seconds * rate_hz, abs=1e-3)


def test_compensation_does_not_boost_what_is_not_felt() -> None:
    _, inverse = signal.freqz(*PIEZO_STACK.inverse(), worN=np.arange(1.0, 1500.0), fs=PIEZO_STACK.dac_rate_hz)
    assert np.abs(inverse).max() < 2.31
    assert np.abs(inverse[1200:]).max() < 1.0


@pytest.mark.parametrize("actuator", [LRA, ACTUATORS["voice-coil"]], ids=lambda actuator: actuator.name)
def test_compensation_of_a_resonance_is_bounded_and_broadens_it(actuator: Actuator) -> None:
    inverse = actuator.inverse()
    _, response = signal.freqz(*inverse, worN=500)
    assert np.abs(response).max() <= actuator.maximum_boost * (1 + 1e-9)
    assert gain_at(inverse, actuator.corner_hz, actuator.dac_rate_hz) == pytest.approx(1.0, rel=1e-9)
    beside_hz = 1.2 * actuator.corner_hz
    bare = gain_at(actuator.response(actuator.dac_rate_hz), beside_hz, actuator.dac_rate_hz)
    compensated = bare * gain_at(inverse, beside_hz, actuator.dac_rate_hz)
    assert bare < compensated <= 1.0


def test_limits_in_codes() -> None:
    assert PIEZO_STACK.code_limit == 32767
    assert replace(PIEZO_STACK, volts_limit=37.5).code_limit == 16384
    assert PIEZO_STACK.code_step_limit == 32768 * 100 // 75
    assert replace(PIEZO_STACK, dac_bits=12, volts_limit=37.5).code_limit == 1024


@pytest.mark.parametrize("actuator", ACTUATORS.values(), ids=lambda actuator: actuator.name)
@pytest.mark.parametrize("volts", [0.5, 3.7, 200.0])
def test_another_full_scale_is_the_same_actuator_in_volts(actuator: Actuator, volts: float) -> None:
    other = actuator.with_full_scale(volts)
    volts_now = np.linspace(0.0, min(volts, actuator.volts / 2), 50)[:, None] * 0.99

    def moved_um(each: Actuator) -> Samples:
        codes = np.rint(volts_now / (each.volts / 2) * each.full_scale).astype(np.int16)
        return each.displacement_um(codes)

    step_um = max(each.excursion_um / each.full_scale for each in (actuator, other))
    np.testing.assert_allclose(moved_um(other), moved_um(actuator), atol=3 * step_um)
    assert other.volts_limit == actuator.volts_limit
    assert other.slew_volts_per_second == actuator.slew_volts_per_second
    squared_volts = actuator.power_limit * (actuator.volts / 2) ** 2
    assert other.power_limit == pytest.approx(min(1.0, squared_volts / volts**2))
    assert actuator.with_full_scale(actuator.volts / 2) == actuator
