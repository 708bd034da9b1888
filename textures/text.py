"""Reads text files of numbers, CSV and TXT: finds their layout, and the names, units and rate that they state."""

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from vibrocast.memory import shortage
from vibrocast.textures.columns import NO_UNITS, Table, name_and_unit
from vibrocast.textures.recording import FILE_UNITS, Recording, Signal, TextureError, known_unit, spelt, unusable

ENCODING = "utf-8-sig"
MAX_LINE_CHARACTERS = 100_000
LAYOUT_LINES = 1000
"""The layout of the numbers is that of most of so many lines from the start."""
MAX_TRAILER_LINES = 20
"""So many lines of text at the end are left out."""

_STATEMENT = re.compile(r"[#\s]*(rate_hz|unit)\s*[:=]\s*(.*?)\s*", re.IGNORECASE)
_NUMBER, _TIME, _TEXT, _EMPTY = "n", "d", "t", "e"
_TIME_OF_DAY = re.compile(r"\b([01]?\d|2[0-3])(:[0-5]\d:[0-5]\d(?:[.,]\d{1,9})?)\b")
_DECIMAL_COMMA = r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?"
_BLANKS_BETWEEN = re.compile(rf"\s*(?:{_DECIMAL_COMMA}|[+-]?\d+)(?:\s+(?:{_DECIMAL_COMMA}|[+-]?\d+))+\s*")
_DECIMAL_COMMAS = re.compile(rf"{_DECIMAL_COMMA}(?:[;,\s]\s*{_DECIMAL_COMMA})*")
_QUOTED_CHARACTERS = 40
_DELIMITERS = "\t;|,"  # the first one that is in a line separates its fields


@dataclass(frozen=True)
class _Layout:
    """How the lines of numbers are laid out.

    `delimiter`: None = blanks. `kinds`: of each field, _NUMBER, _TIME for a date or a time of day, _TEXT, or _EMPTY.
    """

    delimiter: str | None
    kinds: str

    def holds(self, line: str) -> bool:
        """Return whether a line has these fields; where others have text or nothing, it may have text."""
        found = _layout_of(line, self.delimiter).kinds
        return len(found) == len(self.kinds) and all(
            own in (kind, _TEXT) or (own, kind) == (_EMPTY, _TEXT) for own, kind in zip(self.kinds, found, strict=True)
        )


@dataclass(frozen=True)
class _Head:
    """The lines above the numbers: how many, and what they state.

    `fields`: names with units, or none. `misfit`: the line above the numbers, where it names other columns, or "".
    `texts`: of each column of text, the first field that is no number, "" of others.
    """

    layout: _Layout
    lines: int
    fields: list[tuple[str, str | None]]
    misfit: str
    texts: list[str]
    statements: dict[str, str]


def read_table(path: Path, skip_lines: int = 0) -> Table:
    """Read numbers in columns separated by tab, semicolon, bar, comma or blanks.

    Above them may be lines of text: comments, names of the columns, their units. Below them, too. Numbers may be
    quoted, have a decimal comma unless commas separate them, and end in a separator. The reader drops lines that start
    with # and empty lines. `skip_lines`: so many at the start are not looked at. Raises TextureError, also if commas
    may be decimal ones, OSError when the file cannot be read.
    """
    # A number as text takes about as many bytes as its float64.
    if lack := shortage(path.stat().st_size):
        raise TextureError(f"{path}: {lack}")
    try:
        with path.open(encoding=ENCODING) as file:
            return _read(file, path, skip_lines)
    except UnicodeDecodeError as error:
        raise TextureError(
            f"{path}: no text in UTF-8; save it as a UTF-8 CSV file, or give it the suffix of its format"
        ) from error


def column_names(path: Path) -> list[str] | None:
    """Return the names of a text file's columns, in small letters; None where it holds no numbers. Raises OSError."""
    with path.open(encoding=ENCODING, errors="replace") as file:
        try:
            return [name.lower() for name, _ in _head(file, path, 0).fields]
        except TextureError:
            return None


