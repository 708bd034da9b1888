"""Live sources at an address: which one opens, in which format it is streamed, and how sound is played."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from vibrocast.host import sources
from vibrocast.host.sources import SoundInput
from vibrocast.output import sound_card
from vibrocast.textures import TextureError
from vibrocast.textures.recording import Signal
from vibrocast.textures.sensitivity import Sensitivity

RATE_HZ = 2800


class Card:
    """A sound card that brings blocks of 10 ms of samples (n, channels)."""

    overruns = 0

    def __init__(self, samples: Signal, rate_hz: int = RATE_HZ) -> None:
        self.rate_hz, self._samples = rate_hz, samples

    def read(self, timeout_s: float) -> Any:
        block, self._samples = self._samples[:28], self._samples[28:]
        return block.astype(np.float32)


def tone(frequency_hz: float, level_db: float, seconds: float = 1.0) -> Signal:
    """Return a sine whose peaks are this many dB above full scale."""
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.asarray(10 ** (level_db / 20) * np.sin(2 * np.pi * frequency_hz * times_s)[:, None])


def played(samples: Signal, is_mixed: bool = False) -> Signal:
    """Return sound as it is played."""
    sound = SoundInput("a card", Card(samples), samples.shape[1], is_mixed)
    blocks = []
    while len(block := sound.read(0.1)):
        blocks.append(block)
    return np.concatenate(blocks)


def level_db(samples: Signal) -> float:
    """Return the peak level of the second half, in dB of full scale."""
    return float(20 * np.log10(np.max(np.abs(samples[len(samples) // 2 :]))))


@pytest.mark.parametrize(("given_db", "expected_db"), [(0, -6), (-20, -11), (-40, -16), (-60, -36)])
def test_sound_is_compressed_so_that_quiet_sound_is_felt(given_db: float, expected_db: float) -> None:
    assert level_db(played(tone(200, given_db, 2.0))) == pytest.approx(expected_db, abs=2.0)


@pytest.mark.parametrize("frequency_hz", [10, 1300])
def test_sound_outside_the_band_of_touch_is_left_out(frequency_hz: float) -> None:
    assert level_db(played(tone(frequency_hz, -45))) < level_db(played(tone(200, -45))) - 20


def test_a_beat_after_silence_stays_within_full_scale_and_comes_down_soon() -> None:
    samples = played(np.concatenate((np.zeros((RATE_HZ, 1)), tone(100, 0, 0.5))))
    assert np.max(np.abs(samples)) <= 1.0
    assert level_db(samples[RATE_HZ + RATE_HZ // 10 :]) < -3


def test_channels_are_mixed_or_stay_apart() -> None:
    stereo = np.hstack((tone(200, -20), np.zeros((RATE_HZ, 1))))
    apart, mixed = played(stereo), played(stereo, is_mixed=True)
    assert (apart.shape[1], mixed.shape[1]) == (2, 1)
    assert np.max(np.abs(apart[:, 1])) == 0
    np.testing.assert_allclose(mixed, played(stereo[:, :1] / 2))


@contextlib.contextmanager
def opened(*arguments: Any, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Stand in for what opens a source; yield what it is asked for."""
    plain = tuple(
        (round(1 / each.per_unit, 6), each.unit, each.in_volts) if isinstance(each, Sensitivity) else each
        for each in arguments
    )
    yield plain, options


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("serial:P", None, None, None), (("serial:P", None, None), {"rate_hz": None, "reconnect_s": 10.0})),
        (
            ("serial:P", "g", 0.5, 800),
            (("serial:P", (4.903325, "m/s^2", False), None), {"rate_hz": 800, "reconnect_s": 10.0}),
        ),
        (
            ("audio:C", "m/s^2", 80, None),
            (("audio:C", (80.0, "m/s^2", True), 1.0), {"rate_hz": RATE_HZ, "reconnect_s": 10.0}),
        ),
        (("audio:C:1,2", None, None, None), (("audio:C:1,2", RATE_HZ), {})),
        (("audio:C", "drive", None, 8000), (("audio:C", 8000), {})),
    ],
)
def test_the_unit_decides_whether_a_card_brings_a_sensor_or_sound(
    arguments: Any, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "open_source", opened)
    monkeypatch.setattr(sources, "open_sound", opened)
    with sources.open_live(*(*arguments, RATE_HZ)) as found:
        assert found == expected


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("serial:P", "drive", None), "needs the physical unit of its sensor; give `unit`, such as g"),
        (("serial:P", None, 2.0), "needs the physical unit"),
        (("audio:C", None, 2.0), "needs the physical unit"),
        (("audio:C:x:", "g", None), "no sound card"),
    ],
)
def test_wrong_options_are_named(arguments: Any, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound_card, "cards", lambda recording: [])
    with pytest.raises((TextureError, OSError), match=told), sources.open_live(*(*arguments, None, RATE_HZ)):
        pass


def test_what_a_source_kept_before_the_stream_began_is_left_out() -> None:
    sound = SoundInput("a card", Card(tone(200, -20)), 1, False)
    sources.skip_kept(sound)
    assert len(sound.read(0.1)) == 0


def test_a_rate_too_low_for_sound_is_rejected() -> None:
    with pytest.raises(TextureError, match="60 Hz; give a `rate_hz` of 400 or more"):
        SoundInput("a card", Card(np.zeros((1, 1)), 60), 1, False)
