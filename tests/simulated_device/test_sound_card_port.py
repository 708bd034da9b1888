"""A controller by the clock of a card: its codes reach the card exactly, and it is silent at rest."""

from dataclasses import replace

import numpy as np
import pytest

from vibrocast import textures
from vibrocast.codec.encoding import SLOWEST_MM_S, encode_profile, encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.host import hand_playback, playback
from vibrocast.host.controller import Controller as HostController
from vibrocast.host.devices import Session, session_with
from vibrocast.output.actuator import VOICE_COIL, Actuator, Codes
from vibrocast.output.code_queue import CodeQueue
from vibrocast.output.rendering import render
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.memory_link import MemoryLink
from vibrocast.simulated_device.sound_card_port import _CardController


class ImaginedCard:
    """A card that takes frames in pieces of any size, by simulated time, and the controller behind it.

    `most_periods`: of the largest piece. `slow_by`: its clock's error, in parts. `stall_us`: from when to when the
    controller's thread gets no time.
    """

    period_s = 0.01

    def __init__(
        self,
        actuator: Actuator,
        seed: int = 0,
        most_periods: float = 2.0,
        slow_by: float = 0.0,
        stall_us: tuple[int, int] = (0, 0),
    ) -> None:
        self._now_us = self._asked_us = 0
        self.queue = CodeQueue(actuator, 2)
        settings = Settings(actuator=actuator, channels=2)
        self._controller = _CardController(settings, self.queue, lambda: self._now_us / 1e6)
        self._controller.playback = self  # type: ignore[assignment] # as much of one as the clock needs
        self._random = np.random.default_rng(seed)
        self._rate_hz = actuator.dac_rate_hz * (1 - slow_by)
        self._most = most_periods * self.period_s * self._rate_hz
        self._next = 0
        self._stall_us = stall_us
        self._kept = b""
        self.out: list[Codes] = []

    @property
    def waiting_s(self) -> float:
        return (self._now_us - self._asked_us) / 1e6

    def check(self) -> None: ...

    def _pass_time(self, now_us: int) -> bool:
        self._now_us = now_us
        while self._next <= now_us * self._rate_hz / 1e6:
            frames = int(self._random.integers(1, round(self._most)))
            self.out.append(self.queue.take(frames))
            self._next += frames
            self._asked_us = now_us
        return not self._stall_us[0] <= now_us < self._stall_us[1]

    def receive(self, data: bytes, now_us: int) -> None:
        self._kept += data
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        if self._pass_time(now_us):
            data, self._kept = self._kept, b""
            self._controller.receive(data, self._controller.now_us())

    def transmit(self) -> bytes:
        return self._controller.transmit()


def opened(card: ImaginedCard) -> tuple[HostController, MemoryLink]:
    link = MemoryLink(card)
    link.sleep(0.1)
    return HostController(link, link.clock, link.sleep), link


def stream(channels: int = 1) -> Stream:
    recording = textures.GENERATORS["wood"](seconds=0.3)
    samples = np.repeat(recording.samples, channels, axis=1) * np.linspace(1, 0.5, channels)
    return encode_recording(replace(recording, samples=samples), live=True).stream


def alone(codes: Codes) -> Codes:
    """Return codes without the silence before and behind them."""
    sounding = np.flatnonzero(codes.any(axis=1))
    return codes[sounding[0] : sounding[-1] + 1]


@pytest.mark.parametrize("rate_hz", [44_100, 48_000, 96_000, 192_000])
@pytest.mark.parametrize("channels", [1, 2])
def test_what_the_card_takes_is_what_is_rendered(rate_hz: int, channels: int) -> None:
    actuator = replace(VOICE_COIL.with_full_scale(6.0), dac_rate_hz=rate_hz)
    card = ImaginedCard(actuator, seed=rate_hz + channels, slow_by=1e-4)
    controller, link = opened(card)
    coded = stream(channels)
    for _ in range(3):
        outcome = playback.play(Session(controller, "card", actuator, actuator), "wood", coded)
        assert outcome.report.dac_equals_offline
    link.sleep(0.1)
    codes, _ = render(coded.header, coded.decode_integers(), coded.delay_samples, actuator)
    expected = np.pad(codes, ((0, 0), (0, 2 - channels)))
    out = np.concatenate(card.out)
    peak = int(np.argmax(np.abs(expected[:, 0].astype(int))))
    starts = [
        start
        for start in np.flatnonzero(out[:, 0] == expected[peak, 0]) - peak
        if np.array_equal(out[start : start + len(expected)], expected)
    ]
    assert len(starts) == 3
    for start in starts:
        out[start : start + len(expected)] = 0
    assert not out.any(), "silence between"
    assert card.queue.underruns == 0


def test_a_stream_goes_on_where_a_busy_computer_kept_the_card_waiting() -> None:
    actuator = replace(VOICE_COIL, dac_rate_hz=48_000)
    card = ImaginedCard(actuator, 1, most_periods=1.0, stall_us=(500_000, 600_000))
    controller, link = opened(card)
    outcome = playback.play(Session(controller, "card", actuator, actuator), "wood", stream(), loops=3)
    link.sleep(0.2)
    assert outcome.report.dac_equals_offline
    assert card.queue.underruns == 1
    played = np.concatenate(card.out).astype(np.int64)
    assert np.abs(np.diff(played, axis=0)).max() <= actuator.code_step_limit
    assert not played[-1].any()


def test_a_stop_brings_the_card_to_rest() -> None:
    actuator = replace(VOICE_COIL, dac_rate_hz=48_000)
    card = ImaginedCard(actuator, 2)
    controller, link = opened(card)

    def stop(_: object) -> None:
        if controller.clock() > 0.7:
            controller.stop()

    playback.play(session_with(controller, "card"), "wood", stream(), loops=5, progress=stop)
    link.sleep(0.1)
    played = alone(np.concatenate(card.out)).astype(np.int64)
    assert len(played) < 48_000
    assert np.abs(np.diff(played, axis=0, append=0)).max() <= actuator.code_step_limit


def test_a_profile_under_a_hand_is_as_computed() -> None:
    actuator = replace(VOICE_COIL, dac_rate_hz=48_000)
    card = ImaginedCard(actuator, 3, most_periods=1.0)
    controller, _ = opened(card)
    heights_um = 30 * np.sin(np.arange(4000) / 20)
    recording = textures.Recording(heights_um[:, None], 200_000.0, "um", "profile")
    coded = encode_profile(recording, SLOWEST_MM_S).stream
    played = hand_playback.play(controller, coded, hand_playback.back_and_forth(5.0, 40.0, 1))
    session = Session(controller, "card", actuator, actuator)
    _, expected = hand_playback.computed(session, coded, played)
    assert hand_playback.as_computed(session, played, expected)