def write_table(path: Path, recording: Recording) -> None:
    """Write a recording as CSV: its rate in a comment, its unit and axes in the column names. Raises OSError."""
    names = [axis.lower() for axis in recording.axes] or [
        f"channel {number + 1}" for number in range(recording.channels)
    ]
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# rate_hz: {float(recording.rate_hz)}\n")
        file.write(",".join(f"{name} ({recording.unit})" for name in names) + "\n")
        file.writelines(",".join(map(repr, row.tolist())) + "\n" for row in recording.samples)


def _read(file: TextIO, path: Path, skip_lines: int) -> Table:
    head = _head(file, path, skip_lines)
    layout, statements = head.layout, head.statements

    def lines() -> Iterator[str]:
        file.seek(0)
        return islice(file, head.lines, None)

    if not head.fields:
        if layout.delimiter == "," and _may_be_decimal_commas(lines()):
            raise TextureError(
                f"{path}: decimal commas? write decimal points, or name each of the {len(layout.kinds)} columns in a "
                "first line"
            )
        if head.misfit:
            raise unusable(
                path,
                f"{_quoted(head.misfit)} does not name columns of numbers, of which there are {len(layout.kinds)}",
                "name each column, or pass over that line with `skip_lines`",
                "skip_lines",
            )
    notes: tuple[str, ...] = ()
    try:
        values = _values(lines, layout)
    except UnicodeDecodeError:
        raise
    except ValueError as error:
        rows, trailer, more = _end_of_numbers(lines(), layout)
        count = layout.kinds.count(_NUMBER)
        numbers = f"{count} number{'s' * (count > 1)}"
        place = f"line {head.lines + rows + 1}, {_quoted(trailer)}"
        if not trailer or more > min(MAX_TRAILER_LINES, rows // MAX_TRAILER_LINES):
            reason = place if trailer else str(error).partition(";")[0].rstrip(".")
            raise unusable(
                path,
                f"{reason} is not {numbers} as the lines above it",
                "repair or remove that line, or pass over lines at the start with `skip_lines`",
                "skip_lines",
            ) from error
        values = _values(lambda: islice(lines(), rows), layout)
        notes = (f"{path}: left out {more} line(s) behind the samples, from {place}",)
    kept = [column for column, kind in enumerate(layout.kinds) if kind != _EMPTY]
    fields = head.fields or [("", None)] * len(layout.kinds)
    units = ["s" if layout.kinds[column] == _TIME else fields[column][1] for column in kept]
    unit = known_unit(statements["unit"], str(path), FILE_UNITS) if "unit" in statements else None
    try:
        rate_hz = float(statements["rate_hz"]) if "rate_hz" in statements else None
    except ValueError as error:
        raise TextureError(f"{path}: rate_hz {statements['rate_hz']!r} is not a number; correct it") from error
    values = values if len(kept) == len(layout.kinds) else values[:, kept]
    texts = tuple(head.texts[column] for column in kept)
    names = tuple(fields[column][0] for column in kept)
    return Table(values, names, tuple(units), unit, rate_hz, head.lines, texts, notes)


def _head(file: TextIO, path: Path, skip_lines: int) -> _Head:
    """Read the first lines of a file. Raises TextureError where they hold no numbers, or names of other columns."""
    lines: list[str] = []
    counts: Counter[_Layout] = Counter()
    while len(lines) < skip_lines + LAYOUT_LINES and (line := file.readline(MAX_LINE_CHARACTERS)):
        if len(line) == MAX_LINE_CHARACTERS or "\0" in line:
            raise TextureError(f"{path}: not a text file of numbers; write one sample a line")
        lines.append(line)
        if len(lines) > skip_lines and _data(line):
            counts[_layout_of(line)] += 1
    usual = [layout for layout in counts if _NUMBER in layout.kinds and (layout.delimiter or _TEXT not in layout.kinds)]
    layout = max(usual, key=lambda each: counts[each], default=None)
    fits = [layout is not None and place >= skip_lines and layout.holds(line) for place, line in enumerate(lines)]
    start = fits.index(True) if any(fits) else skip_lines
    said = [line for line, fit in zip(lines[start:], fits[start:], strict=True) if _data(line) and not fit]
    prose = [line for line in said if _TEXT in _layout_of(line).kinds]
    if layout is None or len(prose) >= sum(fits):  # a line of numbers in a text
        if not said:
            raise TextureError(f"{path}: holds no numbers; give a file with one sample a line")
        raise unusable(
            path,
            f"holds no numbers that can be read; {_quoted(said[-1])} is not a line of numbers",
            "write one sample a line, or pass over more than that many lines of text with `skip_lines`",
            "skip_lines",
        )
    above = [line.strip(" \r\n") for line in lines[skip_lines:start] if line.strip()]
    stated = [match for line in above if (match := _STATEMENT.fullmatch(line))]
    statements = {match[1].lower(): match[2] for match in stated}
    others = [line for line in above if not _STATEMENT.fullmatch(line)]
    fields = _named(others, layout)
    misfit = others[-1] if others and not fields and not others[-1].lstrip().startswith("#") else ""
    several = (layout.delimiter or len(layout.kinds) == 1) and len(_names(misfit, layout)) > 1
    rows = [_fields(_data(line), layout.delimiter) for line, fit in zip(lines, fits, strict=True) if fit]
    texts = [
        next((row[column] for row in rows if _kind(row[column]) == _TEXT), "") if kind == _TEXT else ""
        for column, kind in enumerate(layout.kinds)
    ]
    return _Head(layout, start, fields, misfit if several else "", texts, statements)


def _named(above: Sequence[str], layout: _Layout) -> list[tuple[str, str | None]]:
    """Return name and unit of each field, from the last lines of text that have as many fields, or none.

    A line of units may follow the names, and # may begin either.
    """
    units: list[str | None] = []
    for line in reversed(above):
        names = _names(line.lstrip("#% "), layout)
        fields = [name_and_unit(name) for name in names]
        if len(names) != len(layout.kinds) or (line.startswith("#") and len(fields) == 1 and fields[0][1] is None):
            continue  # a remark
        if not units and (found := _units(names)):
            units = found
            continue
        return [(name, own or unit) for (name, own), unit in zip(fields, units or [None] * len(fields), strict=True)]
    return [(unit or "", unit) for unit in units]


def _units(names: Sequence[str]) -> list[str | None]:
    """Return the units of a line that holds nothing else, None where a column has none; [] for other lines."""
    bare = [name.strip(" \"'") for name in names]
    inner = [text[1:-1].strip() if text[:1] + text[-1:] in ("()", "[]") else text for text in bare]
    units = [spelt(text) for text in inner]
    if not any(units) or any(
        not unit and text == bracketed and text.lower() not in NO_UNITS
        for unit, text, bracketed in zip(units, inner, bare, strict=True)
    ):
        return []
    return [unit or (None if text.lower() in NO_UNITS else text) for unit, text in zip(units, inner, strict=True)]


def _names(line: str, layout: _Layout) -> list[str]:
    """Split a line above the numbers into as many names as there are fields, if it can be."""
    count = len(layout.kinds)
    delimiter = layout.delimiter or next((each for each in _DELIMITERS if each in line), None)
    if delimiter is None and count == 1:
        names = [line]
    elif delimiter is None and '"' not in line:  # where blanks separate columns, "x (m/s^2)" is one name
        names = re.findall(r"\S+(?:\s*[(\[][^)\]]*[)\]])?", line)
    else:
        names = next(csv.reader([line], delimiter=delimiter or " ", skipinitialspace=True), [])
    if len(names) == count + 1 and not names[-1].strip():
        return names[:-1]
    return [*names, ""] if len(names) == count - 1 and layout.kinds.endswith(_EMPTY) else names


def _data(line: str) -> str:
    """Return a line without a comment, and without blanks around it."""
    return line.partition("#")[0].strip(" \r\n")


def _layout_of(line: str, delimiter: str | None = "") -> _Layout:
    """Return the layout of one line. `delimiter`: "" finds it."""
    data = _data(line)
    if delimiter == "":
        delimiter = next((each for each in _DELIMITERS if each in data.strip()), None)
        if delimiter == "," and _BLANKS_BETWEEN.fullmatch(data):
            delimiter = None
    return _Layout(delimiter, "".join(map(_kind, _fields(data, delimiter))))


def _fields(data: str, delimiter: str | None) -> list[str]:
    """Split a line at the delimiter or at blanks, and remove quotes around fields."""
    if delimiter is None:
        return [field.strip('"') for field in data.split()]
    return next(csv.reader([data], delimiter=delimiter), [])


def _kind(field: str) -> str:
    if not field.strip():
        return _EMPTY
    try:
        float(field.replace(",", "."))
    except ValueError:
        return _TEXT if _moment(field) is None else _TIME
    return _NUMBER


def _moment(field: str) -> datetime | None:
    """Return a date with a time as ISO 8601 writes them, or any time of a day; None for any other text."""
    text = field.strip()
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        time = _TIME_OF_DAY.search(text)
        if time is None:
            return None
        hour, rest = time.groups()
        moment = datetime.fromisoformat(f"1970-01-01 {int(hour):02}{rest}")
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def _seconds_of() -> Callable[[str], float]:
    """Return what turns dates and times into s since the first that it gets. It raises ValueError."""
    first: list[datetime] = []

    def seconds(field: str) -> float:
        if (moment := _moment(field)) is None:
            raise ValueError("no date or time")
        first.append(moment)
        del first[1:]
        return (moment - first[0]).total_seconds()

    return seconds


def _may_be_decimal_commas(lines: Iterable[str]) -> bool:
    """Return whether all lines may hold numbers with decimal commas and commas between them."""
    return all(_DECIMAL_COMMAS.fullmatch(data) for line in lines if (data := _data(line)))


def _values(lines: Callable[[], Iterable[str]], layout: _Layout) -> Signal:
    """Return lines of numbers as float64 (rows, columns). Raises ValueError for lines of another layout."""

    def load(texts: Iterable[str], delimiter: str | None) -> Signal:
        return np.loadtxt(
            texts,
            delimiter=delimiter,
            quotechar='"',
            converters={
                column: {_TIME: _seconds_of(), _TEXT: lambda _: float("nan"), _EMPTY: _nothing}[kind]
                for column, kind in enumerate(layout.kinds)
                if kind != _NUMBER
            }
            or None,
            ndmin=2,
            dtype=np.float64,
            encoding=None,
        )

    try:
        return load(lines(), layout.delimiter)
    except UnicodeDecodeError:
        raise
    except ValueError:
        if not any("," in line for line in islice(lines(), LAYOUT_LINES)):
            raise
    parted = (_fields(data, layout.delimiter) for line in lines() if (data := _data(line)))
    return load(("\t".join(fields).replace(",", ".") for fields in parted), "\t")


def _nothing(field: str) -> float:
    if _kind(field) not in (_EMPTY, _TEXT):
        raise ValueError("no number belongs here")
    return 0.0


def _end_of_numbers(lines: Iterable[str], layout: _Layout) -> tuple[int, str, int]:
    """Return how many lines are above the first that does not fit, this line, and how many come from there.

    "" where all fit. Many, where one of those that come fits again.
    """
    rows = more = 0
    trailer = ""
    for line in lines:
        fits = not _data(line) or layout.holds(line)
        if trailer and _data(line):
            more = more + 1 if not fits else MAX_TRAILER_LINES + 1
        elif not fits:
            trailer, more = line, 1
        if not trailer:
            rows += 1
        if more > MAX_TRAILER_LINES:
            break
    return rows, trailer, more


def _quoted(line: str) -> str:
    text = line.strip()
    return repr(text if len(text) <= _QUOTED_CHARACTERS else text[:_QUOTED_CHARACTERS] + "...")
