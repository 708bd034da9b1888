"""Plays rendered DAC codes on a sound card, and switches between signals at the same place without a gap."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.transports import Closing
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.code_queue import fade_frames
from vibrocast.output.rendering import Dac
from vibrocast.output.sound_card import Card, Playback

_AT_REST_S = 1.0
# Of a drive in parts of 2^25, as `Dac` takes it, a code of 16 bits is this many bits higher.
_DRIVE_BITS = 10


@dataclass(frozen=True)
class PlayedCodes:
    """A part of a signal that was played.

    Attributes:
        key: Of the signal.
        frames: How many were played.
        started_s: When the first one left the card, as `time.time` counts, as far as the card's buffer tells.
    """

    key: str
    frames: int
    started_s: float


class _Voice:
    """A signal while it plays: `at` is its next frame, `level` moves towards `target` with each frame."""

    def __init__(self, key: str, codes: Codes, at: int, level: float) -> None:
        self.key, self.codes = key, codes
        self.first = self.at = at
        self.level, self.target = level, 1.0
        self.started_s: float | None = None

    def next(self, frames: int, step: float) -> NDArray[np.float64]:
        """Return the next frames, float64 (frames, channels), with silence behind the end."""
        codes = self.codes[self.at : self.at + frames]
        self.at += len(codes)
        signal = np.zeros((frames, self.codes.shape[1]))
        if self.level == self.target == 1.0:
            signal[: len(codes)] = codes
            return signal
        way = self.level + np.sign(self.target - self.level) * step * np.arange(1, frames + 1)
        levels = np.clip(way, 0.0, 1.0)
        self.level = float(levels[-1])
        signal[: len(codes)] = codes * levels[: len(codes), np.newaxis]
        return signal

    @property
    def ended(self) -> bool:
        """Whether only silence is left."""
        return self.at >= len(self.codes) or self.level == self.target == 0.0


class SamplePlayer(Closing):
    """Plays codes that `output.rendering.render` has made for `actuator`, whose DAC is the card.

    Codes are int16 (n, channels) at `actuator.dac_rate_hz`, one column for each of `channels`, which count from 1. One
    signal fades into the next within 5 ms. The sum passes the limits of `Dac` again, because a person who switches may
    string loud parts together. They change nothing in a signal that keeps them. `start`, `switch` and `stop` return at
    once. Raises TransportError and MissingExtraError.
    """

    def __init__(self, card: Card, channels: Sequence[int], actuator: Actuator) -> None:
        self._lock = threading.Lock()
        self._step = 1.0 / fade_frames(actuator)
        header = StreamHeader(1, actuator.dac_rate_hz, None, "full scale", (1.0,) * len(channels), b"")
        self._limits = Dac(header, actuator, 1.0, compensation=False)
        self._limits.play(np.zeros((fade_frames(actuator), len(channels)), np.int32))  # fades in, once
        self._last = np.zeros(len(channels), np.int64)
        self._voices: list[_Voice] = []
        self._played: list[PlayedCodes] = []
        self._rate_hz = actuator.dac_rate_hz
        self._playback: Playback | None = None
        self._playback = Playback(card, channels, self._fill, actuator.dac_rate_hz)

    def wait_for_begin(self) -> None:
        """Wait until the card plays, which may swallow what is sent before. Raises TransportError."""
        self._card.wait_for_begin()

    @property
    def latency_s(self) -> float:
        """The time from a call to the output: a period and the card's buffer."""
        return self._card.period_s + self._card.buffer_s

    @property
    def limited(self) -> int:
        """How many samples the limits have changed since the card was opened."""
        counts = self._limits.counts
        return counts.voltage_limited + counts.slew_limited + counts.power_limited

    @property
    def underruns(self) -> int:
        """How often the card had nothing to play."""
        return self._card.underruns

    @property
    def _card(self) -> Playback:
        assert self._playback is not None
        return self._playback

    def start(self, key: str, codes: Codes) -> None:
        """Play a signal from its beginning; whatever plays fades out. Raises TransportError."""
        self._card.check()
        with self._lock:
            self._begin(key, codes, 0)

    def switch(self, key: str, codes: Codes) -> None:
        """Go on in another signal at the same frame; from the beginning where nothing plays. Raises TransportError."""
        self._card.check()
        with self._lock:
            self._begin(key, codes, next((each.at for each in self._voices if each.target), 0))

    def _begin(self, key: str, codes: Codes, offset: int) -> None:
        self._fade_out()
        # Codes begin at rest: only in their middle, or next to others, do they need to fade in.
        self._voices.append(_Voice(key, codes, offset, 0.0 if offset or self._voices else 1.0))

    def _fade_out(self) -> None:
        for voice in self._voices:
            if voice.target:
                voice.target = 0.0
                self._note(voice)

    def stop(self) -> None:
        """Bring the output to rest."""
        with self._lock:
            self._fade_out()

    def playing(self) -> str | None:
        """Return the key of the signal that plays, None where none does. Raises TransportError if the card is gone."""
        self._card.check()
        with self._lock:
            return next((each.key for each in self._voices if each.target), None)

    def take_played(self) -> list[PlayedCodes]:
        """Return what has been played to its end, up to a switch or up to a stop since the last call."""
        with self._lock:
            played, self._played = self._played, []
            return played

    def close(self) -> None:
        """Bring the output to rest, and release the card; may be called again. Never raises for a card that is gone."""
        self.stop()
        until_s = time.monotonic() + _AT_REST_S
        while (self._voices or self._last.any()) and time.monotonic() < until_s and not self._card.gone:
            time.sleep(self._card.period_s / 2)
        self._card.close()

    def _note(self, voice: _Voice) -> None:
        if voice.started_s is not None:
            self._played.append(PlayedCodes(voice.key, voice.at - voice.first, voice.started_s))

    def _fill(self, frames: int) -> Codes:
        with self._lock:
            total = np.zeros((frames, len(self._last)))
            for voice in self._voices:
                if voice.started_s is None:
                    delay_s = self._playback.buffer_s if self._playback is not None else 0.0
                    voice.started_s = time.time() + delay_s
                total += voice.next(frames, self._step)
            for voice in self._voices:
                if voice.ended and voice.target:
                    self._note(voice)
            self._voices = [voice for voice in self._voices if not voice.ended]
            codes = self._limits.play(np.trunc(total).astype(np.int32) << _DRIVE_BITS)
            self._last = codes[-1].astype(np.int64)
            return codes
