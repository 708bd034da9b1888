"""The quality meter of decoded packets: the SNR, eased for quiet packets."""

import numpy as np
import pytest

from vibrocast.codec import SnrMeter

RATE_HZ = 2800
PACKET = 140


def noise(level: float, seed: int = 0) -> np.ndarray:
    return level * np.random.default_rng(seed).standard_normal((PACKET, 2))


def test_a_pause_after_a_loud_texture_needs_little_quality_and_soon_its_own() -> None:
    meter = SnrMeter(RATE_HZ)
    for _ in range(40):
        meter.update(noise(0.1))
    pause, error = noise(1e-4, 1), noise(1e-4, 2)
    held_db = meter.quality_db(pause, pause + error)
    assert held_db == pytest.approx(60 - 20, abs=2)
    for _ in range(60):  # 3 s
        meter.update(pause)
    assert meter.quality_db(pause, pause + error) == pytest.approx(0, abs=2)


def test_digital_silence_is_good_enough_however_coarse() -> None:
    silence = np.zeros((PACKET, 2))
    assert SnrMeter(RATE_HZ).quality_db(silence, silence) > 10
    assert SnrMeter(RATE_HZ).quality_db(silence, silence + 0.1) < -50
