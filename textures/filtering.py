"""Removes the band below touch from recordings and live blocks: an offset, gravity, drift."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrocast.textures.recording import Recording, Signal, TextureError

HIGHPASS_HZ = 20.0
"""Below it, the hand moves as a whole, and acceleration is gravity, posture and drift. The actuator output of
firmware/src/core drops that band, too."""
TRANSITION = 0.1
"""Width of the filter's transition, relative to its corner: from 18 to 20 Hz."""
STOP_BAND_DB = 60.0
LIVE_ORDER = 4
ROUNDING = 1e-12
"""Relative to the peak: a filtered signal below it is the rounding error of float64."""


def highpass_of(unit: str | None, highpass_hz: float | None = HIGHPASS_HZ) -> float | None:
    """Return the corner of the high-pass for a recording loaded with this `unit`: None for a drive signal."""
    return None if unit == "drive" else highpass_hz


@dataclass(frozen=True, eq=False)
class HighPassed:
    """A recording without the band below `highpass_hz`; None = nothing was removed.

    `removed_energy`: removed part of the recording's energy, 0 to 1; 0 for a silent recording.
    """

    recording: Recording
    highpass_hz: float | None
    removed_energy: float


def is_vibration(unit: str) -> bool:
    """Return whether touch ignores an offset in this unit: for acceleration, and if no unit is known.

    A displacement and a drive signal may hold a position on purpose.
    """
    return unit in ("m/s^2", "full scale")


def highpass(recording: Recording, highpass_hz: float | None = HIGHPASS_HZ) -> HighPassed:
    """Return the recording without the band below `highpass_hz`; unchanged for None, and unless it `is_vibration`.

    A linear-phase FIR filter (Kaiser window, 60 dB) without delay. The band from `highpass_hz` on keeps its amplitude
    to 0.1 %; 10 % below it the filter is 60 dB down. A constant or a ramp vanishes. Before and after the recording, the
    slow movement of its ends is assumed to continue (`_mirrored`). Raises TextureError unless 0 < `highpass_hz` < half
    the rate.
    """
    if highpass_hz is None or not is_vibration(recording.unit):
        return HighPassed(recording, None, 0.0)
    if not 0 < highpass_hz < recording.rate_hz / 2:
        raise TextureError(
            f"{recording.name}: at {recording.rate_hz:g} Hz no high-pass of {highpass_hz:g} Hz is possible",
            action=f"give one between 0 and {recording.rate_hz / 2:g} Hz, or keep the whole band with "
            "`highpass_hz=None`",
            parameter="highpass_hz=None",
        )
    low_pass = _low_pass(highpass_hz, recording.rate_hz)
    filtered = np.empty_like(recording.samples)
    for channel, samples in enumerate(recording.samples.T):
        level, mirrored = _mirrored(samples, len(low_pass) // 2, round(recording.rate_hz / highpass_hz))
        filtered[:, channel] = level - _convolved(mirrored, low_pass)
        if np.max(np.abs(filtered[:, channel])) <= ROUNDING * np.max(np.abs(samples)):
            filtered[:, channel] = 0.0  # only the rounding of a constant or a ramp is left
    energy = float(np.sum(np.square(recording.samples)))
    kept = float(np.sum(np.square(filtered)))
    removed = min(1.0, max(0.0, 1 - kept / energy)) if energy > 0 else 0.0
    return HighPassed(replace(recording, samples=filtered), highpass_hz, removed)


def _low_pass(highpass_hz: float, rate_hz: float) -> Signal:
    """Return the FIR filter of the band to be removed, of odd length; its response at 0 Hz is 1.

    A windowed sinc, whose Kaiser window has the length and the shape for STOP_BAND_DB (Kaiser, "Nonrecursive digital
    filter design using the I0-sinh window function", ISCAS 1974). scipy.signal has it too; its import takes a second.
    """
    width = TRANSITION * highpass_hz / rate_hz
    half = math.ceil((STOP_BAND_DB - 7.95) / (2.285 * 2 * math.pi * width) + 1) // 2
    window = np.kaiser(2 * half + 1, 0.1102 * (STOP_BAND_DB - 8.7))
    taps: Signal = window * np.sinc((2 * highpass_hz / rate_hz - width) * np.arange(-half, half + 1))
    return taps / np.sum(taps)


def _convolved(samples: Signal, taps: Signal) -> Signal:
    """Return samples (n,) through a symmetric FIR filter (m,), by overlap-save: the n - m + 1 in which all taps lie."""
    size = 1 << (4 * len(taps)).bit_length()
    valid, response = size - len(taps) + 1, np.fft.rfft(taps, size)
    count = len(samples) - len(taps) + 1
    filtered = np.empty(count)
    for start in range(0, count, valid):
        piece = np.fft.irfft(np.fft.rfft(samples[start : start + size], size) * response, size)
        filtered[start : start + valid] = piece[len(taps) - 1 :][: count - start]
    return filtered


def _mirrored(samples: Signal, added: int, period: int) -> tuple[Signal, Signal]:
    """Return samples (n,) minus the line between their ends, and the same with `added` samples before and after.

    An end is the parabola through the first or last `period` of samples, extrapolated by one sample. The samples are
    mirrored about these two points. So their slow movement continues, and no single sample decides its level.
    """
    fitted = min(period, len(samples))
    places = np.arange(fitted) / period

    def end(nearest: Signal) -> float:
        return float(np.polyval(np.polyfit(places, nearest, min(2, fitted - 1)), -1 / period))

    line = np.linspace(end(samples[:fitted]), end(samples[::-1][:fitted]), len(samples) + 2)[1:-1]
    level = samples - line
    return level, np.pad(np.concatenate(([0.0], level, [0.0])), added - 1, mode="reflect", reflect_type="odd")


class LiveHighPass:
    """The same for blocks of a live source: a causal Butterworth filter, at rest on the first sample."""

    def __init__(self, rate_hz: float, highpass_hz: float = HIGHPASS_HZ) -> None:
        if not 0 < highpass_hz < rate_hz / 2:
            raise TextureError(
                f"at {rate_hz:g} Hz no high-pass of {highpass_hz:g} Hz is possible; give less than half the rate"
            )
        from scipy import signal

        self._sections = signal.butter(LIVE_ORDER, highpass_hz, "highpass", fs=rate_hz, output="sos")
        self._state: NDArray[np.float64] | None = None

    def __call__(self, block: Signal) -> Signal:
        """Return a block (n, channels) without the band below the corner."""
        from scipy import signal

        if not len(block):
            return block
        if self._state is None:
            self._state = signal.sosfilt_zi(self._sections)[:, :, None] * block[0]
        filtered, self._state = signal.sosfilt(self._sections, block, axis=0, zi=self._state)
        return np.asarray(filtered)
