"""Data sets: a folder of recordings, or a manifest that lists them; the split into training and test parts."""

import csv
import hashlib
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vibrocast import textures
from vibrocast.errors import InputError
from vibrocast.textures import files, p1918
from vibrocast.textures.files import KEYED_SUFFIXES, SUFFIXES
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import TextureError, known_unit, unusable
from vibrocast.textures.text import column_names

PARTS = ("all", "train", "test")
SPLITS = ("auto", "recording", "material", "subject")
"""The unit that a split keeps whole. "auto": the manifest's column `split`, else materials, else single entries
("recording")."""
TEST_PART = 0.2
"""Share of the entries in the test part: the split of the EVA paper, 56 of the 280 of IEEE P1918.1.1."""
NUMBERS = ("rate_hz", "full_scale", "hand_speed_mm_s")
COLUMNS = ("file", "unit", *NUMBERS, "columns", "reduce", "key", "material", "subject", "split")
"""Columns of a manifest; only the first is required."""
RATE_TOLERANCE = 1e-6
"""Tolerance around a whole number of hertz: a height profile's rate is a quotient of two numbers with few digits."""
LISTED = 3
"""Most skipped files that a summary names."""
MAX_HEADER_CHARACTERS = 10_000

# <interaction>_-_<tool>_-_<material>_-_<speed>, then perhaps the axis: names of recordings in IEEE P1918.1.1.
_REFERENCE_NAME = re.compile(r".+?_-_.+?_-_(.+)_-_.+", re.DOTALL)


@dataclass(frozen=True)
class DatasetEntry:
    """One recording: its own name, and its path for `textures.load`.

    A manifest may state `options` of `textures.load`, material, subject, and `part` ("train", "test" or "").
    """

    name: str
    path: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    stated_material: str = ""
    subject: str = ""
    part: str = ""

    @property
    def material(self) -> str:
        """The material in lower case, from the manifest or from a name as in IEEE P1918.1.1.

        Raises InputError if neither states it.
        """
        if self.stated_material:
            return self.stated_material.casefold()
        match = _REFERENCE_NAME.fullmatch(self.name.rpartition("/")[2])
        if match is None:
            raise InputError(
                f"{self.name}: its name does not state the material; give a manifest with a column material, split "
                'by "recording", or name all files INTERACTION_-_TOOL_-_MATERIAL_-_SPEED'
            )
        return match[1].casefold()


@dataclass(frozen=True)
class Skipped:
    """A file of a folder that is no recording, and why."""

    file: str
    reason: str


@dataclass(frozen=True)
class Dataset:
    """Recordings by name. `skipped`: other files of their folder. `notes`: remarks on the manifest, for people."""

    entries: list[DatasetEntry]
    skipped: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def remarks(self) -> list[str]:
        """Lines for people: the notes, and the number of skipped files with the names of the first ones."""
        if not self.skipped:
            return self.notes
        named = ", ".join(f"{each.file} ({each.reason})" for each in self.skipped[:LISTED])
        more = f" and {len(self.skipped) - LISTED} more" if len(self.skipped) > LISTED else ""
        return [*self.notes, f"skipped {len(self.skipped)} file{'s' * (len(self.skipped) > 1)}: {named}{more}"]


def read(path: Path, leave_out: Path | None = None) -> Dataset:
    """Return the recordings of a folder and its sub-folders, or those that a manifest (CSV) lists; none is opened.

    In a folder, the files ..._X.txt, ..._Y.txt and ..._Z.txt of one name are one entry; so is such a file alone. Every
    other file with one of SUFFIXES is an entry. Hidden files, hidden folders and the folder `leave_out` are ignored,
    other files are skipped. The name of an entry is its path within the folder, without the suffix unless two names are
    equal.

    Raises InputError if there are no recordings or the manifest is wrong, OSError if it cannot be read.
    """
    if path.is_dir():
        return _of_folder(path, leave_out)
    if not path.exists():
        raise InputError(f"{path}: no such folder; give the folder that holds the recordings, or a manifest")
    if path.suffix.lower() != ".csv" or not path.is_file():
        raise InputError(f"{path}: neither a folder nor a manifest; give a folder, or a CSV file with a column file")
    return _of_manifest(path)


def entries(path: Path) -> list[DatasetEntry]:
    """Return the recordings of a folder or manifest, by name. Raises as `read`."""
    return read(path).entries


