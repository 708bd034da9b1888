"""Sound cards on a real sound server: codes arrive exactly, on their channels, and a lost card is reported."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from tests.sound_server import HEADPHONES, PAD, Listener, SoundServer, position_of
from vibrocast.device_protocol.transports import DeviceGone, TransportError
from vibrocast.output.actuator import Codes
from vibrocast.output.sound_card import Capture, Playback, cards, find

TRIES = 10
"""A busy machine may let the server skip; then it is played again."""


class Tape:
    """The source of the codes of a `Playback`: silence until `start`, then the codes."""

    def __init__(self, codes: Codes) -> None:
        self._codes, self._at = codes, -1

    def start(self) -> None:
        self._at = 0

    @property
    def ended(self) -> bool:
        return self._at >= len(self._codes)

    def fill(self, frames: int) -> Codes:
        piece = np.zeros((frames, self._codes.shape[1]), np.int16)
        if self._at >= 0:
            part = self._codes[self._at : self._at + frames]
            piece[: len(part)] = part
            self._at += frames
        return piece


def wait_until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    until_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until_s, "nothing happens"
        time.sleep(0.005)


@pytest.mark.parametrize(("sink", "channels"), [(PAD, (4, 1)), (HEADPHONES, (2,))])
def test_codes_come_back_exactly_on_their_channels_alone(
    pulseaudio: SoundServer, sink: str, channels: tuple[int, ...]
) -> None:
    codes = np.random.default_rng(1).integers(-32768, 32768, (20_000, len(channels)), np.int16)
    columns = [channel - 1 for channel in channels]
    tape = Tape(codes)
    for _ in range(TRIES):
        with Playback(find(sink), channels, tape.fill) as playback:
            playback.wait_for_begin()
            with Listener(sink) as listener:
                tape.start()
                wait_until(lambda: tape.ended)
        heard = listener.heard()
        at = position_of(codes, heard[:, columns])
        if at is not None:
            break
    assert at is not None
    assert not np.delete(heard, columns, axis=1).any(), "other channels are silent"
    heard[at : at + len(codes)] = 0
    assert not heard.any(), "nothing else is played"


def test_cards_are_found_by_a_part_of_their_name(pulseaudio: SoundServer) -> None:
    assert {(card.name, card.channels, card.rate_hz) for card in cards()} == {(PAD, 4, 48000), (HEADPHONES, 2, 44100)}
    assert {card.backend for card in cards(recording=True)} == {"PulseAudio"}
    assert find("mePAD").name == PAD
    assert find("default").default
    assert find("monitor of head", recording=True).name == f"Monitor of {HEADPHONES}"
    with pytest.raises(TransportError, match=f"2 sound cards (?=.*{PAD})(?=.*{HEADPHONES}).* give more"):
        find("e")


def test_without_a_server_there_is_no_card(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("miniaudio", reason="no miniaudio; install the extra [audio]")
    monkeypatch.setattr("vibrocast.output.sound_card.cards", lambda recording=False: [])
    with pytest.raises(TransportError, match="no sound card for playback; connect one"):
        find("default")


def test_what_fails_in_the_thread_of_the_card_is_raised_in_the_caller(pulseaudio: SoundServer) -> None:
    def fail(frames: int) -> Codes:
        raise ZeroDivisionError

    with Playback(find(PAD), (1,), fail) as playback:
        wait_until(lambda: playback.waiting_s > 0)
        with pytest.raises(ZeroDivisionError):
            playback.wait_for_begin()


@pytest.mark.parametrize("loss", ["sink", "server"])
def test_a_lost_card_is_reported_and_closes(mortal_sound_server: SoundServer, loss: str) -> None:
    silence = Tape(np.zeros((1, 1), np.int16))
    with (
        Playback(find(PAD), (1,), silence.fill) as playback,
        Capture(find(f"Monitor of {PAD}", recording=True), (1,)) as capture,
    ):
        playback.wait_for_begin()
        capture.wait_for_begin()
        if loss == "sink":
            mortal_sound_server.remove(PAD)
        else:
            mortal_sound_server.stop()
        wait_until(lambda: playback.gone)
        with pytest.raises(DeviceGone, match=r"'Gamepad' is gone; .* connect it"):
            playback.check()
        with pytest.raises(DeviceGone, match="is gone"):
            for _ in range(1000):
                capture.read(0.1)


def test_a_slow_reader_is_counted_as_an_overrun(pulseaudio: SoundServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibrocast.output.sound_card._UNREAD_S", 0.05)
    silence = Tape(np.zeros((1, 1), np.int16))
    with (
        Playback(find(PAD), (1,), silence.fill),
        Capture(find(f"Monitor of {PAD}", recording=True), (1,)) as capture,
    ):
        wait_until(lambda: capture.overruns > 0)
        assert len(capture.read(1.0)) <= 0.05 * 48000
