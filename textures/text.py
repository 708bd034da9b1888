"""Reads text files of numbers, CSV and TXT, with what they say of columns, rates and units."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from vibrocast.textures.recording import INPUT_UNITS, Contents, Signal, TextureError

TIME_NAMES = ("t", "time", "timestamp")
INDEX_NAMES = ("", "index", "n", "sample", "unnamed: 0")  # the first and the last as pandas writes and reads its index
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
OTHER_SPELLINGS = {
    "full_scale": "full scale",
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "m/s**2": "m/s^2",
    "m_s2": "m/s^2",
    "µm": "um",  # micro sign
    "μm": "um",  # Greek mu
}
ENCODING = "utf-8-sig"
MAX_LINE_CHARACTERS = 100_000
GRID_TOLERANCE = 0.25  # of a step: how far a time or position may lie from the uniform grid
RATE_TOLERANCE = 1e-9  # what the arithmetic of times leaves uncertain

_STATEMENT = re.compile(r"[#\s]*(rate_hz|unit)\s*[:=]\s*(.*?)\s*", re.IGNORECASE)
_DECIMAL_COMMA = r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?"
_DECIMAL_COMMAS = re.compile(rf"{_DECIMAL_COMMA}(?:[;,\s]\s*{_DECIMAL_COMMA})*")
_BRACKETED = re.compile(r"(.*?)[\s_]*[(\[]\s*(.*?)\s*[)\]]")


@dataclass(frozen=True)
class Table:
    """Numbers of a text file with what the file says of them.

    `values`: float64 (rows, columns). `names`: one for each column, in lower case, empty where the file has none.
    `units`: likewise, spelt as in INPUT_UNITS or SECONDS, or None. `rate_hz`: from a line such as `# rate_hz: 2800`.
    """

    values: Signal
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    rate_hz: float | None


def read_table(path: Path) -> Table:
    """Read numbers in columns separated by tab, semicolon, comma or blanks, below any comments and column names.

    Numbers may be quoted, and lines may end in a separator. Lines that start with #, empty lines and a column that is
    named an index and counts the lines are left out.
    Raises TextureError with what to do, also where commas may be decimal ones; OSError when the file cannot be read.
    """
    try:
        with path.open(encoding=ENCODING) as file:
            return _read(file, path)
    except UnicodeDecodeError as error:
        raise TextureError(f"{path}: not UTF-8 text; save it as a UTF-8 CSV file") from error


def signal_of(table: Table, path: Path) -> Contents:
    """Return the channels of a table: every column but the time, whose steps give the rate.

    Raises TextureError where the columns contradict each other, or a time or an index may be among the channels.
    """
    times = [index for index, name in enumerate(table.names) if name in TIME_NAMES]
    channels = [index for index in range(len(table.names)) if index not in times]
    if len(times) > 1:
        raise TextureError(f"{path}: {len(times)} columns of times; keep one")
    if not channels:
        raise TextureError(f"{path}: no column of a signal beside those of a time or an index; add one")
    rate_hz, tolerance_hz = table.rate_hz, 0.0
    if times and table.units[times[0]] in SECONDS:
        seconds = SECONDS[table.units[times[0]] or ""]
        rate_hz, tolerance_hz = _rate_of_times(table.values[:, times[0]] * seconds, path)
        if table.rate_hz is not None:
            if abs(table.rate_hz - rate_hz) > tolerance_hz:
                raise TextureError(
                    f"{path}: the times say {rate_hz:g} Hz, a comment says {table.rate_hz:g}; correct one"
                )
            rate_hz, tolerance_hz = table.rate_hz, 0.0
    if not times and len(channels) > 1 and _is_ramp(table.values[:, 0]):
        raise TextureError(
            f"{path}: the first column rises in equal steps, like a time or an index; name it time_s, time_ms or "
            "index in a first line, or remove it"
        )
    units = {table.units[index] for index in channels}
    if len(units) > 1:
        raise TextureError(f"{path}: columns of different units; keep columns of one unit, each with its unit stated")
    unit = units.pop()
    if unit in SECONDS:
        raise TextureError(f"{path}: a channel in {unit}; name a column of times time_{unit}, remove any other")
    samples = table.values[:, channels] if times else table.values
    return Contents(samples, rate_hz, unit, rate_tolerance_hz=tolerance_hz)


def known_unit(text: str, place: str) -> str:
    """Return a unit as spelt in INPUT_UNITS. Raises TextureError, naming the `place`, on an unknown one."""
    unit = OTHER_SPELLINGS.get(text, text)
    if unit not in INPUT_UNITS:
        raise TextureError(f"{place}: unknown unit {text!r}; known are {', '.join(INPUT_UNITS)}")
    return unit


def uniform_step(values: Signal, place: str) -> float:
    """Return the step of rising values (n,) that lie on a uniform grid, to GRID_TOLERANCE of a step.

    Raises TextureError, naming the `place`, where they do not.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        step = float(values[-1] - values[0]) / max(len(values) - 1, 1)
        deviation = np.abs(values - (values[0] + step * np.arange(len(values))))
    if not np.isfinite(step) or step <= 0:
        raise TextureError(f"{place}: does not rise from line to line; sort the lines")
    if not deviation.max() <= GRID_TOLERANCE * step:
        raise TextureError(
            f"{place}: not uniform, line {int(deviation.argmax()) + 1} of the numbers is off by more than "
            f"{GRID_TOLERANCE:.0%} of a step; resample to equal steps first"
        )
    return step


