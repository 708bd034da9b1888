"""Quality meters of decoded packets: the SNR, eased for quiet packets, and the level of the error."""

import numpy as np
import pytest

from vibrocast.codec import CodecError, SignalFormat, SnrMeter, ThresholdMeter
from vibrocast.codec.threshold import read_threshold, threshold_amplitude

RATE_HZ = 2800
PACKET = 140


def noise(level: float, seed: int = 0) -> np.ndarray:
    return level * np.random.default_rng(seed).standard_normal((PACKET, 2))


def test_a_pause_after_a_loud_texture_needs_little_quality_and_soon_its_own() -> None:
    meter = SnrMeter(RATE_HZ)
    for _ in range(40):
        meter.update(noise(0.1), noise(0.1))
    pause, error = noise(1e-4, 1), noise(1e-4, 2)
    held_db = meter.quality_db(pause, pause + error)
    assert held_db == pytest.approx(60 - 20, abs=2)
    for _ in range(60):  # 3 s
        meter.update(pause, pause)
    assert meter.quality_db(pause, pause + error) == pytest.approx(0, abs=2)


def test_digital_silence_is_good_enough_however_coarse() -> None:
    silence = np.zeros((PACKET, 2))
    assert SnrMeter(RATE_HZ).quality_db(silence, silence) > 10
    assert SnrMeter(RATE_HZ).quality_db(silence, silence + 0.1) < -50


@pytest.mark.parametrize("unit", ["um", "m/s^2"])
@pytest.mark.parametrize("frequency_hz", [100, 250, 500])
def test_a_sinusoid_at_the_threshold_is_at_zero_db(unit: str, frequency_hz: float) -> None:
    format = SignalFormat(RATE_HZ, unit, (8.0, 8.0), (0.1, 0.1))
    amplitude = threshold_amplitude(read_threshold(), np.array([frequency_hz], dtype=float), unit)[0]
    error = amplitude / 8 * np.sin(2 * np.pi * frequency_hz * np.arange(RATE_HZ) / RATE_HZ)[:, None] * [1, 0.1]
    meter = ThresholdMeter(format)
    assert meter.quality_db(error, np.zeros_like(error)) == pytest.approx(0, abs=2)
    assert meter.quality_db(error, 0.9 * error) == pytest.approx(meter.quality_db(error, 0 * error) + 20, abs=0.01)


def test_a_signal_without_a_physical_unit_has_no_threshold() -> None:
    with pytest.raises(CodecError, match="give `unit` and `full_scale`"):
        ThresholdMeter(SignalFormat(RATE_HZ, "full scale", (1.0,), (0.1,)))
