"""Judges of decoded packets: how far their error lies below the signal, or below what a finger may feel."""

import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from codec.interface import Signal, SignalFormat
from codec.threshold import DETECTION_THRESHOLD, read_threshold, threshold_amplitude

# Forward masking of vibration at the fingertip fades within some 0.25 s (Gescheider, Bolanowski and Verrillo,
# "Vibrotactile masking: effects of stimulus onset asynchrony and stimulus frequency", JASA 85, 1989).
_MEMORY_S = 0.25
_QUIET_DB = 20.0
_LEAST_BIT = 2.0**-15
# The skin sums vibration over some 0.2 s (Verrillo, "Temporal summation in vibrotactile sensitivity", JASA 37, 1965).
_SUMMATION_S = 0.2
_LOWEST_BAND_HZ = 10.0


class Judge(Protocol):
    """Measures in dB how well a decoded packet stands for its samples; more is finer. Remembers what it has heard."""

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the quality of a packet if it were next; both are float64 (packet_samples, channels), full scale 1."""

    def hear(self, samples: Signal, decoded: Signal) -> None:
        """Take in the packet that is next."""


class SnrJudge:
    """The signal-to-noise ratio of a packet in dB, the mean over channels.

    What is quiet is not held to it: the error is compared with the power of the packet or, where that is more, with
    20 dB below the power of the last 0.25 s (an exponential mean), or with one least bit, for each channel. So a pause
    behind a loud texture gets no bits for noise that the texture masks, and digital silence gets none at all; a texture
    that stays quiet is coded in full as soon as the loud one is forgotten, 17 dB a second.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._power: NDArray[np.float64] | None = None

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the ratio; see Judge."""
        floor = np.maximum(self._recent_power(samples) * 10 ** (-_QUIET_DB / 10), _LEAST_BIT**2)
        power = np.maximum(np.mean(np.square(samples), axis=0), floor)
        # Rounding to int16 has an error of that power, uniform over one least bit.
        error = np.maximum(np.mean(np.square(samples - decoded), axis=0), _LEAST_BIT**2 / 12)
        return float(np.mean(10 * np.log10(power / error)))

    def hear(self, samples: Signal, decoded: Signal) -> None:
        """Remember how loud the texture is; see Judge."""
        self._power = self._recent_power(samples)

    def _recent_power(self, samples: Signal) -> NDArray[np.float64]:
        power: NDArray[np.float64] = np.mean(np.square(samples), axis=0)
        if self._power is None:
            return power
        kept = math.exp(-len(samples) / self._rate_hz / _MEMORY_S)
        return kept * self._power + (1 - kept) * power


class ThresholdJudge:
    """How far a packet's error stays below what a finger may feel, in dB, in the third octave where it is nearest.

    The error of all packets so far goes through a bank of third-octave filters (Butterworth of third order; midband
    frequencies 1000 * 2^(n/3) Hz), its power is averaged exponentially over 0.2 s, the time over which the skin sums,
    and a band's level is compared with the detection threshold of a sinusoid of the same power at the midband
    frequency. The least over bands and channels counts: 0 dB = an error just at the threshold. Silence, and whatever
    else cannot be felt, gets the coarsest coding by itself.
    """

    def __init__(self, signal_format: SignalFormat, threshold: Path = DETECTION_THRESHOLD) -> None:
        """Make a judge of streams in a physical unit. Raises CodecError for others, and a threshold not readable."""
        from scipy import signal  # takes long to load

        octave_thirds = range(
            math.ceil(3 * math.log2(_LOWEST_BAND_HZ / 1000)),
            math.floor(3 * math.log2(signal_format.rate_hz / 2 / 1000) - 0.5) + 1,
        )
        middle_hz = 1000 * 2 ** (np.array(octave_thirds) / 3)
        amplitude = threshold_amplitude(read_threshold(threshold), middle_hz, signal_format.unit)
        self._gains = np.array(signal_format.gains)
        self._least_power = amplitude[:, None] ** 2 / 2
        self._rate_hz = signal_format.rate_hz
        self._filter = signal.sosfilt
        self._bands = [
            signal.butter(3, (hz * 2 ** (-1 / 6), hz * 2 ** (1 / 6)), "bandpass", fs=self._rate_hz, output="sos")
            for hz in middle_hz
        ]
        self._states = [np.zeros((len(band), 2, signal_format.channels)) for band in self._bands]
        self._power = np.zeros((len(self._bands), signal_format.channels))

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the level of the threshold over that of the error; see Judge."""
        power, _ = self._after(samples, decoded)
        return float(np.min(10 * np.log10(self._least_power / np.maximum(power, np.finfo(np.float64).tiny))))

    def hear(self, samples: Signal, decoded: Signal) -> None:
        """Take in the error; see Judge."""
        self._power, self._states = self._after(samples, decoded)

    def _after(self, samples: Signal, decoded: Signal) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Return the power in each band and channel, and the filters' states, behind a packet."""
        error = (samples - decoded) * self._gains
        kept = math.exp(-len(error) / self._rate_hz / _SUMMATION_S)
        filtered = [
            self._filter(band, error, axis=0, zi=state) for band, state in zip(self._bands, self._states, strict=True)
        ]
        power = np.array([np.mean(np.square(band), axis=0) for band, _ in filtered])
        return kept * self._power + (1 - kept) * power, [state for _, state in filtered]