def _rate_of_times(times_s: Signal, path: Path) -> tuple[float, float]:
    """Return the rate, a whole number if the times allow one, and how far from it they allow the rate to be, in hertz.

    Times printed with few digits scatter about their grid, and so may the first and the last, which give the rate.
    """
    try:
        step_s = uniform_step(times_s, f"{path}: column of times")
    except TextureError as error:
        raise TextureError(f"{error}, or remove that column and give --rate-hz") from error
    rate_hz = 1 / step_s
    intervals = np.arange(len(times_s))
    scatter_s = float(np.ptp(times_s - step_s * intervals))
    tolerance_hz = rate_hz * (scatter_s * rate_hz / intervals[-1] + RATE_TOLERANCE)
    whole_hz = float(np.round(rate_hz))
    return (whole_hz if abs(rate_hz - whole_hz) <= tolerance_hz else rate_hz), tolerance_hz


def _is_ramp(values: Signal) -> bool:
    try:
        return len(values) > 2 and uniform_step(values, "") > 0
    except TextureError:
        return False


def _read(file: TextIO, path: Path) -> Table:
    statements: dict[str, str] = {}
    header = ""
    while True:
        start = file.tell()
        line = file.readline(MAX_LINE_CHARACTERS)
        if not line:
            raise TextureError(f"{path}: holds no numbers")
        if len(line) == MAX_LINE_CHARACTERS or "\0" in line:
            raise TextureError(f"{path}: not a text file of numbers with one sample a line")
        if statement := _STATEMENT.fullmatch(line):
            statements[statement[1].lower()] = statement[2]
        elif line.strip() and not line.lstrip().startswith("#"):
            numbers = line.partition("#")[0]
            if _is_numeric(numbers):
                break
            if _DECIMAL_COMMAS.fullmatch(line.strip().replace('"', "")):
                raise TextureError(f"{path}: {line.strip()[:40]!r} has decimal commas; write decimal points")
            if header:
                raise TextureError(
                    f"{path}: {line.strip()[:40]!r} is not a line of numbers; write numbers with a decimal point, "
                    "commas between columns and # before comments"
                )
            header = line.strip()
    delimiter = _delimiter(numbers)
    file.seek(start)
    values = _values(file, delimiter, _fields(numbers, delimiter), path)
    fields = _column_names(header, delimiter, values.shape[1])
    if len(fields) != values.shape[1]:
        file.seek(start)
        if delimiter == "," and _may_be_decimal_commas(file):
            raise TextureError(
                f"{path}: decimal commas? write decimal points, or name each of the {values.shape[1]} columns in a "
                "first line"
            )
        if header:
            raise TextureError(
                f"{path}: {len(fields)} column names for {values.shape[1]} columns of numbers; name each column"
            )
    columns = [_name_and_unit(field.strip().strip("\"'"), path) for field in fields] or [("", None)] * values.shape[1]
    if header:
        kept = [index for index, column in enumerate(columns) if not _is_index(*column, values[:, index])]
        values, columns = values[:, kept], [columns[index] for index in kept]
    names, units = tuple(name for name, _ in columns), tuple(unit for _, unit in columns)
    if "unit" in statements:
        unit = known_unit(statements["unit"], str(path))
        units = tuple(own or unit for own in units)
    try:
        rate_hz = float(statements["rate_hz"]) if "rate_hz" in statements else None
    except ValueError as error:
        raise TextureError(f"{path}: rate_hz {statements['rate_hz']!r} is not a number; correct it") from error
    return Table(values, names, units, rate_hz)


