"""Reads NPY and NPZ files, and interprets the arrays of any file: the chosen one, its rate and its unit."""

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.memory import excess, shortage
from vibrocast.textures.recording import FILE_UNITS, Contents, TextureError, known_unit, unusable

SAMPLES_KEY, RATE_KEY, UNIT_KEY = "samples", "rate_hz", "unit"
# Names of arrays and attributes that state the rate and the unit, in any case.
RATE_NAMES = (RATE_KEY, "fs", "sample_rate", "sample_rate_hz", "sampling_rate")
UNIT_NAMES = (UNIT_KEY, "units")
MAX_CHARACTERS = 100  # of a unit

_KIND = "an array of numbers in NumPy's format"
_ZIP_MAGIC = b"PK"
_MAX_LISTED = 10


def read(path: Path, key: str | None, rate_hz: float | None) -> Contents:
    """Read an NPY or NPZ file; `key` and `rate_hz` as `textures.load` takes them. Raises TextureError, OSError."""
    with parsing(path, _KIND), path.open("rb") as file:
        zipped = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
        file.seek(0)
        if not zipped:
            return contents_of(_read_array(file, path, path.stat().st_size), path)
        with zipfile.ZipFile(file) as archive:
            members = _members(archive)
            stated = {name: _read_member(archive, members[name], path) for name in members if states_something(name)}
            chosen = chosen_key([name for name in members if name not in stated], key, path)
            return contents_of(_read_member(archive, members[chosen], path), path, stated, rate_hz)


def read_archive(path: Path) -> dict[str, NDArray[Any]]:
    """Return all arrays of an NPZ file by name. Raises TextureError, OSError."""
    with parsing(path, "an NPZ archive"), zipfile.ZipFile(path) as archive:
        return {name: _read_member(archive, info, path) for name, info in _members(archive).items()}


@contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Turn any error of a library's parser on a damaged or foreign file into a TextureError, except OSError."""
    try:
        yield
    except (TextureError, OSError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split())
        raise TextureError(f"{path}: not {kind} that can be read; save it again ({reason})") from error


def reject_too_large(
    shape: Sequence[int], dtype: np.dtype[Any], path: Path, stored_bytes: int, besides_bytes: int = 0
) -> None:
    """Raise TextureError if memory cannot hold the array as in the file, `besides_bytes` and the float64 copy.

    Also if the file's `stored_bytes` cannot stand for so large an array.
    """
    each_bytes = 8 if dtype == np.float64 else 8 + dtype.itemsize
    stated_bytes = prod(shape) * dtype.itemsize
    if lack := shortage(prod(shape) * each_bytes + besides_bytes) or excess(stated_bytes, stored_bytes):
        raise TextureError(f"{path}: an array of shape {tuple(shape)} {lack}")


def states_something(name: str) -> bool:
    """Return whether an array or attribute of this name states the rate or the unit."""
    return name.lower() in RATE_NAMES + UNIT_NAMES


def chosen_key(names: Sequence[str], key: str | None, path: Path, others: Mapping[str, str] | None = None) -> str:
    """Return the name of the array to read: `key`, `samples` or the only one. Raises TextureError.

    `others`: the file's contents other than arrays of numbers, with their kinds in words.
    """
    if not names and not others:
        raise TextureError(f"{path}: holds no array of numbers; give another file")
    if key is None and SAMPLES_KEY in names:
        return SAMPLES_KEY
    if key is None and len(names) == 1:
        return names[0]
    if key is None or key not in names:
        unusable = {key: others[key]} if key is not None and others and key in others else others
        if unusable and (key in unusable or not names):
            listed = _listed([f"{name} is {kind}" for name, kind in unusable.items()])
            raise TextureError(f"{path}: {listed}, not an array of numbers; save the samples as an array")
        problem = "choose an array with `key`" if key is None else f"no array of numbers `key`={key}"
        raise TextureError(f"{path}: {problem}; there are {_listed(names)}", parameter="key")
    return key


def in_words(kind: str, size: int, of_numbers: bool) -> str:
    """Return the kind of a variable that is no array of numbers, for `chosen_key`."""
    if of_numbers:
        return "one number" if size else "empty"
    return f"a {kind}"


def contents_of(
    array: NDArray[Any], path: Path, stated: Mapping[str, Any] | None = None, rate_hz: float | None = None
) -> Contents:
    """Return an array as the channels of a recording, with the rate and unit that `stated` has.

    `stated`: values by name, for all names that `states_something` knows. `rate_hz`: the user's rate, which decides if
    several rates are stated. Raises TextureError.
    """
    if array.dtype.kind in "iuf" and array.ndim == 0:
        raise TextureError(f"{path}: holds one number, not an array of numbers; save the samples as an array")
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2):
        raise TextureError(
            f"{path}: an array of type {array.dtype} and shape {array.shape}; "
            "store integers or floats of shape (samples,) or (samples, channels)"
        )
    full_scale: float | None = 1.0
    if array.dtype.kind != "f":
        # The range of longer or unsigned integers does not tell the signal's full scale.
        pcm = array.dtype.kind == "i" and array.dtype.itemsize <= 4
        full_scale = float(2 ** (8 * array.dtype.itemsize - 1)) if pcm else None
    samples = array.astype(np.float64, copy=False)
    columns = samples.reshape(-1, 1) if array.ndim == 1 else samples
    rates = {name: _number(name, value, path) for name, value in (stated or {}).items() if name.lower() in RATE_NAMES}
    units = [_text(value) for name, value in (stated or {}).items() if name.lower() in UNIT_NAMES]
    unit = next((known_unit(text, f"{path}: {UNIT_KEY}", FILE_UNITS) for text in units if text), None)
    return Contents(columns, _only_rate(rates, rate_hz, path), unit, full_scale)


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an NPZ file that are arrays, by name."""
    named = {info.filename: info for info in archive.infolist()}
    return {name.removesuffix(".npy"): info for name, info in named.items() if name.endswith(".npy")}


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> NDArray[Any]:
    """Read a member of an NPZ file. Raises ValueError and all other errors of NumPy and zipfile."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{info.filename} is packed in a way that NumPy does not write")
    with archive.open(info) as member:
        return _read_array(member, path, info.compress_size)


def _read_array(file: IO[bytes], path: Path, stored_bytes: int) -> NDArray[Any]:
    """Read an array in NPY format, unless it is too large. Raises ValueError and all other errors of NumPy."""
    version = np.lib.format.read_magic(file)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = header(file)
    reject_too_large(shape, dtype, path, stored_bytes)
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MAX_LISTED} more" if len(texts) > _MAX_LISTED else ""
    return (", ".join(texts[:_MAX_LISTED]) or "none") + more


def _only_rate(rates: Mapping[str, float], rate_hz: float | None, path: Path) -> float | None:
    different = set(rates.values())
    if len(different) > 1 and rate_hz not in different:
        listed = ", ".join(f"{name} {value:g}" for name, value in rates.items())
        raise unusable(path, f"states several rates, {listed}", "choose one with `rate_hz`", "rate_hz")
    return rate_hz if len(different) > 1 else next(iter(different), None)


def _number(name: str, value: Any, path: Path) -> float:
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError) as error:
        raise TextureError(f"{path}: {name} is not one number; correct it") from error


def _text(value: Any) -> str:
    """Return a text that a file stores as text, as bytes or as an array of one."""
    item = np.asarray(value).item() if np.size(value) == 1 else ""
    return item.decode(errors="replace") if isinstance(item, bytes) else str(item)
