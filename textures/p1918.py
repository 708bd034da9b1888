"""Reads traces of the IEEE P1918.1.1 reference set: one text file an axis, three axes reduced to one signal.

A trace is `<interaction>_-_<tool>_-_<material>_-_<speed>_<axis>.txt` for the axes X, Y and Z, one value a line at
2800 Hz. The files state no unit.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from vibrocast.textures.axes import AXES
from vibrocast.textures.recording import Contents, TextureError
from vibrocast.textures.text import read_table, signal_of

RATE_HZ = 2800.0

_AXIS_FILE = re.compile(r"(.+)_([XYZ])\.txt", re.IGNORECASE | re.DOTALL)
_REFERENCE_TRACE = re.compile(r".+_-_.+_-_.+_-_[^_]+", re.DOTALL)


def read_folder(path: Path, axis: str | None, rate_hz: float | None) -> Contents:
    """Read one trace of a folder: `path` is a folder of one trace, or FOLDER/TRACE without axis and `.txt`.

    `axis`: one of AXES, or None for all. `rate_hz`: as `textures.load` takes it. Returns one channel for each axis.
    Raises TextureError with the traces to choose from or the files that are missing, OSError when a file cannot be
    read.
    """
    folder = path if path.is_dir() else path.parent
    traces = _traces(folder) if folder.is_dir() else {}
    if path.is_dir():
        if not traces:
            raise TextureError(f"{path}: a folder without traces named ..._X.txt, ..._Y.txt, ..._Z.txt; give a file")
        if len(traces) > 1:
            names = ", ".join(repr(str(folder / name)) for name in sorted(traces)[:3])
            raise TextureError(f"{path}: holds {len(traces)} traces; give one of them, such as {names}")
        (trace,) = traces
    else:
        trace = path.name
        if trace not in traces:
            raise TextureError(f"{path}: no such file or trace; check the name")
    files = _file_of_each_axis(traces[trace])
    wanted = AXES if axis is None else (axis,)
    if missing := [letter for letter in wanted if letter not in files]:
        raise TextureError(
            f"{folder / trace}: no file for axis {', '.join(missing)}; add it, or choose one of the axes there: "
            f"`axis`={' or '.join(sorted(files))}"
        )
    paths = [files[letter] for letter in wanted]
    axes = [with_known_rate(signal_of(read_table(one), one, rate_hz), one) for one in paths]
    if any(one.samples.shape[1] != 1 for one in axes):
        raise TextureError(f"{folder / trace}: several columns in the file of one axis; keep one")
    if len({(len(one.samples), one.rate_hz, one.unit) for one in axes}) > 1:
        lengths = ", ".join(str(len(one.samples)) for one in axes)
        raise TextureError(
            f"{folder / trace}: axes differ in length ({lengths} samples), rate or unit; repair them, or choose one "
            "with `axis`"
        )
    samples = np.hstack([one.samples for one in axes])
    return replace(axes[0], samples=samples, axes=AXES if axis is None else ())


def with_known_rate(contents: Contents, path: Path) -> Contents:
    """Return the contents with the rate of the reference set, if they state none and the file's name is one of it."""
    match = _AXIS_FILE.fullmatch(path.name)
    if contents.rate_hz is None and match and _REFERENCE_TRACE.fullmatch(match[1]):
        return replace(contents, rate_hz=RATE_HZ)
    return contents


def axis_of(path: Path) -> str | None:
    """Return the axis that a file name ends in, or None."""
    match = _AXIS_FILE.fullmatch(path.name)
    return match[2].upper() if match else None


def _traces(folder: Path) -> dict[str, list[Path]]:
    traces: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if match := _AXIS_FILE.fullmatch(path.name):
            traces.setdefault(match[1], []).append(path)
    return traces


def _file_of_each_axis(paths: list[Path]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in paths:
        other = files.setdefault(path.stem[-1].upper(), path)
        if other != path:
            raise TextureError(f"{path}: the same axis as {other.name}; remove or rename one of them")
    return files
