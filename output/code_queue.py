"""DAC codes on their way to a sound card, which comes to rest when they run out."""

import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.rendering import FADE_SECONDS


class CodeQueue:
    """A queue of codes between the thread that makes them and that of the card, which is the actuator's DAC.

    While `playing`, more codes are expected: where they run out, `underruns` counts one. Then, as at the end, the
    output falls to rest within FADE_SECONDS, or as the slew limit allows. When codes come again, they fade in.
    `taken`: frames of the queue that the card has taken so far.
    """

    def __init__(self, actuator: Actuator, channels: int) -> None:
        self._step = actuator.code_step_limit
        self._fade_frames = fade_frames(actuator)
        self._pieces: deque[Codes] = deque()
        self._lock = threading.Lock()
        self._last = np.zeros(channels, np.int64)
        self._fall = np.zeros(channels, np.int64)  # codes by which the output falls with each frame, 0: it does not
        self._faded = self._fade_frames
        self._starved = False
        self.playing = False
        self.underruns = 0
        self.taken = 0

    @property
    def at_rest(self) -> bool:
        """Whether nothing waits and the output is at rest."""
        with self._lock:
            return not self._pieces and not self._last.any()

    def put(self, codes: Codes) -> None:
        """Add codes int16 (n, channels)."""
        if len(codes):
            with self._lock:
                self._pieces.append(codes)

    def take(self, frames: int) -> Codes:
        """Return the next codes int16 (frames, channels)."""
        codes = np.zeros((frames, len(self._last)), np.int16)
        with self._lock:
            at = self._descend(codes, self._fall)
            if not self._fall.any():
                at += self._move(codes[at:])
                if at < frames and (self.playing or self._last.any()):
                    self.underruns += self.playing and not self._starved
                    self._starved = True
                    self._faded = 0
                    self._fall = np.minimum(-(-np.abs(self._last) // self._fade_frames), self._step)
                    self._descend(codes[at:], self._fall)
        return codes

    def _move(self, codes: Codes) -> int:
        """Move what waits into `codes`; return the number of frames."""
        at = 0
        while self._pieces and at < len(codes):
            piece = self._pieces.popleft()
            if len(piece) > len(codes) - at:
                self._pieces.appendleft(piece[len(codes) - at :])
                piece = piece[: len(codes) - at]
            codes[at : at + len(piece)] = piece
            at += len(piece)
        self.taken += at
        fading = min(at, self._fade_frames - self._faded)
        if fading:
            rising = (self._faded + 1 + np.arange(fading)) / self._fade_frames
            codes[:fading] = np.trunc(codes[:fading] * rising[:, np.newaxis])
            self._faded += fading
            codes[:at] = within_slew(codes[:at], self._last, self._step)
        if at:
            self._starved = False
            self._last = codes[at - 1].astype(np.int64)
        return at

    def _descend(self, codes: Codes, fall: NDArray[np.int64]) -> int:
        """Write the way to rest into `codes`, if the output falls; return the number of frames until it rests."""
        if not fall.any() or not len(codes):
            return 0
        frames = np.arange(1, len(codes) + 1)[:, np.newaxis]
        way = np.sign(self._last) * np.maximum(0, np.abs(self._last) - frames * fall)
        codes[:] = way
        self._last = way[-1]
        if not self._last.any():
            self._fall = np.zeros_like(fall)
        return int(np.count_nonzero(way.any(axis=1)))


def fade_frames(actuator: Actuator) -> int:
    """Return the frames of FADE_SECONDS at the rate of an actuator's DAC."""
    return max(1, round(FADE_SECONDS * actuator.dac_rate_hz))


def within_slew(codes: Codes, last: NDArray[np.int64], step: int) -> Codes:
    """Return codes int16 (n, channels) that follow the given ones as fast as the slew limit allows.

    `last`: the codes before the first, (channels,); `step`: the largest step between two codes.
    """
    steps = np.diff(codes.astype(np.int64), axis=0, prepend=last[np.newaxis])
    if np.abs(steps).max(initial=0) <= step:
        return codes
    limited, before = codes.copy(), last
    for number, code in enumerate(codes.astype(np.int64)):
        before = before + np.clip(code - before, -step, step)
        limited[number] = before
    return limited
