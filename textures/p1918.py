"""Reads the IEEE P1918.1.1 reference set: one text file an axis, three axes reduced to one signal.

The files of a recording are `<interaction>_-_<tool>_-_<material>_-_<speed>_<axis>.txt` for the axes X, Y and Z, with
one value a line at 2800 Hz. They state no unit.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vibrocast.textures.axes import AXES
from vibrocast.textures.columns import signal_of
from vibrocast.textures.recording import Contents, TextureError, unusable
from vibrocast.textures.text import read_table

RATE_HZ = 2800.0

_AXIS_FILE = re.compile(r"(.+)_([XYZ])\.txt", re.IGNORECASE | re.DOTALL)
_REFERENCE_NAME = re.compile(r".+_-_.+_-_.+_-_[^_]+", re.DOTALL)


def read_folder(path: Path, columns: Sequence[str] | None, rate_hz: float | None) -> Contents:
    """Read one recording: `path` is a folder with one recording, or FOLDER/NAME without axis and `.txt`.

    `columns`: letters or numbers of axes, or None for all. `rate_hz`: as in `textures.load`. Returns one channel for
    each axis. Raises TextureError with the recordings to choose from or the missing files, OSError when a file cannot
    be read.
    """
    folder = path if path.is_dir() else path.parent
    recordings = _recordings(folder) if folder.is_dir() else {}
    if path.is_dir():
        if not recordings:
            raise TextureError(f"{path}: a folder without files named ..._X.txt, ..._Y.txt, ..._Z.txt; give a file")
        if len(recordings) > 1:
            names = ", ".join(repr(str(folder / name)) for name in sorted(recordings)[:3])
            raise TextureError(f"{path}: holds {len(recordings)} recordings; give one of them, such as {names}")
        (name,) = recordings
    else:
        name = path.name
        if name not in recordings:
            raise TextureError(f"{path}: no such file or recording; check the name")
    files = _file_of_each_axis(recordings[name])
    known = {**{letter: letter for letter in AXES}, **{str(number): letter for number, letter in enumerate(AXES, 1)}}
    if unknown := [name for name in columns or () if name.upper() not in known]:
        raise unusable(path, f"no axis {unknown[0]!r}", "choose of x, y and z with `columns`", "columns")
    wanted = tuple(known[name.upper()] for name in columns or AXES)
    if missing := [letter for letter in wanted if letter not in files]:
        raise unusable(
            folder / name,
            f"no file for axis {', '.join(missing)}",
            f"add it, or choose of the axes there: `columns`={' or '.join(sorted(files)).lower()}",
            "columns",
        )
    paths = [files[letter] for letter in wanted]
    axes = [with_known_rate(signal_of(read_table(one), one, rate_hz), one) for one in paths]
    if any(one.samples.shape[1] != 1 for one in axes):
        raise TextureError(f"{folder / name}: several columns in the file of one axis; keep one")
    if len({(len(one.samples), one.rate_hz, one.unit) for one in axes}) > 1:
        lengths = ", ".join(str(len(one.samples)) for one in axes)
        raise unusable(
            folder / name,
            f"axes differ in length ({lengths} samples), rate or unit",
            "repair them, or choose one with `columns`",
            "columns",
        )
    samples = np.hstack([one.samples for one in axes])
    return replace(axes[0], samples=samples, axes=AXES if wanted == AXES else ())


def with_known_rate(contents: Contents, path: Path) -> Contents:
    """Return the contents with the reference set's rate, if they state none and the file's name is in the set."""
    match = _AXIS_FILE.fullmatch(path.name)
    if contents.rate_hz is None and match and _REFERENCE_NAME.fullmatch(match[1]):
        return replace(contents, rate_hz=RATE_HZ)
    return contents


def axis_of(path: Path) -> str | None:
    """Return the axis at the end of a file name, or None."""
    match = _AXIS_FILE.fullmatch(path.name)
    return match[2].upper() if match else None


def _recordings(folder: Path) -> dict[str, list[Path]]:
    recordings: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if match := _AXIS_FILE.fullmatch(path.name):
            recordings.setdefault(match[1], []).append(path)
    return recordings


def _file_of_each_axis(paths: list[Path]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in paths:
        other = files.setdefault(path.stem[-1].upper(), path)
        if other != path:
            raise TextureError(f"{path}: the same axis as {other.name}; remove or rename one of them")
    return files