def _delimiter(line: str) -> str | None:
    return next((delimiter for delimiter in "\t;," if delimiter in line.strip()), None)


def _fields(line: str, delimiter: str | None) -> list[str]:
    """Split a line at the delimiter or at blanks; quotes around a field are taken off."""
    if delimiter is None:
        return [field.strip('"') for field in line.split()]
    return next(csv.reader([line.strip(" \r\n")], delimiter=delimiter))


def _is_numeric(line: str) -> bool:
    fields = _fields(line, _delimiter(line))
    try:
        for field in fields if fields[-1] else fields[:-1]:
            float(field)
    except ValueError:
        return False
    return any(fields)


def _may_be_decimal_commas(file: TextIO) -> bool:
    """Return whether all lines that follow may hold numbers with decimal commas and commas between them."""
    lines = (line.partition("#")[0].strip().replace('"', "") for line in file)
    return all(_DECIMAL_COMMAS.fullmatch(line) for line in lines if line)


def _values(file: TextIO, delimiter: str | None, first_fields: list[str], path: Path) -> Signal:
    """Return the lines that follow as float64 (rows, columns); a delimiter at the end of all makes no column."""
    surplus = len(first_fields) - 1 if not first_fields[-1] else None
    try:
        values = np.loadtxt(
            file,
            delimiter=delimiter,
            quotechar='"',
            converters=None if surplus is None else {surplus: _nothing},
            ndmin=2,
            dtype=np.float64,
        )
    except UnicodeDecodeError:
        raise
    except ValueError as error:
        reason = str(error).partition(";")[0].rstrip(".")
        raise TextureError(f"{path}: {reason}, counted from the first line of numbers; repair that line") from error
    return values if surplus is None else np.delete(values, surplus, axis=1)


def _nothing(field: str) -> float:
    if field.strip():
        raise ValueError
    return 0.0


def _column_names(header: str, delimiter: str | None, count: int) -> list[str]:
    """Split a header into columns: `time_s`, `x (m/s^2)`, `height_um`, `acceleration [g]`, `force`."""
    delimiter = delimiter or _delimiter(header)
    if not header:
        return []
    if delimiter is None and count == 1:
        fields = [header]
    elif delimiter is None:  # between columns of blanks, "x (m/s^2)" is one name
        fields = re.findall(r"\S+(?:\s*[(\[][^)\]]*[)\]])?", header)
    else:
        fields = _fields(header, delimiter)
    return fields[:-1] if len(fields) == count + 1 and not fields[-1] else fields


def _is_index(name: str, unit: str | None, values: Signal) -> bool:
    return name in INDEX_NAMES and unit is None and np.array_equal(values, values[0] + np.arange(len(values)))


def _name_and_unit(field: str, path: Path) -> tuple[str, str | None]:
    if bracketed := _BRACKETED.fullmatch(field):
        name, unit = bracketed[1], bracketed[2]
        return name.lower(), unit if unit in SECONDS else known_unit(unit, f"{path}: column {field!r}")
    for unit in (*SECONDS, *INPUT_UNITS, *OTHER_SPELLINGS):
        if field.endswith(f"_{unit}"):
            return field[: -len(unit) - 1].lower(), OTHER_SPELLINGS.get(unit, unit)
    return field.lower(), None
