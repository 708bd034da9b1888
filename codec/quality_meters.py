"""Quality meters of decoded packets: how far their error lies below the signal, or below what a finger may feel."""

import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import Signal, SignalFormat
from vibrocast.codec.threshold import DETECTION_THRESHOLD, band_parts, read_threshold, threshold_amplitude

# Forward masking of vibration at the fingertip fades within some 0.25 s (Gescheider, Bolanowski and Verrillo,
# "Vibrotactile masking: effects of stimulus onset asynchrony and stimulus frequency", JASA 85, 1989).
_MEMORY_S = 0.25
_QUIET_DB = 20.0
_MIN_BIT = 2.0**-15
_MIN_BAND = -20  # 10 Hz
_NOTHING = 1e-20


class QualityMeter(Protocol):
    """Measures in dB how well a decoded packet stands for its samples; more is finer. Remembers earlier packets."""

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the quality of a packet if it were next; both are float64 (packet_samples, channels), full scale 1."""

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Take in the packet that is next."""


class SnrMeter:
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
        """Return the ratio; see QualityMeter."""
        floor = np.maximum(self._recent_power(samples) * 10 ** (-_QUIET_DB / 10), _MIN_BIT**2)
        power = np.maximum(np.mean(np.square(samples), axis=0), floor)
        # Rounding to int16 has an error of that power, uniform over one least bit.
        error = np.maximum(np.mean(np.square(samples - decoded), axis=0), _MIN_BIT**2 / 12)
        return float(np.mean(10 * np.log10(power / error)))

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Remember how loud the texture is; see QualityMeter."""
        self._power = self._recent_power(samples)

    def _recent_power(self, samples: Signal) -> NDArray[np.float64]:
        power: NDArray[np.float64] = np.mean(np.square(samples), axis=0)
        if self._power is None:
            return power
        kept = math.exp(-len(samples) / self._rate_hz / _MEMORY_S)
        return kept * self._power + (1 - kept) * power


class ThresholdMeter:
    """How far a packet's error stays below what a finger may feel, in dB, in the third octave where it is nearest.

    The error's power in each third octave (midband frequencies 1000 * 2^(n/3) Hz, IEC 61260-1) is that of its spectrum
    over the packet, a bin's spread over its width, and its level that relative to a sinusoid at the detection threshold
    at the midband frequency. The least over bands and channels counts: 0 dB = an error just at the threshold. The skin
    sums over 0.2 s and more (Verrillo, "Temporal summation in vibrotactile sensitivity", JASA 37, 1965), which is
    longer than most packets; but an error held to a level in each of them has it over all, and with a mean over earlier
    packets each would pay for the one before. Silence, and what else cannot be felt, is coded as coarsely as can be.
    """

    def __init__(self, signal_format: SignalFormat, threshold: Path = DETECTION_THRESHOLD) -> None:
        """Make a meter of streams in a physical unit. Raises CodecError for others, and a threshold not readable."""
        highest = math.floor(3 * math.log2(signal_format.rate_hz / 2 / 1000) - 0.5)
        middle_hz = 1000 * 2 ** (np.arange(_MIN_BAND, max(highest, _MIN_BAND) + 1) / 3)
        amplitude = threshold_amplitude(read_threshold(threshold), middle_hz, signal_format.unit)
        self._edges_hz = middle_hz * 2 ** -(1 / 6), middle_hz * 2 ** (1 / 6)
        self._min_power = np.square(amplitude)[:, None] / 2
        self._gains = np.array(signal_format.gains)
        self._rate_hz = signal_format.rate_hz

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the level of the threshold over that of the error; see QualityMeter."""
        spectrum = np.abs(np.fft.rfft((samples - decoded) * self._gains, axis=0)) / len(samples)
        spectrum[1:] *= math.sqrt(2)
        parts = band_parts(len(spectrum), self._rate_hz / len(samples), *self._edges_hz)
        power = np.maximum(parts.T @ np.square(spectrum), _NOTHING * self._min_power)
        return float(np.min(10 * np.log10(self._min_power / power)))

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Each packet is measured by itself; see QualityMeter."""
