"""Rate-distortion points, of this project's codecs and of its peers, and the CSV files that hold them."""

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path


class PointsError(ValueError):
    """A file of rate-distortion points that cannot be used; the message says why."""


@dataclass(frozen=True)
class Point:
    """One trace, coded by one codec at one setting: its samples, all channels together, all bytes, and the SNR."""

    trace: str
    codec: str
    setting: str
    samples: int
    bytes_total: int
    snr_db: float

    @property
    def bits_per_sample(self) -> float:
        """Bits for each sample, of all bytes that a receiver needs."""
        return 8 * self.bytes_total / self.samples


COLUMNS = tuple(field.name for field in fields(Point))


def read_points(path: Path) -> list[Point]:
    """Read a CSV file with at least the COLUMNS. Raises PointsError where it is not one, OSError where it cannot be."""
    with path.open(newline="", encoding="utf-8") as file:
        try:
            rows = csv.DictReader(file)
            if missing := [name for name in COLUMNS if name not in (rows.fieldnames or ())]:
                raise PointsError(f"{path}: no column {', '.join(missing)}; it must have {', '.join(COLUMNS)}")
            return [_point_of(row, f"{path}, line {rows.line_num}") for row in rows]
        except (csv.Error, UnicodeDecodeError) as error:
            raise PointsError(f"{path}: not a CSV file: {error}") from error


def write_points(path: Path, points: Iterable[Point]) -> None:
    """Write points as CSV: the COLUMNS and bits_per_sample. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow([*COLUMNS, "bits_per_sample"])
        rows.writerows([*asdict(point).values(), round(point.bits_per_sample, 4)] for point in points)


def by_codec_and_trace(points: Iterable[Point]) -> dict[str, dict[str, list[Point]]]:
    """Return the points of each codec and trace, in their order."""
    curves: dict[str, dict[str, list[Point]]] = {}
    for point in points:
        curves.setdefault(point.codec, {}).setdefault(point.trace, []).append(point)
    return curves


def _point_of(row: dict[str, str], place: str) -> Point:
    try:
        point = Point(
            row["trace"],
            row["codec"],
            row["setting"],
            int(row["samples"]),
            int(row["bytes_total"]),
            float(row["snr_db"]),
        )
    except (TypeError, ValueError) as error:
        raise PointsError(f"{place}: {error}") from error
    if point.samples <= 0 or point.bytes_total <= 0:
        raise PointsError(f"{place}: samples and bytes must be positive")
    return point
