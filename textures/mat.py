"""Reads MATLAB's .mat files of version 4 to 7, passes 7.3 to the reader of HDF5, and writes version 5."""

from math import prod
from pathlib import Path

import numpy as np

from vibrocast.textures import arrays, hdf5
from vibrocast.textures.recording import Contents, Recording, TextureError

NUMBERS = ("single", "double", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
"""MATLAB's classes of numbers; NumPy has the same names."""
MAX_BYTES = 2**31 - 2**10  # of a variable in version 5, its tags included


def read(path: Path, key: str | None, rate_hz: float | None) -> Contents:
    """Read a variable of numbers; `key` and `rate_hz` as in `textures.load`. Raises TextureError, OSError.

    A row is one channel, as a column is.
    """
    if hdf5.is_hdf5(path):
        return hdf5.read(path, key, rate_hz)
    from scipy.io import loadmat, whosmat

    with arrays.parsing(path, "a .mat file"):
        # A compressed file takes up to 0.3 GB here: scipy inflates 128 kB of it at once.
        variables = {name: (shape, kind) for name, shape, kind in whosmat(str(path), appendmat=False)}
        sizes = {name: prod(shape) for name, (shape, _) in variables.items()}
        stated = [
            name
            for name, (_, kind) in variables.items()
            if arrays.states_something(name)
            and sizes[name] <= (arrays.MAX_CHARACTERS if kind == "char" else 1 if kind in NUMBERS else 0)
        ]
        signals = [name for name, (_, kind) in variables.items() if kind in NUMBERS and sizes[name] > 1]
        others = {name: kind for name, (_, kind) in variables.items() if name not in signals + stated}
        chosen = arrays.chosen_key(signals, key, path, others)
        shape, kind = variables[chosen]
        arrays.reject_too_large(shape, np.dtype(kind), path, path.stat().st_size)
        loaded = loadmat(str(path), appendmat=False, variable_names=[chosen, *stated])
        array = loaded[chosen]
        if array.dtype.kind in "iuf":  # MATLAB stores whole-number doubles as integers
            array = array.astype(kind, copy=False)
        array = array.T if len(array) == 1 else array
        return arrays.contents_of(array, path, {name: loaded[name] for name in stated}, rate_hz)


def write(path: Path, recording: Recording) -> None:
    """Write samples, rate_hz and unit as a .mat file of version 5. Raises TextureError, OSError."""
    from scipy.io import savemat

    if recording.samples.nbytes > MAX_BYTES:
        raise TextureError(f"{path}: more than the 2 GiB that a .mat file holds; save it as .npy, or cut it into parts")
    values = {
        arrays.SAMPLES_KEY: recording.samples,
        arrays.RATE_KEY: float(recording.rate_hz),
        arrays.UNIT_KEY: recording.unit,
    }
    savemat(str(path), values, appendmat=False)
