"""Reads MATLAB's .mat files: numbers, structs and tables; version 7.3 by the reader of HDF5; writes version 5."""

import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast import extras
from vibrocast.textures import arrays, hdf5
from vibrocast.textures.columns import Table, table_of_frame
from vibrocast.textures.recording import Contents, Recording, TextureError

NUMBERS = ("single", "double", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
"""MATLAB's classes of numbers; NumPy has the same names."""
MAX_BYTES = 2**31 - 2**10  # of a variable in version 5, its tags included


def read(path: Path, key: str | None, rate_hz: float | None) -> Contents | Table:
    """Read a variable of numbers, a field of a struct or a table; `key` and `rate_hz` as in `textures.load`.

    A row is one channel, as a column is. `key` names fields and columns as MATLAB does: "trial.acc", "trials(2).acc".
    Raises TextureError, OSError, and MissingExtraError for a table without the extra [formats].
    """
    if hdf5.is_hdf5(path):
        return _read_objects(path, key) if hdf5.has_tables(path) else hdf5.read(path, key, rate_hz)
    from scipy.io import loadmat, whosmat

    with arrays.parsing(path, "a .mat file"):
        try:
            variables = {name: (prod(shape), kind) for name, shape, kind in whosmat(str(path), appendmat=False)}
        except TypeError:  # scipy's, at an object
            variables = None
        if variables is None:
            return _read_objects(path, key)
        stated = [
            name
            for name, (size, kind) in variables.items()
            if arrays.states_something(name)
            and size <= (arrays.MAX_CHARACTERS if kind == "char" else 1 if kind in NUMBERS else 0)
        ]
        signals = [name for name, (size, kind) in variables.items() if kind in NUMBERS and size > 1]
        nested = [name for name, (_, kind) in variables.items() if kind in ("struct", "cell")]
        top = re.split(r"[./(]", key or "", maxsplit=1)[0]
        if nested and (top in nested or not (signals or key)):
            loaded = loadmat(str(path), variable_names=[*nested, *stated], appendmat=False, simplify_cells=True)
            return _nested_signal({name: loaded[name] for name in (*nested, *stated)}, key, path, rate_hz)
        others = {
            name: arrays.in_words(kind, size, kind in NUMBERS)
            for name, (size, kind) in variables.items()
            if name not in signals + stated
        }
        chosen = arrays.chosen_key(signals, key, path, others)
        size, kind = variables[chosen]
        arrays.reject_too_large((size,), np.dtype(kind), path, path.stat().st_size)
        loaded = loadmat(str(path), appendmat=False, variable_names=[chosen, *stated])
        array = loaded[chosen]
        if array.dtype.kind in "iuf":  # MATLAB stores whole-number doubles as integers
            array = array.astype(kind, copy=False)
        array = array.T if len(array) == 1 else array
        return arrays.contents_of(array, path, {name: loaded[name] for name in stated}, rate_hz)


def _nested_signal(variables: dict[str, Any], key: str | None, path: Path, rate_hz: float | None) -> Contents:
    """Return an array that structs or cells hold; the fields nearest to it state rate and unit."""
    found = {name: value for top, value in variables.items() for name, value in _inside(top, value)}
    signals = [name for name, value in found.items() if np.size(value) > 1 and np.asarray(value).dtype.kind in "iuf"]
    chosen = arrays.chosen_key(signals, key and key.replace("/", "."), path)
    stated: dict[str, Any] = {}
    parts = chosen.split(".")
    for place in (".".join(parts[:count]) for count in range(len(parts))):
        near = {name.rpartition(".")[2]: value for name, value in found.items() if name.rpartition(".")[0] == place}
        stated |= {name: value for name, value in near.items() if arrays.states_something(name)}
    return arrays.contents_of(np.asarray(found[chosen], np.float64), path, stated, rate_hz)


def _inside(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a variable holds by its name in MATLAB, where elements count from 1."""
    if isinstance(value, dict):
        for field, item in value.items():
            yield from _inside(f"{name}.{field}", item)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for number, item in enumerate(value, start=1):
            yield from _inside(f"{name}({number})", item)
    else:
        yield name, value


def _read_objects(path: Path, key: str | None) -> Table:
    """Read a table or timetable, or a column of it."""
    extras.require("formats", "matio")
    from matio import load_from_mat

    with arrays.parsing(path, "a .mat file"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        variables = load_from_mat(str(path))
        tables = {name: value for name, value in variables.items() if hasattr(value, "select_dtypes")}
        name, _, column = (key or "").partition(".")
        frame = tables[arrays.chosen_key(list(tables), name or None, path)]
        columns = frame.select_dtypes("number")
        columns = columns[[arrays.chosen_key(list(columns), column, path)]] if column else columns
        rates = [float(np.squeeze(each)) for name, each in variables.items() if name.lower() in arrays.RATE_NAMES]
        return replace(table_of_frame(columns), rate_hz=next(iter(rates), None))


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
