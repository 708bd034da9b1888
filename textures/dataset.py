"""A folder of recordings as single traces, and its seeded split into a training and a test part."""

import hashlib
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vibrocast import textures
from vibrocast.textures import p1918
from vibrocast.textures.files import ARRAY_SUFFIXES, TEXT_SUFFIXES

SUFFIXES = (".wav", *TEXT_SUFFIXES, *ARRAY_SUFFIXES)
PARTS = ("all", "train", "test")
TEST_PART = 0.2
"""Of all traces: the split of the EVA paper, 56 of the 280 of IEEE P1918.1.1."""

# <interaction>_-_<tool>_-_<material>_-_<speed>, then perhaps the axis, as IEEE P1918.1.1 names its traces.
_REFERENCE_TRACE = re.compile(r".+?_-_.+?_-_(.+)_-_.+", re.DOTALL)


class DatasetError(ValueError):
    """A folder or a split that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class Trace:
    """One recording of a folder: a name of its own, and the path by which `textures.load` knows it."""

    name: str
    path: Path

    @property
    def material(self) -> str:
        """The material in the name of an IEEE P1918.1.1 trace, in lower case. Raises DatasetError for other names."""
        match = _REFERENCE_TRACE.fullmatch(self.name)
        if match is None:
            raise DatasetError(
                f"{self.name}: its name does not state the material; split by trace, or name all files "
                "INTERACTION_-_TOOL_-_MATERIAL_-_SPEED"
            )
        return match[1].casefold()


def traces(folder: Path) -> list[Trace]:
    """Return the recordings that lie in a folder itself, by name; none is opened.

    Files named ..._X.txt, ..._Y.txt and ..._Z.txt are one trace, a single one of them is a trace by itself, all others
    of SUFFIXES are one each; files of other kinds and hidden ones are left out. The name is the file's without its
    suffix, or with it where two would be alike. Raises DatasetError where there are none, OSError where the folder
    cannot be read.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; give the folder that holds the recordings")
    grouped: dict[Path, list[Path]] = {}
    for path in folder.iterdir():
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and not path.is_dir():
            of_axis = path.suffix.lower() == ".txt" and p1918.axis_of(path)
            grouped.setdefault(path.with_name(path.stem[:-2]) if of_axis else path, []).append(path)
    # textures.load knows a trace of several files by their common name.
    paths = [paths[0] if len(paths) == 1 else together for together, paths in grouped.items()]
    if not paths:
        raise DatasetError(f"{folder}: no recordings ({', '.join(SUFFIXES)}) in it; sub-folders are not searched")
    stems = Counter(_stem(path) for path in paths)
    names = {printable(path.name if stems[_stem(path)] > 1 else _stem(path)): path for path in paths}
    return [Trace(name, names[name]) for name in sorted(names)]


def split(everything: list[Trace], part: str, seed: int = 0, by_material: bool = False) -> list[Trace]:
    """Return the part, one of PARTS, of the traces, in their order; the test part is TEST_PART of them.

    The same names and seed give the same parts everywhere. `by_material`: no material is in both parts, and the test
    part is as near to TEST_PART as whole materials come. Raises DatasetError where nothing is left for one part, and
    for names that do not state a material.
    """
    if part == "all":
        return everything
    wanted = max(1, round(TEST_PART * len(everything)))
    if by_material:
        test = _whole_materials(everything, wanted, seed)
    else:
        test = set(sorted((trace.name for trace in everything), key=lambda name: _lot(name, seed))[:wanted])
    if not 0 < len(test) < len(everything):
        kind = "material" if by_material else "trace"
        raise DatasetError(f"there is only one {kind}, which cannot be split; add others, or take all")
    return [trace for trace in everything if (trace.name in test) == (part == "test")]


def load(
    trace: Trace, stream_rate_hz: int | None = None, hand_speed_mm_s: float | None = None, **options: Any
) -> textures.Recording:
    """Load a trace by `textures.load` with these options and resample it to a whole number of hertz, as a stream needs.

    `stream_rate_hz`: None leaves the rate as it is. `hand_speed_mm_s` is for those files only that may hold a height
    profile. Raises TextureError with what to do.
    """
    if trace.path.suffix.lower() not in TEXT_SUFFIXES:
        hand_speed_mm_s = None
    recording = textures.load(trace.path, hand_speed_mm_s=hand_speed_mm_s, **options)
    if stream_rate_hz is None and not recording.rate_hz.is_integer():
        raise textures.TextureError(
            f"{trace.path}: {recording.rate_hz:g} Hz is no whole number; give the rate to code it at: `stream_rate_hz`"
        )
    return textures.resample(recording, stream_rate_hz or recording.rate_hz)


def _whole_materials(everything: list[Trace], wanted: int, seed: int) -> set[str]:
    """Return the names of all traces of some materials, as near to `wanted` as can be; none where there is but one."""
    counts = Counter(trace.material for trace in everything)
    # What sizes some of the materials have together, and the first such materials in the order of the seed.
    together: dict[int, frozenset[str]] = {0: frozenset()}
    for material in sorted(counts, key=lambda name: _lot(name, seed)):
        for size, materials in list(together.items()):
            together.setdefault(size + counts[material], materials | {material})
    sizes = [size for size in sorted(together) if 0 < size < len(everything)]
    chosen = together[min(sizes, key=lambda size: abs(size - wanted), default=0)]
    return {trace.name for trace in everything if trace.material in chosen}


def printable(text: str) -> str:
    """Return a text, such as a file's name, with an escape in place of each byte that is no character."""
    return text.encode(errors="backslashreplace").decode()


def _stem(path: Path) -> str:
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


def _lot(name: str, seed: int) -> bytes:
    """Return a number, in bytes, that decides a name's place in the order drawn with a seed."""
    return hashlib.sha256(f"{seed}:{name}".encode()).digest()
