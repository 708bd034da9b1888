"""Measured points - rate and quality, and the time they took - of this project's codecs and its peers, as CSV files."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar


class PointsError(ValueError):
    """A file of measured points that cannot be used; the message says why."""


@dataclass(frozen=True)
class Point:
    """One trace, coded at one setting of a codec: its samples, all channels together, all bytes, and the quality.

    `codec`: the name of the curve: a ladder of settings. Qualities as in evaluation.metrics; None where one has no
    value, or was not measured. `delay_ms`: algorithmic. `source`: "measured" here, or "imported" from others' figures.
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
    delay_ms: float | None = None
    source: str = "measured"

    def __post_init__(self) -> None:
        if self.samples <= 0 or self.bytes_total <= 0:
            raise PointsError("samples and bytes must be positive")

    @property
    def bits_per_sample(self) -> float:
        """Bits for each sample, of all bytes that a receiver needs."""
        return 8 * self.bytes_total / self.samples


@dataclass(frozen=True)
class Timing:
    """What coding one trace at one setting took: seconds per million samples of one core, without process start.

    Those imported are wall-clock seconds with process start: an order of magnitude.
    """

    trace: str
    codec: str
    setting: str
    encode_s_per_megasample: float
    decode_s_per_megasample: float
    source: str = "measured"


Row = TypeVar("Row", Point, Timing)


def read_points(path: Path, source: str = "measured") -> list[Point]:
    """Read a CSV file with at least the columns of Point that have no default; `source` where it does not say.

    Raises PointsError where it is no such file, OSError where it cannot be read.
    """
    return _read(path, Point, lambda row: {"source": source, **row})


def read_timings(path: Path) -> list[Timing]:
    """Read a CSV file of timings. Raises as `read_points`."""
    return _read(path, Timing, lambda row: row)


def read_imported(path: Path) -> tuple[list[Point], list[Timing]]:
    """Read others' points, and their timings where columns encode_s and decode_s hold the seconds of one trace.

    Raises as `read_points`.
    """
    points = read_points(path, "imported")
    timed = ("trace", "codec", "setting", "samples", "encode_s", "decode_s")
    rows = [row for row in _rows(path, ()) if all(row.get(name) for name in timed)]
    try:
        return points, [
            Timing(
                row["trace"],
                row["codec"],
                row["setting"],
                1e6 * float(row["encode_s"]) / int(row["samples"]),
                1e6 * float(row["decode_s"]) / int(row["samples"]),
                "imported",
            )
            for row in rows
        ]
    except ValueError as error:
        raise PointsError(f"{path}: encode_s or decode_s: {error}") from error


def write_rows(path: Path, rows: Iterable[Point] | Iterable[Timing], kind: type[Point] | type[Timing]) -> None:
    """Write points or timings as CSV; points with bits_per_sample behind the other columns. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        names = [field.name for field in fields(kind)]
        table.writerow([*names, "bits_per_sample"] if kind is Point else names)
        for row in rows:
            extra = [round(row.bits_per_sample, 4)] if isinstance(row, Point) else []
            table.writerow([*("" if value is None else value for value in asdict(row).values()), *extra])


def by_codec_and_trace(points: Iterable[Point]) -> dict[str, dict[str, list[Point]]]:
    """Return the points of each codec and trace, in their order."""
    curves: dict[str, dict[str, list[Point]]] = {}
    for point in points:
        curves.setdefault(point.codec, {}).setdefault(point.trace, []).append(point)
    return curves


def _read(path: Path, kind: type[Row], prepared: Any) -> list[Row]:
    needed = [field.name for field in fields(kind) if field.default is MISSING]
    read = []
    for line, row in enumerate(_rows(path, needed), 2):
        try:
            read.append(kind(**_values(kind, prepared(row))))
        except (TypeError, ValueError) as error:
            raise PointsError(f"{path}, row {line}: {error}") from error
    return read


def _rows(path: Path, needed: Iterable[str]) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        try:
            rows = csv.DictReader(file)
            if missing := [name for name in needed if name not in (rows.fieldnames or ())]:
                raise PointsError(f"{path}: no column {', '.join(missing)}; it must have {', '.join(needed)}")
            return list(rows)
        except (csv.Error, UnicodeDecodeError) as error:
            raise PointsError(f"{path}: not a CSV file: {error}") from error


def _values(kind: type[Row], row: Mapping[str, str | None]) -> dict[str, Any]:
    """Return the fields of a row in their types; those left empty are left out, or None where they have no default."""
    values: dict[str, Any] = {}
    for field in fields(kind):
        text = row.get(field.name)
        if text or field.default is MISSING:
            values[field.name] = _value(str(field.type), text)
    return values


def _value(kind: str, text: str | None) -> Any:
    if not text and "None" in kind:
        return None
    if "str" in kind:
        return text or ""
    number = int(str(text)) if "int" in kind else float(str(text))
    if math.isnan(number):
        raise PointsError("NaN; leave the field empty where there is no value")
    return number