def split(everything: list[DatasetEntry], part: str, seed: int = 0, by: str = "auto") -> list[DatasetEntry]:
    """Return one of PARTS of the entries, in their order.

    `by`, one of SPLITS: the unit that is never in both parts. With "auto", a manifest's column `split` decides.
    Otherwise the test part is TEST_PART of the entries, or as near to that as whole materials or subjects allow. Equal
    names and seeds give equal parts on every machine. Raises InputError if one part would be empty, if an entry
    states no material or subject, or if "recording" would divide a material that a manifest states.
    """
    if part == "all":
        return everything
    stated = any(entry.stated_material for entry in everything)
    if by == "auto" and any(entry.part for entry in everything):
        chosen = [entry for entry in everything if entry.part == part]
        if not chosen:
            raise InputError(f"the manifest's column split marks no recording as {part}; mark some, or take all")
        return chosen
    if by == "recording" and stated:
        raise InputError(
            'the manifest states materials, and a split by "recording" puts one material into both parts; split by '
            '"material"'
        )
    target = max(1, round(TEST_PART * len(everything)))
    if by in ("material", "subject") or stated:
        kind = "subject" if by == "subject" else "material"
        test = _whole_groups({entry.name: _group(entry, kind) for entry in everything}, target, seed)
    else:
        kind = "recording"
        test = set(sorted((entry.name for entry in everything), key=lambda name: _draw_rank(name, seed))[:target])
    if not 0 < len(test) < len(everything):
        raise InputError(f"there is only one {kind}, which cannot be split; add others, or take all")
    return [entry for entry in everything if (entry.name in test) == (part == "test")]


def load(entry: DatasetEntry, stream_rate_hz: int | None = None, **options: Any) -> textures.Recording:
    """Load an entry and resample it to a whole number of hertz, as a stream needs.

    `options`: of `textures.load`. Each applies only to files that leave it open; a manifest takes precedence. A file
    that states no unit, and gets none, is in "full scale". `stream_rate_hz`: None keeps the rate. Raises TextureError.
    """
    return load_highpassed(entry, None, stream_rate_hz, **options).recording


def load_highpassed(
    entry: DatasetEntry, highpass_hz: float | None, stream_rate_hz: int | None = None, **options: Any
) -> textures.HighPassed:
    """Load an entry as `load` does, and remove the band below `highpass_hz` before resampling.

    As `textures.highpass`, for every unit except "drive"; None = the whole band. Raises their errors.
    """
    chosen = _options_for(entry, options)
    recording = textures.load(entry.path, **chosen)
    if math.isclose(recording.rate_hz, round(recording.rate_hz), rel_tol=RATE_TOLERANCE):
        recording = replace(recording, rate_hz=float(round(recording.rate_hz)))
    elif stream_rate_hz is None:
        raise unusable(
            entry.path,
            f"{recording.rate_hz:g} Hz is no whole number",
            "give the stream's rate as `stream_rate_hz`",
            "stream_rate_hz",
        )
    passed = textures.highpass(recording, textures.highpass_of(chosen.get("unit"), highpass_hz))
    return replace(passed, recording=textures.resample(passed.recording, stream_rate_hz or recording.rate_hz))


def printable(text: str) -> str:
    """Return a text, such as a file's name, with an escape for each byte that is no character."""
    return text.encode(errors="backslashreplace").decode()


