"""Tests of doubts: samples at a limit, samples that stand still, and recordings that nobody would feel."""

import numpy as np
import pytest

from vibrocast.textures import GENERATORS, Recording
from vibrocast.textures.doubts import doubts_of
from vibrocast.textures.recording import Signal

RATE_HZ = 2000
TIME_S = np.arange(2 * RATE_HZ) / RATE_HZ
NOISE = np.random.default_rng(3).normal(size=(len(TIME_S), 3))


def doubts(samples: Signal, rate_hz: float = RATE_HZ, unit: str = "m/s^2") -> str:
    return "\n".join(doubts_of(Recording(samples.reshape(len(samples), -1), rate_hz, unit, "file")))


@pytest.mark.parametrize(
    "samples",
    [
        np.clip(NOISE[:, 0] + np.sin(300 * TIME_S), -9, 1.5),  # at the upper end
        np.clip(np.round(3 * np.sin(400 * TIME_S) + NOISE[:, 1], 2), -2, 2),  # at both, with few digits
        np.column_stack([NOISE[:, 0], np.clip(4 * np.sin(500 * TIME_S), -3, 9) + 9.81]),  # only channel 2
    ],
)
def test_samples_at_the_limit_of_a_sensor(samples: Signal) -> None:
    assert "the sensor's limit?" in doubts(samples)


@pytest.mark.parametrize(
    "samples",
    [
        NOISE,
        np.round(100 * np.sin(200 * TIME_S)),  # few levels, each for long
        np.round(32767 * np.sin(250 * TIME_S)),
        np.sign(np.sin(700 * TIME_S)),  # a switch
        np.zeros(100),
        np.where(TIME_S < 1, 0, NOISE[:, 0]),  # silence before a touch
        np.round(NOISE[:, 0] + 9.81),  # coarse
    ],
)
def test_sound_recordings_raise_no_doubt(samples: Signal) -> None:
    assert doubts(samples) == ""


@pytest.mark.parametrize("kind", sorted(GENERATORS))
def test_generated_textures_raise_no_doubt(kind: str) -> None:
    assert doubts_of(GENERATORS[kind](seed=1, seconds=1.0, hand_speed_mm_s=50.0)) == ()


def test_stretches_of_equal_samples() -> None:
    held, dropped = NOISE.copy(), NOISE + 9.81
    held[600:700] = held[600]
    dropped[3000:3200] = 0
    dropped[100] = -30
    assert "1 stretch(es) of equal samples, the longest of 0.0495 s at 0.300 s" in doubts(held)
    assert "the longest of 0.0995 s at 1.500 s" in doubts(dropped)
    assert "50% of the samples repeat the one before" in doubts(np.repeat(NOISE[::2], 2, axis=0))
    assert "66% of the samples repeat" in doubts(np.repeat(NOISE[: len(NOISE) // 3], 3, axis=0))


def test_recordings_without_energy_in_the_band_of_touch() -> None:
    slow = 3 * np.sin(2 * np.pi * 2 * TIME_S) + 9.81
    assert "is above 20 Hz, where touch feels it" in doubts(slow + 1e-3 * NOISE[:, 0])
    assert "all samples are equal" in doubts(np.full(4000, 9.81))
    assert "50 Hz hold nothing above 25 Hz" in doubts(NOISE, 50)
    assert doubts(slow + 0.3 * NOISE[:, 0]) == ""
    assert doubts(slow, unit="um") == ""  # a position
