"""Signal-to-noise ratio between an original and its reproduction."""

import numpy as np
from numpy.typing import NDArray


def snr_db(original: NDArray[np.float64], reproduced: NDArray[np.float64]) -> float:
    """Return 10 log10 (energy of the original / energy of the error), in dB, over all samples and channels.

    Both arrays have the same shape and unit, float64. Infinite where there is no error, -infinity where a silent
    original was reproduced with one, NaN where both are silent. Raises ValueError when the shapes differ.
    """
    if original.shape != reproduced.shape:
        raise ValueError(f"original of shape {original.shape}, reproduction of shape {reproduced.shape}")
    # Scaled to a largest value of 1, so that the squares of very large or small signals neither overflow nor vanish.
    scale = max(np.max(np.abs(original), initial=0.0), np.max(np.abs(reproduced), initial=0.0)) or 1.0
    signal_energy = np.sum(np.square(original / scale))
    error_energy = np.sum(np.square(original / scale - reproduced / scale))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(10 * (np.log10(signal_energy) - np.log10(error_energy)))
