"""Playing rendered signals: switching at the same frame without a gap, limits, and what was played."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from vibrocast.output.actuator import VOICE_COIL, Codes
from vibrocast.output.sound_card import Card
from vibrocast.study import sample_player
from vibrocast.study.sample_player import SamplePlayer

ACTUATOR = replace(VOICE_COIL, dac_rate_hz=48_000)
CARD = Card("imagined", 2, 48_000, True, "none", None)
FADE = 240


def tone(frequency_hz: float, seconds: float = 1.0) -> Codes:
    time_s = np.arange(round(48_000 * seconds)) / 48_000
    return np.round(8000 * np.sin(2 * np.pi * frequency_hz * time_s))[:, None].astype(np.int16)


class StillCard:
    """In place of Playback: the test asks for frames itself."""

    buffer_s, period_s, underruns, gone = 0.03, 0.01, 0, True

    def __init__(self, card: Card, channels: object, fill: object, rate_hz: int) -> None:
        self.closed = False

    def check(self) -> None: ...

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def player(monkeypatch: pytest.MonkeyPatch) -> Iterator[SamplePlayer]:
    monkeypatch.setattr(sample_player, "Playback", StillCard)
    with SamplePlayer(CARD, (1,), ACTUATOR) as made:
        yield made


def test_a_signal_is_played_exactly_to_its_end(player: SamplePlayer) -> None:
    player.start("a", tone(100, 0.1))
    assert player.playing() == "a"
    assert np.array_equal(player._fill(4800), tone(100, 0.1))
    assert not player._fill(480).any()
    assert player.playing() is None
    (played,) = player.take_played()
    assert (played.key, played.frames) == ("a", 4800)
    assert player.take_played() == []


def test_a_switch_goes_on_at_the_same_frame_within_the_slew_limit(player: SamplePlayer) -> None:
    a, b = tone(100), -tone(300)
    player.start("a", a)
    first = player._fill(1000)
    player.switch("b", b)
    second = player._fill(1000)
    both = np.concatenate([first, second]).astype(np.int64)
    assert np.array_equal(first, a[:1000])
    assert np.array_equal(second[FADE:], b[1000 + FADE : 2000])
    share = (1 + np.arange(FADE))[:, None] / FADE
    assert np.abs(second[:FADE] - ((1 - share) * a[1000 : 1000 + FADE] + share * b[1000 : 1000 + FADE])).max() <= 1
    assert np.abs(np.diff(both, axis=0)).max() <= ACTUATOR.code_step_limit
    assert player.playing() == "b"
    assert [(each.key, each.frames) for each in player.take_played()] == [("a", 1000)]


@pytest.mark.usefixtures("player")
@pytest.mark.parametrize("slew_volts_per_second", [1e3, 1e4])
def test_any_switching_keeps_the_limits(slew_volts_per_second: float) -> None:
    actuator = replace(ACTUATOR, slew_volts_per_second=slew_volts_per_second)
    random = np.random.default_rng(0)
    with SamplePlayer(CARD, (1,), actuator) as made:
        signals = [tone(hz) for hz in (50, 170, 400)]
        out = []
        for number in range(60):
            signal = signals[random.integers(3)]
            (made.start if number % 5 == 0 else made.switch)("s", signal)
            if number % 7 == 6:
                made.stop()
            out.append(made._fill(int(random.integers(1, 400))))
        made.stop()
        out.append(made._fill(48_000))
    played = np.concatenate(out).astype(np.int64)
    assert np.abs(np.diff(played, axis=0, prepend=0)).max() <= actuator.code_step_limit
    assert np.abs(played).max() <= 8000
    assert played[-1] == 0


def test_a_stop_ramps_down_and_states_the_frames(player: SamplePlayer) -> None:
    player.start("before", np.zeros((48_000, 1), np.int16))
    player.start("a", np.full((48_000, 1), 5000, np.int16))  # fades in over the one before
    rising = player._fill(1000)[:, 0]
    assert rising[0] < 100 and (np.diff(rising) >= 0).all() and rising[-1] == 5000
    player.stop()
    falling = player._fill(1000)[:, 0]
    assert (np.diff(falling) <= 0).all() and not falling[FADE:].any()
    assert [(each.key, each.frames) for each in player.take_played()] == [("a", 1000)]


def test_loud_parts_that_are_strung_together_keep_the_power_limit(player: SamplePlayer) -> None:
    """A person may press the same loud beginning again and again."""
    loud = np.round(32_000 * np.sin(2 * np.pi * 100 * np.arange(9600) / 48_000))[:, None].astype(np.int16)
    blocks = []
    for number in range(20):
        player.start(f"press {number}", loud)
        blocks.append(player._fill(9600))
    power = np.mean((np.concatenate(blocks[10:]) / 32_768.0) ** 2)
    assert power <= ACTUATOR.power_limit * 1.02
    assert player.limited > 0
