"""The high-pass before coding: an offset, gravity and drift vanish, and the band of touch stays as it is."""

import numpy as np
import pytest

from vibrocast.textures import HIGHPASS_HZ, LiveHighPass, Recording, TextureError, highpass

RATE_HZ = 2800.0
TIMES_S = np.arange(28_000)[:, None] / RATE_HZ


def acceleration(samples: np.ndarray, unit: str = "m/s^2", rate_hz: float = RATE_HZ) -> Recording:
    return Recording(samples, rate_hz, unit, "texture")


@pytest.mark.parametrize(("frequency_hz", "gain"), [(5, 0), (10, 0), (18, 0), (20, 1), (40, 1), (800, 1)])
def test_keeps_the_band_from_the_corner_on(frequency_hz: float, gain: float) -> None:
    tone = np.sin(2 * np.pi * frequency_hz * TIMES_S)
    passed = highpass(acceleration(tone)).recording.samples
    np.testing.assert_allclose(passed[9000:-9000], gain * tone[9000:-9000], atol=3e-3)


@pytest.mark.parametrize("added", [9.81, -1e3 * TIMES_S, 9.81 + 20 * TIMES_S], ids=["gravity", "ramp", "both"])
@pytest.mark.parametrize("count", [1, 2, 100, 28_000])
def test_an_offset_and_a_ramp_change_nothing(added: np.ndarray, count: int) -> None:
    noise = np.random.default_rng(0).normal(size=(count, 2))
    clean = highpass(acceleration(noise))
    moved = highpass(acceleration(noise + np.broadcast_to(added, TIMES_S.shape)[:count]))
    np.testing.assert_allclose(moved.recording.samples, clean.recording.samples, atol=1e-9)
    assert moved.highpass_hz == HIGHPASS_HZ


def test_states_the_energy_removed() -> None:
    noise = np.random.default_rng(0).normal(size=TIMES_S.shape)
    assert highpass(acceleration(noise + 9.81)).removed_energy == pytest.approx(9.81**2 / (9.81**2 + 1), abs=2e-3)
    assert highpass(acceleration(np.zeros((9, 1)))).removed_energy == 0.0


def test_a_constant_is_silence_and_not_the_rounding_of_it() -> None:
    passed = highpass(acceleration(np.full((5000, 1), 9.81))).recording.samples
    assert not np.any(passed)


def test_a_position_is_kept_and_an_acceleration_on_request() -> None:
    recording = acceleration(np.ones((9, 1)), "um")
    assert highpass(recording).recording is recording
    assert highpass(recording).highpass_hz is None
    recording = acceleration(np.ones((9, 1)))
    assert highpass(recording, None).recording is recording


@pytest.mark.parametrize("corner_hz", [0.0, -1.0, RATE_HZ / 2, float("nan")])
def test_a_corner_outside_the_band_is_an_error(corner_hz: float) -> None:
    with pytest.raises(TextureError, match="no high-pass of"):
        highpass(acceleration(np.ones((9, 1))), corner_hz)
    with pytest.raises(TextureError, match="no high-pass of"):
        LiveHighPass(RATE_HZ, corner_hz)


def test_live_blocks_begin_at_rest_and_are_filtered_as_one() -> None:
    tone = 9.81 + np.sin(2 * np.pi * 100 * TIMES_S)
    blocks, whole = LiveHighPass(RATE_HZ), LiveHighPass(RATE_HZ)
    pieces = [blocks(piece) for piece in np.split(tone, [0, 7, 1000])]
    np.testing.assert_allclose(np.concatenate(pieces), whole(tone), atol=1e-12)
    assert np.max(np.abs(LiveHighPass(RATE_HZ)(np.full((100, 1), 9.81)))) < 1e-9
    np.testing.assert_allclose(np.max(np.abs(pieces[-1][-2800:])), 1, atol=0.02)


@pytest.mark.parametrize("drift", [0.0, 5.0])
def test_the_place_where_a_recording_was_cut_has_no_effect(drift: float) -> None:
    long = np.random.default_rng(5).standard_normal((8 * 2800, 1))
    long += drift * np.sin(2 * np.pi * np.arange(len(long)) / 2800)[:, None]  # 1 Hz
    whole = highpass(acceleration(long)).recording.samples
    errors = [
        highpass(acceleration(long[start : start + 2800])).recording.samples - whole[start : start + 2800]
        for start in range(2800, 6 * 2800, 311)
    ]
    assert np.mean(np.square(errors)) < 10 ** (-28 / 10), "through their last sample the ends leave -20 dB"
