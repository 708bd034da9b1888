"""Estimates the bits and the error of coding spectra, without coding them."""

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import Signal

ERROR_OF_STEP = 1 / 3
"""Squared error of a coefficient above it, in squared steps: the mean over recordings of `mdct`, from 0 to 45 dB."""
_BITS_OF_IDEAL = 1.14
_CODE_BITS = 20
_SUM_OF_WEIGHTS = 4 * 8


class WaterFilling:
    """Spectra as Gaussian variables, each of the power around it, coded by reverse water-filling.

    A variable of power p then has the error D = min(p, level), and takes log2(p / D) / 2 bits (Cover and Thomas,
    *Elements of Information Theory*, 10.3.3). On the development recordings, the SNR of `mdct` differs from this by
    0.4 dB, and its bits by 6 % (standard deviations).
    """

    def __init__(self, spectra: NDArray[np.int32], unit: float) -> None:
        """Take coefficients (blocks, channels, bins), full scale = `unit`."""
        powers = np.pad(np.square(spectra.astype(np.float32)), ((1, 1), (0, 0), (2, 2)), mode="edge")
        # Weights over blocks are 1, 2, 1, and over bins 1, 2, 2, 2, 1.
        for axis, distances in ((0, (1, 1)), (2, (1, 2, 1))):
            for distance in distances:
                powers = _summed(powers, distance, axis)
        # Counted by their level, the powers of a long signal take no more time than those of a short one. The upper
        # bits of a number are its octave and, in eighths, its place in the octave.
        codes = powers.view(np.int32) >> _CODE_BITS
        levels = (codes - np.min(codes, initial=0)).swapaxes(0, 1)
        length = 1 + int(np.max(levels, initial=0))
        self._counts = np.array([np.bincount(channel.ravel(), minlength=length) for channel in levels])
        sums = np.bincount(levels.ravel(), powers.swapaxes(0, 1).ravel(), length)
        self._powers = sums / np.maximum(np.sum(self._counts, axis=0), 1) / (_SUM_OF_WEIGHTS * unit**2)

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


def _summed(powers: NDArray[np.float32], distance: int, axis: int) -> NDArray[np.float32]:
    """Return the sums of neighbours at a distance along an axis."""
    before = (slice(None),) * axis
    return powers[(*before, slice(distance, None))] + powers[(*before, slice(None, -distance))]
