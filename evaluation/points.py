"""Rows that measurements are kept in - rate and quality, times, failures - read from and written to CSV files."""

import csv
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, asdict, dataclass, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, TypeVar, get_type_hints

from vibrocast.errors import InputError, located
from vibrocast.files import atomic_write
from vibrocast.textures import Recording, TextureError
from vibrocast.textures.dataset import DatasetEntry, printable

MEASURED, PROGRAM, IMPORTED = "measured", "program", "imported"
"""Where figures come from: a codec here, a program of the user's here, a table of others' figures."""

IMPORTED_COLUMNS = ("bits_per_sample", "bytes_payload", "encode_s", "decode_s")
"""Columns that a table of others' points may have in addition to those of Point."""
_MAX_COUNT = 2**63


@dataclass(frozen=True)
class Point:
    """One recording, coded at one setting of a codec: its samples, all channels together, all bytes, and the quality.

    `codec`: the name of the curve: a set of rate points of settings. Qualities as in evaluation.metrics; None where one
    has no value, or was not measured. `delay_ms`: algorithmic. `source`: MEASURED, PROGRAM or IMPORTED.
    """

    trace: str
    codec: str
    setting: str
    samples: int
    bytes_total: int
    snr_db: float | None
    rate_hz: float | None = None
    psnr_db: float | None = None
    st_sim_2800: float | None = None
    st_sim_8000: float | None = None
    spqi: float | None = None
    log_spectral_distance_db: float | None = None
    third_octave_distance_db: float | None = None
    delay_ms: float | None = None
    source: str = MEASURED

    def __post_init__(self) -> None:
        if not (0 < self.samples < _MAX_COUNT and 0 < self.bytes_total < _MAX_COUNT):
            raise InputError("samples and bytes must be positive")
        if not all(value is None or 0 <= value < math.inf for value in (self.rate_hz, self.delay_ms)):
            raise InputError("rate_hz and delay_ms must be finite and not negative")

    @property
    def bits_per_sample(self) -> float:
        """Bits for each sample, of all bytes that a receiver needs."""
        return 8 * self.bytes_total / self.samples

    @property
    def compression_ratio(self) -> float:
        """How many times smaller than 16 bits for each sample."""
        return 16 / self.bits_per_sample


@dataclass(frozen=True)
class Timing:
    """The time of coding one recording at one setting: seconds per million samples of one core, without process start.

    Those of programs and imported ones are wall-clock seconds with process start: an order of magnitude.
    """

    trace: str
    codec: str
    setting: str
    encode_s_per_megasample: float
    decode_s_per_megasample: float
    source: str = MEASURED

    def __post_init__(self) -> None:
        if not (0 <= self.encode_s_per_megasample < math.inf and 0 <= self.decode_s_per_megasample < math.inf):
            raise InputError("times must be finite and not negative")


@dataclass(frozen=True)
class Failure:
    """One recording at one setting of a codec that gave no point, and why.

    `codec`, `setting`: empty for a recording that cannot be read.
    """

    trace: str
    codec: str
    setting: str
    reason: str

    @classmethod
    def of(cls, error: Exception, trace: str, codec: str = "", setting: str = "") -> Self:
        """Return an error as a failure, in one line; an exception of Python itself says little without its name."""
        text = printable(" ".join(str(error).split()))
        named = f"{type(error).__name__}: {text}".removesuffix(": ") if type(error).__module__ == "builtins" else text
        return cls(trace, codec, setting, named)