def _options_for(entry: DatasetEntry, offered: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of an entry: its manifest's, and those of `offered` that its file leaves open."""
    path, own = entry.path, entry.options
    chosen = {**{name: value for name, value in offered.items() if value is not None}, **own}

    def withdraw(*names: str) -> None:
        for name in names:
            if name not in own:
                chosen.pop(name, None)

    of_axes = path.is_dir() or not path.exists()  # a recording of IEEE P1918.1.1, with a file for each axis
    if path.suffix.lower() not in KEYED_SUFFIXES:
        withdraw("key")
    try:
        # The axes do not matter yet, but a recording of several files must be found.
        columns = files.names_of(chosen.get("columns")) if of_axes else None
        contents = files.read_contents(path, None, columns, None, chosen.get("key"))
    except (TextureError, OSError, MemoryError):  # `textures.load` has a better message
        return chosen
    if isinstance(contents, Profile):
        withdraw("rate_hz", "unit", "full_scale", "columns", "reduce")
        return chosen
    withdraw("hand_speed_mm_s")
    if contents.rate_hz is not None:
        withdraw("rate_hz")
    if not of_axes and contents.samples.shape[1] != len(textures.AXES):
        withdraw("reduce")
    if not of_axes and contents.samples.shape[1] == 1:
        withdraw("columns")
    if contents.unit is None:
        if "full_scale" not in chosen:
            chosen.setdefault("unit", "full scale")
    elif contents.unit != "full scale":
        withdraw("unit", "full_scale")
    elif "full_scale" not in chosen:  # without the value of full scale, its unit has no meaning
        withdraw("unit")
    return chosen


def _of_folder(folder: Path, leave_out: Path | None) -> Dataset:
    grouped: dict[Path, list[Path]] = {}
    skipped = []
    for path in _files_in(folder, leave_out):
        if reason := _no_recording(path):
            skipped.append(Skipped(printable(path.relative_to(folder).as_posix()), reason))
            continue
        of_axis = path.suffix.lower() == ".txt" and p1918.axis_of(path)
        grouped.setdefault(path.with_name(path.stem[:-2]) if of_axis else path, []).append(path)
    # textures.load knows a recording of several files by their common name.
    paths = [paths[0] if len(paths) == 1 else together for together, paths in grouped.items()]
    if not paths:
        raise InputError(f"{folder}: no recordings ({', '.join(SUFFIXES)}) in it or its sub-folders; give another")
    return Dataset(_named([DatasetEntry("", path) for path in paths], folder), skipped)


def _files_in(folder: Path, leave_out: Path | None) -> Iterator[Path]:
    """Yield the files of a folder and its sub-folders, hidden ones left out, in their order. Raises OSError."""
    avoided = leave_out and leave_out.resolve()
    for parent, folders, names in os.walk(folder, onerror=_raise):
        here = Path(parent)
        folders[:] = sorted(name for name in folders if name[0] != "." and (here / name).resolve() != avoided)
        yield from (here / name for name in sorted(names) if name[0] != ".")


def _raise(error: OSError) -> None:
    raise error


def _no_recording(path: Path) -> str:
    """Return why a file is no recording; "" for one that may be."""
    if path.suffix.lower() not in SUFFIXES:
        return "of another kind"
    if path.suffix.lower() == ".csv" and path.is_file():
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            if "file" in _fields(file.readline(MAX_HEADER_CHARACTERS)):
                return "a manifest; give it in place of the folder to use it"
    if path.suffix.lower() in files.TEXT_SUFFIXES and path.is_file() and column_names(path) is None:
        return "text without numbers"
    return ""


def _fields(line: str) -> list[str]:
    return [name.strip().strip('"') for name in line.split(",")]


def _of_manifest(manifest: Path) -> Dataset:
    rows, columns = _rows(manifest)
    found, missing = [], []
    for place, row in rows.items():
        if not row["file"]:
            raise InputError(f"{place}, file: empty; name the recording's file")
        path = manifest.parent / row["file"]
        if not path.exists() and not any(path.with_name(f"{path.name}_{axis}.txt").exists() for axis in textures.AXES):
            missing.append(f"{place}, file: {row['file']}")
        part = row.get("split", "").lower()
        if part not in ("", "train", "test"):
            raise InputError(f"{place}, split: {part!r} is neither train nor test; correct it, or leave it empty")
        material, subject = row.get("material", ""), row.get("subject", "")
        found.append(DatasetEntry("", path, _stated_options(row, place), material, subject, part))
    if missing:
        more = f", nor do those of {len(missing) - 1} other rows" if len(missing) > 1 else ""
        raise InputError(f"{missing[0]} does not exist{more}; paths start at the manifest's folder")
    named = _named(found, manifest.parent)
    if alike := [name for name, times in Counter(entry.name for entry in named).items() if times > 1]:
        raise InputError(f"{manifest}: {alike[0]} is in several rows; keep one, or give them different columns or keys")
    return Dataset(named, notes=_notes(manifest, named, columns))


def _rows(manifest: Path) -> tuple[dict[str, dict[str, str]], list[str]]:
    """Return the rows of a manifest by their place, without blanks around values, and the columns.

    Raises InputError.
    """
    with manifest.open(newline="", encoding="utf-8-sig") as file:
        try:
            reader = csv.DictReader(file, skipinitialspace=True, strict=True)
            columns = [name.strip() for name in reader.fieldnames or ()]
            if "file" not in columns:
                raise InputError(
                    f"{manifest}: no column file; a manifest is a CSV file with a column file and any of "
                    f"{', '.join(COLUMNS[1:])}"
                )
            if twice := [name for name, times in Counter(columns).items() if times > 1]:
                raise InputError(f"{manifest}: two columns {twice[0]!r}; keep one")
            reader.fieldnames = columns
            rows = {}
            for row in reader:
                place = f"{manifest}, row {reader.line_num}"
                if None in row or None in row.values():
                    raise InputError(f"{place}: not one value for each of the {len(columns)} columns; correct it")
                rows[place] = {name: value.strip() for name, value in row.items()}
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{manifest}: not a CSV file in UTF-8: {error}; save it as one") from error
    if not rows:
        raise InputError(f"{manifest}: lists no recordings; add a row for each")
    return rows, columns


def _stated_options(row: Mapping[str, str], place: str) -> dict[str, Any]:
    """Return the options of a row for `textures.load`. Raises InputError."""
    options: dict[str, Any] = {name: row[name] for name in ("columns", "reduce", "key") if row.get(name)}
    if options.get("reduce") not in (None, *textures.REDUCTIONS):
        known = ", ".join(textures.REDUCTIONS)
        raise InputError(f"{place}, reduce: {options['reduce']!r} is none of {known}; correct it")
    if row.get("unit"):
        try:
            options["unit"] = known_unit(row["unit"], f"{place}, unit")
        except TextureError as error:
            raise InputError(f"{error}; correct it, or leave it empty") from error
    for name in NUMBERS:
        if text := row.get(name):
            try:
                options[name] = float(text)
            except ValueError:
                options[name] = math.nan
            if not 0 < options[name] < math.inf:
                raise InputError(f"{place}, {name}: {text!r} is no positive number; correct it, or leave it empty")
    return options


def _notes(manifest: Path, named: Sequence[DatasetEntry], columns: Sequence[str]) -> list[str]:
    notes = []
    if unused := [name for name in columns if name not in COLUMNS]:
        notes.append(f"{manifest}: columns not used: {', '.join(unused)}; known are {', '.join(COLUMNS)}")
    parts: dict[str, set[str]] = {}
    for entry in named:
        if entry.stated_material and entry.part:
            parts.setdefault(entry.material, set()).add(entry.part)
    if torn := sorted(material for material, own in parts.items() if len(own) > 1):
        several = "s" * (len(torn) > 1)
        notes.append(
            f"{manifest}: the column split puts {len(torn)} material{several} into both parts: {torn[0]} first"
        )
    return notes


def _named(found: Sequence[DatasetEntry], folder: Path) -> list[DatasetEntry]:
    """Return the entries in the order of their names, each with its name.

    The name is the path within the folder, without the suffix unless two names are equal; then a manifest's key and
    columns.
    """
    stems = [_within(_stem(entry.path), folder) + _chosen_part(entry) for entry in found]
    times = Counter(stems)
    named = [
        replace(entry, name=printable(stem if times[stem] == 1 else _within(entry.path, folder) + _chosen_part(entry)))
        for stem, entry in zip(stems, found, strict=True)
    ]
    return sorted(named, key=lambda entry: entry.name)


def _chosen_part(entry: DatasetEntry) -> str:
    key, columns = entry.options.get("key"), entry.options.get("columns")
    return (f":{key}" if key else "") + (f"_{columns}" if columns else "")


def _within(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.as_posix()


def _stem(path: Path) -> Path:
    return path.with_suffix("") if path.suffix.lower() in SUFFIXES else path


def _group(entry: DatasetEntry, kind: str) -> str:
    """Return the material or the subject of an entry. Raises InputError if the entry states none."""
    if kind == "material":
        return entry.material
    if not entry.subject:
        raise InputError(f"{entry.name}: states no subject; give a manifest with a column subject")
    return entry.subject


def _whole_groups(groups: Mapping[str, str], target: int, seed: int) -> set[str]:
    """Return the names in some whole groups, as near to `target` as possible; none if there is only one group."""
    counts = Counter(groups.values())
    # The sizes that some groups have together, each with the first such groups in the order of the seed.
    together: dict[int, frozenset[str]] = {0: frozenset()}
    for group in sorted(counts, key=lambda name: _draw_rank(name, seed)):
        for size, chosen in list(together.items()):
            together.setdefault(size + counts[group], chosen | {group})
    sizes = [size for size in sorted(together) if 0 < size < len(groups)]
    nearest = together[min(sizes, key=lambda size: abs(size - target), default=0)]
    return {name for name, group in groups.items() if group in nearest}


def _draw_rank(name: str, seed: int) -> bytes:
    """Return bytes that decide a name's place in the order drawn with a seed."""
    return hashlib.sha256(f"{seed}:{name}".encode()).digest()
