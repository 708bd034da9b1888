"""Estimates the bits and the error of coding spectra, without coding them."""

import numpy as np

from vibrocast.codec.interface import Signal

ERROR_OF_STEP = 1 / 3
"""Squared error of a coefficient above it, in squared steps: the mean over recordings of `mdct`, from 0 to 45 dB."""
_BITS_OF_IDEAL = 1.14
_LEVELS_PER_OCTAVE = 8
_LEAST_POWER = 2.0**-90
_IN_TIME = np.array([1, 2, 1]) / 4
_IN_FREQUENCY = np.array([1, 2, 2, 2, 1]) / 8


class WaterFilling:
    """Spectra as Gaussian variables, each of the power around it, coded by reverse water-filling.

    A variable of power p then has the error D = min(p, level), and takes log2(p / D) / 2 bits (Cover and Thomas,
    *Elements of Information Theory*, 10.3.3). On the development recordings, the SNR of `mdct` differs from this by
    0.4 dB, and its bits by 6 % (standard deviations).
    """

    def __init__(self, spectra: Signal) -> None:
        """Take coefficients (blocks, channels, bins)."""
        powers = _smoothed(_smoothed(np.square(spectra), _IN_TIME, 0), _IN_FREQUENCY, 2)
        # Counted by their level, the powers of a long signal take no more time than those of a short one.
        codes = np.rint(_LEVELS_PER_OCTAVE * np.log2(np.maximum(powers, _LEAST_POWER))).astype(np.int64)
        first = int(np.min(codes, initial=0))
        each = [channel.ravel() - first for channel in codes.swapaxes(0, 1)]
        length = 1 + max(int(np.max(channel, initial=0)) for channel in each)
        self._counts = np.array([np.bincount(channel, minlength=length) for channel in each])
        self._powers = 2.0 ** ((first + np.arange(length)) / _LEVELS_PER_OCTAVE)
        self._powers[self._powers <= _LEAST_POWER] = 0

    def bits(self, steps: Signal) -> float:
        """Return the bits over all channels; `steps`: of each channel, (channels,)."""
        octaves = np.log2(np.maximum(self._powers / (ERROR_OF_STEP * np.square(steps)[:, None]), 1))
        return _BITS_OF_IDEAL * float(np.sum(self._counts * octaves)) / 2

    def squared_errors(self, steps: Signal) -> Signal:
        """Return the sum of squared errors of each channel, (channels,)."""
        errors: Signal = np.sum(
            self._counts * np.minimum(self._powers, ERROR_OF_STEP * np.square(steps)[:, None]), axis=1
        )
        return errors


def _smoothed(powers: Signal, weights: Signal, axis: int) -> Signal:
    """Return the weighted means of neighbours along an axis, whose ends repeat."""
    reach = len(weights) // 2
    length = powers.shape[axis]
    padded = np.pad(powers, [(reach * (each == axis),) * 2 for each in range(powers.ndim)], mode="edge")
    means: Signal = sum(
        weight * padded[(slice(None),) * axis + (slice(place, place + length),)] for place, weight in enumerate(weights)
    )
    return means
