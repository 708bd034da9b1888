"""Three axes of one texture: recognises their columns, and reduces them to one signal."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vibrocast.textures.recording import Contents, Signal, TextureError

AXES = ("X", "Y", "Z")
DFT321, NORM, NONE = "dft321", "norm", "none"
REDUCTIONS = (DFT321, NORM, NONE)


def order_of_axes(names: Sequence[str]) -> list[int] | None:
    """Return which of three columns is X, Y and Z; None if their names do not say that they are axes.

    The names differ only in that letter, in any case: x, y, z; ax, ay, az; acc_x, acc_y, acc_z.
    """
    lowered = [name.lower() for name in names]
    if len(lowered) != len(AXES):
        return None
    for place in range(len(lowered[0])):
        letters = [name[place : place + 1] for name in lowered]
        others = {name[:place] + name[place + 1 :] for name in lowered}
        if len(others) == 1 and sorted(letters) == ["x", "y", "z"]:
            return [letters.index(axis.lower()) for axis in AXES]
    return None


def reduced(contents: Contents, reduce: str | None, path: Path) -> Contents:
    """Return three channels as `reduce`, one of REDUCTIONS, says; for None, the contents unchanged.

    Raises TextureError unless there are three channels.
    """
    if reduce is None:
        return contents
    channels = contents.samples.shape[1]
    if channels != len(AXES):
        raise TextureError(f"{path}: reduce needs three channels, X, Y and Z; this file has {channels}; leave it out")
    if reduce == NONE:
        return replace(contents, axes=AXES)
    samples = dft321(contents.samples) if reduce == DFT321 else norm(contents.samples)
    return replace(contents, samples=samples, axes=())


def dft321(samples: Signal) -> Signal:
    """Reduce three axes, float64 (n, 3), to one, (n, 1), that has their energy at every frequency.

    |A(f)| = sqrt(|X|^2 + |Y|^2 + |Z|^2), with the phase of X + Y + Z: DFT321 of N. Landin, J. Romano, W. McMahan,
    K. Kuchenbecker, "Dimensional Reduction of High-Frequency Accelerations for Haptic Rendering", EuroHaptics 2010.
    """
    spectra = np.fft.rfft(samples, axis=0)
    magnitude = np.sqrt(np.sum(np.abs(spectra) ** 2, axis=1))
    phase = np.angle(np.sum(spectra, axis=1))
    return np.fft.irfft(magnitude * np.exp(1j * phase), n=len(samples)).reshape(-1, 1)


def norm(samples: Signal) -> Signal:
    """Reduce three axes, float64 (n, 3), to the length of their vector, (n, 1), which is never negative."""
    length: Signal = np.sqrt(np.sum(samples**2, axis=1, keepdims=True))
    return length
