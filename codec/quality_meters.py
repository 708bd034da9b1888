"""Quality meters of decoded packets: how far an error lies below the signal, or below the detection threshold."""

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
    """Measures in dB how well a decoded packet matches its samples; more is finer. Remembers earlier packets."""

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the quality of a candidate packet; both arrays: float64 (packet_samples, channels), full scale 1."""

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Remember the packet that was chosen."""


class SnrMeter:
    """The signal-to-noise ratio of a packet in dB, the mean over channels.

    A quiet packet need not reach it: a strong vibration masks a weaker one shortly after. For each channel, the error
    is compared with the greatest of three powers: the packet's; 20 dB below that of the last 0.25 s (an exponential
    mean); that of one least significant bit. So a pause after a loud texture gets no bits for masked noise, and digital
    silence gets none at all. The loud texture is forgotten by 17 dB a second; then a quiet texture is coded in full.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._power: NDArray[np.float64] | None = None

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the ratio; see QualityMeter."""
        floor = np.maximum(self._recent_power(samples) * 10 ** (-_QUIET_DB / 10), _MIN_BIT**2)
        power = np.maximum(np.mean(np.square(samples), axis=0), floor)
        # The error of rounding to int16, uniform over one least significant bit, has this power.
        error = np.maximum(np.mean(np.square(samples - decoded), axis=0), _MIN_BIT**2 / 12)
        return float(np.mean(10 * np.log10(power / error)))

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Remember the power of the texture; see QualityMeter."""
        self._power = self._recent_power(samples)

    def _recent_power(self, samples: Signal) -> NDArray[np.float64]:
        power: NDArray[np.float64] = np.mean(np.square(samples), axis=0)
        if self._power is None:
            return power
        kept = math.exp(-len(samples) / self._rate_hz / _MEMORY_S)
        return kept * self._power + (1 - kept) * power


class ThresholdMeter:
    """How far a packet's error stays below the detection threshold, in dB, in the third octave where it is nearest.

    Third octaves have midband frequencies of 1000 * 2^(n/3) Hz (IEC 61260-1). The error's power in each is that of its
    spectrum over the packet, where a bin's power is spread over the bin's width. Its level is relative to a sinusoid at
    the detection threshold at the midband frequency. The least over bands and channels counts: 0 dB = an error just at
    the threshold.

    The skin sums over 0.2 s and more (Verrillo, "Temporal summation in vibrotactile sensitivity", JASA 37, 1965),
    longer than most packets. But an error that keeps a level in each packet also keeps it over all. With a mean over
    earlier packets, each packet would pay for the one before. Silence, and all else that cannot be felt, is coded as
    coarsely as possible.
    """

    def __init__(self, signal_format: SignalFormat, threshold: Path = DETECTION_THRESHOLD) -> None:
        """Make a meter for a physical unit. Raises CodecError for other units, and an unreadable threshold."""
        highest = math.floor(3 * math.log2(signal_format.rate_hz / 2 / 1000) - 0.5)
        middle_hz = 1000 * 2 ** (np.arange(_MIN_BAND, max(highest, _MIN_BAND) + 1) / 3)
        amplitude = threshold_amplitude(read_threshold(threshold), middle_hz, signal_format.unit)
        self._edges_hz = middle_hz * 2 ** -(1 / 6), middle_hz * 2 ** (1 / 6)
        self._min_power = np.square(amplitude)[:, None] / 2
        self._gains = np.array(signal_format.gains)
        self._rate_hz = signal_format.rate_hz

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the threshold's level relative to the error's; see QualityMeter."""
        spectrum = np.abs(np.fft.rfft((samples - decoded) * self._gains, axis=0)) / len(samples)
        spectrum[1:] *= math.sqrt(2)
        parts = band_parts(len(spectrum), self._rate_hz / len(samples), *self._edges_hz)
        power = np.maximum(parts.T @ np.square(spectrum), _NOTHING * self._min_power)
        return float(np.min(10 * np.log10(self._min_power / power)))

    def update(self, samples: Signal, decoded: Signal) -> None:
        """Nothing to remember: each packet is measured alone; see QualityMeter."""
