"""A codec in 40 lines for vibrocast: Haar wavelet, uniform quantiser, zlib. It needs NumPy alone."""

import zlib

import numpy as np
from numpy.typing import NDArray

LEVELS = 4


class Haar:
    """Codes each packet alone; `quality` is the logarithm to base 2 of 1 / quantiser step."""

    name = "haar"
    summary = "Haar wavelet, uniform quantiser, zlib: an example of a codec in a package of its own"
    block_samples = 2**LEVELS
    qualities = tuple(range(2, 14))

    def encode(self, samples: NDArray[np.float64], quality: float) -> bytes:
        """Return the bytes of a packet of float64 samples (n, channels) within -1 to 1."""
        low, parts = samples, []
        for _ in range(LEVELS):
            even, odd = low[0::2], low[1::2]
            low, high = (even + odd) / np.sqrt(2), (even - odd) / np.sqrt(2)
            parts.append(high)
        coefficients = np.concatenate([low, *parts[::-1]])
        return zlib.compress(np.rint(coefficients * 2**quality).astype("<i4").tobytes(), 9)

    def decode(self, data: bytes, samples: int, channels: int, quality: float) -> NDArray[np.float64]:
        """Return the samples (n, channels) of a packet. Raises ValueError on damaged bytes."""
        length = samples * channels * 4
        integers = np.frombuffer(zlib.decompressobj().decompress(data, length), "<i4")
        coefficients = integers.reshape(samples, channels) / 2**quality
        low = coefficients[: samples >> LEVELS]
        for level in range(LEVELS, 0, -1):
            high = coefficients[samples >> level : samples >> (level - 1)]
            low = np.stack([low + high, low - high], axis=1).reshape(-1, channels) / np.sqrt(2)
        return low
