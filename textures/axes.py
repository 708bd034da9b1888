"""Three axes of one texture: recognises their columns, and reduces them to one signal."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vibrocast.textures.recording import Contents, Signal, TextureError

AXES = ("X", "Y", "Z")
DFT321, NORM, NONE = "dft321", "norm", "none"
REDUCTIONS = (DFT321, NORM, NONE)


def are_axes(names: Sequence[str]) -> bool:
    """Return whether three names in small letters differ in one alone, which is x, y and z in this order."""
    first, *others = names
    places = [place for place, letter in enumerate(first) if letter == "x"]
    return any(others == [first[:place] + axis + first[place + 1 :] for axis in "yz"] for place in places)


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