class Record(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Row = TypeVar("Row", bound=Record)


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """Read a CSV file into rows of a dataclass whose fields are text, whole numbers or numbers, some of them optional.

    The file has at least a column for each field without a default; others it has are ignored. Raises InputError
    where it is no such file, OSError where it cannot be read.
    """
    kinds = get_type_hints(kind)
    columns = {field.name: field.default is MISSING for field in fields(kind)}
    read = []
    for line, texts in enumerate(_texts(path, [name for name, needed in columns.items() if needed]), 2):
        filled = {name: text for name, text in texts.items() if text}
        values = {}
        for name, needed in columns.items():
            if needed or name in filled:
                try:
                    values[name] = _READERS[kinds[name]](filled.get(name, ""))
                except ValueError as error:
                    raise InputError(f"{path}, row {line}, {name}: {error}") from error
        with located(f"{path}, row {line}"):
            read.append(kind(**values))
    return read


def read_row(path: Path, kind: type[Row]) -> Row:
    """Read a CSV file that has one row. Raises as `read_rows`, and InputError for another number of rows."""
    rows = read_rows(path, kind)
    if len(rows) != 1:
        raise InputError(f"{path}: {len(rows)} rows in place of one; run the command again that wrote it")
    return rows[0]


def read_imported(path: Path) -> tuple[list[Point], list[Timing]]:
    """Read others' points, and their timings where columns encode_s and decode_s hold the seconds of one recording.

    All count as imported, those of another benchmark's points.csv too. Raises as `read_rows`, and for columns that
    there are not.
    """
    points, timings, texts = read_rows(path, Point), [], _texts(path, ())
    known = [*(field.name for field in fields(Point)), *IMPORTED_COLUMNS]
    if unknown := [name for name in next(iter(texts), ()) if name not in known]:
        raise InputError(f"{path}, row 1: no column is called {unknown[0]!r}; expected some of {', '.join(known)}")
    for line, row in enumerate(texts, 2):
        if row.get("encode_s") and row.get("decode_s"):
            try:
                megasamples = int(row["samples"]) / 1e6
                times = float(row["encode_s"]) / megasamples, float(row["decode_s"]) / megasamples
                timings.append(Timing(row["trace"], row["codec"], row["setting"], *times, IMPORTED))
            except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
                raise InputError(f"{path}, row {line}: encode_s or decode_s: {error}") from error
    return [replace(point, source=IMPORTED) for point in points], timings


def check_imported(
    path: Path, everything: Sequence[DatasetEntry], wanted: Collection[str], load: Callable[[DatasetEntry], Recording]
) -> None:
    """Check a table of others' points against the recordings that they are of.

    `everything`: the recordings of the data set; of those `wanted`, samples and rate are compared, after `load`. One
    that cannot be loaded is not compared. Raises InputError where a row differs, OSError where it cannot be read.
    """
    by_name = {trace.name: trace for trace in everything}
    expected: dict[str, Recording | None] = {}
    for line, row in enumerate(_texts(path, ()), 2):
        name = row["trace"]
        if name not in by_name:
            likely = get_close_matches(name, by_name, 1) or sorted(by_name)[:1]
            raise InputError(
                f"{path}, row {line}, trace: the data set has no {name!r}; expected one of {len(by_name)} names "
                f"such as {likely[0]!r}"
            )
        if name not in wanted:
            continue
        if name not in expected:
            try:
                expected[name] = load(by_name[name])
            except TextureError:
                expected[name] = None
        recording = expected[name]
        if recording is None:
            continue
        compared = (("samples", recording.samples.size), ("rate_hz", recording.rate_hz))
        for column, value in compared:
            if row.get(column) and float(row[column]) != value:
                raise InputError(
                    f"{path}, row {line}, {column}: {row[column]}; expected {value:g}, as {name!r} has here: "
                    "correct the table, or code at its rate (--stream-rate-hz)"
                )


def write_rows(path: Path, rows: Iterable[Row], kind: type[Row]) -> None:
    """Write rows of a dataclass as CSV, whole or not at all; points with bits_per_sample behind the other columns.

    Raises OSError.
    """
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        names = [field.name for field in fields(kind)]
        table.writerow([*names, "bits_per_sample"] if kind is Point else names)
        for row in rows:
            extra = [round(row.bits_per_sample, 4)] if isinstance(row, Point) else []
            table.writerow([*("" if value is None else value for value in asdict(row).values()), *extra])


def by_codec_and_trace(points: Iterable[Point]) -> dict[str, dict[str, list[Point]]]:
    """Return the points of each codec and recording, in their order."""
    curves: dict[str, dict[str, list[Point]]] = {}
    for point in points:
        curves.setdefault(point.codec, {}).setdefault(point.trace, []).append(point)
    return curves


def _texts(path: Path, needed: Iterable[str]) -> list[dict[str, str]]:
    if path.exists() and not path.is_file():  # a pipe waits for its writer, a device may never end
        raise InputError(f"{path}: no file; give a CSV file")
    with path.open(newline="", encoding="utf-8") as file:
        try:
            rows = csv.DictReader(file)
            if missing := [name for name in needed if name not in (rows.fieldnames or ())]:
                raise InputError(f"{path}: no column {', '.join(missing)}; it must have {', '.join(needed)}")
            return list(rows)
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not a CSV file: {error}") from error


def _number(text: str) -> float:
    number = float(text)
    if math.isnan(number) or number == -math.inf:
        raise ValueError(f"{text}; leave the field empty where there is no value")
    return number


_READERS: Mapping[Any, Callable[[str], Any]] = {
    str: str,
    int: int,
    float: _number,
    int | None: lambda text: int(text) if text else None,
    float | None: lambda text: _number(text) if text else None,
}
