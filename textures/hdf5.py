"""Reads and writes HDF5 files; reads MATLAB's .mat files of version 7.3, which are HDF5 with MATLAB's attributes."""

from collections.abc import Collection, Iterable, Mapping
from math import prod
from pathlib import Path
from typing import Any

from vibrocast.textures import arrays
from vibrocast.textures.recording import Contents, Recording, TextureError

MAGIC = b"\x89HDF\r\n\x1a\n"
MATLAB_START_BYTES = 512  # before the magic of a .mat file
MATLAB_CLASS = "MATLAB_class"
MATLAB_REFERENCED = "#refs#"  # the group with the contents of all cells


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as HDF5, or as a .mat file of version 7.3. Raises OSError."""
    with path.open("rb") as file:
        start = file.read(MATLAB_START_BYTES + len(MAGIC))
    return start.startswith(MAGIC) or start[MATLAB_START_BYTES:] == MAGIC


def has_tables(path: Path) -> bool:
    """Return whether a variable of MATLAB is a table or a timetable. Raises TextureError, OSError."""
    import h5py

    with arrays.parsing(path, "an HDF5 file"), h5py.File(path, "r") as file:
        return any(item.attrs.get(MATLAB_CLASS) in (b"table", b"timetable") for item in file.values())


def read(path: Path, key: str | None, rate_hz: float | None) -> Contents:
    """Read a dataset of numbers; `key`, its path in the file, and `rate_hz` as in `textures.load`.

    Rate and unit are attributes or datasets of one value: of the dataset, else of its group, else of the file. MATLAB
    stores axes in reverse order, so its arrays are transposed. A row is one channel, as a column is. Raises
    TextureError, OSError.
    """
    import h5py

    with arrays.parsing(path, "an HDF5 file"), h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}

        def keep(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith(MATLAB_REFERENCED):
                datasets[name] = item

        file.visititems(keep)  # follows no links to other files
        signals = [name for name, dataset in datasets.items() if _is_of_numbers(dataset) and dataset.size > 1]
        others = {
            name: arrays.in_words(_kind(dataset), dataset.size or 0, _is_of_numbers(dataset))
            for name, dataset in datasets.items()
            if name not in signals
        }
        if key is not None and (key := key.strip("/")) not in datasets:
            key = key.replace(".", "/")  # as MATLAB names the field of a struct
        chosen = arrays.chosen_key(signals, key, path, others)
        dataset = datasets[chosen]
        if dataset.external or dataset.is_virtual:
            raise TextureError(f"{path}: {chosen} has its numbers in other files; save them in this one")
        chunk_bytes = prod(dataset.chunks) * dataset.dtype.itemsize if dataset.chunks else 0
        arrays.reject_too_large(dataset.shape, dataset.dtype, path, dataset.id.get_storage_size(), chunk_bytes)
        group = chosen.rpartition("/")[0]
        places = [
            dataset.attrs,
            dataset.parent.attrs,
            _values_in(group, datasets),
            file.attrs,
            _values_in("", datasets),
        ]
        stated = _nearest(places, arrays.RATE_NAMES) | _nearest(places, arrays.UNIT_NAMES)
        array = dataset[()]
        if MATLAB_CLASS in dataset.attrs and array.ndim == 2:
            array = array if array.shape[1] == 1 else array.T
        return arrays.contents_of(array, path, stated, rate_hz)


def write(path: Path, recording: Recording) -> None:
    """Write samples, with rate_hz and unit as their attributes. Raises OSError."""
    import h5py

    with h5py.File(path, "w") as file:
        dataset = file.create_dataset(arrays.SAMPLES_KEY, data=recording.samples)
        dataset.attrs.update({arrays.RATE_KEY: recording.rate_hz, arrays.UNIT_KEY: recording.unit})


def _is_of_numbers(dataset: Any) -> bool:
    return dataset.dtype.kind in "iuf" and dataset.size is not None and _kind(dataset) not in ("char", "logical")


def _kind(dataset: Any) -> str:
    """Return the name of this type of dataset, for people."""
    matlab_class = dataset.attrs.get(MATLAB_CLASS)
    return f"dataset of type {dataset.dtype}" if matlab_class is None else matlab_class.decode()


def _values_in(group: str, datasets: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that a group states, by name: datasets of one value, and texts of MATLAB."""
    values: dict[str, Any] = {}
    for path, dataset in datasets.items():
        place, _, name = path.rpartition("/")
        if place != group or not arrays.states_something(name):
            continue
        if _kind(dataset) == "char" and dataset.size <= arrays.MAX_CHARACTERS:
            values[name] = "".join(map(chr, dataset[()].ravel()))
        elif dataset.size == 1:
            values[name] = dataset[()]
    return values


def _nearest(places: Iterable[Mapping[str, Any]], names: Collection[str]) -> dict[str, Any]:
    """Return the values of the first place that has any of these names, in any case."""
    for place in places:
        if found := {name: place[name] for name in place if name.lower() in names}:
            return found
    return {}
