"""Reads text files of numbers, CSV and TXT, and the columns, rates and units that they state."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from vibrocast.textures.axes import AXES, order_of_axes
from vibrocast.textures.memory import shortage
from vibrocast.textures.recording import INPUT_UNITS, Contents, Recording, Signal, TextureError, unusable

TIME_NAMES = ("t", "time", "timestamp")
# the first and the last: pandas' names for its index, written and read
INDEX_NAMES = ("", "index", "n", "sample", "unnamed: 0")
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
GRID_TOLERANCE = 0.25  # of a step: the most by which a time or position may miss the uniform grid
RATE_TOLERANCE = 1e-9  # rounding error of the arithmetic of times
PLAUSIBLE_RATES_HZ = (200.0, 200_000.0)  # of a texture, if a column of times states no unit

_STATEMENT = re.compile(r"[#\s]*(rate_hz|unit)\s*[:=]\s*(.*?)\s*", re.IGNORECASE)
_DECIMAL_COMMA = r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?"
_DECIMAL_COMMAS = re.compile(rf"{_DECIMAL_COMMA}(?:[;,\s]\s*{_DECIMAL_COMMA})*")
_BRACKETED = re.compile(r"(.*?)[\s_]*[(\[]\s*(.*?)\s*[)\]]")


@dataclass(frozen=True)
class Table:
    """Numbers of a text file, and the facts that it states.

    `values`: float64 (rows, columns). `names`: one for each column, in lower case, empty if the file has none.
    `own_units`: of each column by its name, spelt as in INPUT_UNITS or SECONDS, or None. `unit` and `rate_hz`: of all
    channels, from lines such as `# unit: m/s^2` and `# rate_hz: 2800`, or None.
    """

    values: Signal
    names: tuple[str, ...]
    own_units: tuple[str | None, ...]
    unit: str | None
    rate_hz: float | None

    @property
    def units(self) -> tuple[str | None, ...]:
        """The unit of each column: its own, or that of all channels."""
        common = (None if name in TIME_NAMES else self.unit for name in self.names)
        return tuple(own or unit for own, unit in zip(self.own_units, common, strict=True))


def read_table(path: Path) -> Table:
    """Read numbers in columns separated by tab, semicolon, comma or blanks, below any comments and column names.

    Numbers may be quoted, and lines may end in a separator. The reader drops lines that start with #, empty lines, and
    a column named as an index that counts the lines. Raises TextureError, also if commas may be decimal ones, OSError
    when the file cannot be read.
    """
    # A number as text takes about as many bytes as its float64.
    if lack := shortage(path.stat().st_size):
        raise TextureError(f"{path}: {lack}")
    try:
        with path.open(encoding=ENCODING) as file:
            return _read(file, path)
    except UnicodeDecodeError as error:
        raise TextureError(f"{path}: not UTF-8 text; save it as a UTF-8 CSV file") from error


def column_names(path: Path) -> list[str]:
    """Return the names of a text file's columns, in lower case, from its first line that is no comment.

    Empty where that line holds numbers. Raises TextureError for an unknown unit, and OSError.
    """
    with path.open(encoding=ENCODING, errors="replace") as file:
        while line := file.readline(MAX_LINE_CHARACTERS):
            if line.strip() and not line.lstrip().startswith("#"):
                fields = [] if _is_numeric(line.partition("#")[0]) else _column_names(line.strip(), None, 0)
                return [_name_and_unit(field.strip().strip("\"'"), path)[0] for field in fields]
    return []


def write_table(path: Path, recording: Recording) -> None:
    """Write a recording as CSV: its rate in a comment, its unit and axes in the column names. Raises OSError."""
    names = [axis.lower() for axis in recording.axes] or [
        f"channel {number + 1}" for number in range(recording.channels)
    ]
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# rate_hz: {float(recording.rate_hz)}\n")
        file.write(",".join(f"{name} ({recording.unit})" for name in names) + "\n")
        file.writelines(",".join(map(repr, row.tolist())) + "\n" for row in recording.samples)


def signal_of(table: Table, path: Path, rate_hz: float | None = None) -> Contents:
    """Return the channels of a table: every column except the time, whose steps give the rate.

    `rate_hz`: the user's rate; it decides if the times allow several. Columns x, y and z are put into this order.
    Raises TextureError if the columns contradict each other, a comment or `rate_hz`, and if a time or an index may be
    among the channels.
    """
    times = [index for index, name in enumerate(table.names) if name in TIME_NAMES]
    channels = [index for index in range(len(table.names)) if index not in times]
    if len(times) > 1:
        raise TextureError(f"{path}: {len(times)} columns of times; keep one")
    if not channels:
        raise TextureError(f"{path}: no column of a signal next to those of a time or an index; add one")
    stated_hz = table.rate_hz
    if times:
        column = _TimeColumn(path, table.names[times[0]], table.own_units[times[0]], table.values[:, times[0]])
        stated_hz = column.rate_hz(table.rate_hz, rate_hz)
    elif len(channels) > 1 and table.own_units[0] is None and _is_ramp(table.values[:, 0]):
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
    axes: tuple[str, ...] = ()
    if order := order_of_axes([table.names[index] for index in channels]):
        channels, axes = [channels[place] for place in order], AXES
    samples = table.values if channels == list(range(len(table.names))) else table.values[:, channels]
    return Contents(samples, stated_hz, unit, axes=axes)


def known_unit(text: str, place: str) -> str:
    """Return a unit as spelt in INPUT_UNITS. Raises TextureError, which names the `place`, for an unknown one."""
    unit = OTHER_SPELLINGS.get(text, text)
    if unit not in INPUT_UNITS:
        raise TextureError(f"{place}: unknown unit {text!r}; known are {', '.join(INPUT_UNITS)}", parameter="unit")
    return unit


def uniform_step(values: Signal, place: str) -> float:
    """Return the step of rising values (n,) that lie on a uniform grid, to GRID_TOLERANCE of a step.

    Otherwise raises TextureError, which names the `place`, the line and the size of the flaw.
    """
    if len(values) < 2:
        raise TextureError(f"{place}: a single line, which has no step; give two lines or more")
    if not np.isfinite(values).all():
        raise TextureError(f"{place}: line {int(np.isfinite(values).argmin()) + 1} holds no number; repair that line")
    with np.errstate(over="ignore", invalid="ignore"):
        step = float(values[-1] - values[0]) / (len(values) - 1)
        deviation = np.abs(values - (values[0] + step * np.arange(len(values))))
        if np.isfinite(step) and step > 0 and deviation.max() <= GRID_TOLERANCE * step:
            return step
        steps = np.diff(values)
    rises = (steps > 0) & np.isfinite(steps)
    if not rises.all():
        raise TextureError(f"{place}: does not rise after line {int(rises.argmin()) + 1}; sort the lines")
    usual_step, gap = float(np.median(steps)), int(steps.argmax())
    if steps[gap] > 1.5 * usual_step:
        raise TextureError(
            f"{place}: a gap of {steps[gap]:g} after line {gap + 1}, where the usual step is {usual_step:g}; fill "
            "the gap, or cut the file there"
        )
    worst = int(deviation.argmax())
    raise TextureError(
        f"{place}: jitter, line {worst + 1} is off the uniform grid by {deviation[worst]:.3g}, "
        f"{deviation[worst] / step:.0%} of a step; resample to equal steps first"
    )


@dataclass(frozen=True)
class _TimeColumn:
    """A column of times. `unit`: one of SECONDS if the name states it, else None."""

    path: Path
    name: str
    unit: str | None
    values: Signal

    def rate_hz(self, commented_hz: float | None, given_hz: float | None) -> float:
        """Return the rate in Hz from a comment or the user, if the times allow it, else that of the times.

        Raises TextureError if they contradict each other, or if the unit is neither stated nor obvious.
        """
        if self.unit is not None and self.unit not in SECONDS:
            raise TextureError(f"{self.path}: times in {self.unit}; name the column time_s, time_ms or time_us")
        rates_hz = self._rates_hz()
        slowest_hz, fastest_hz = PLAUSIBLE_RATES_HZ
        plausible = [unit for unit, (rate_hz, _) in rates_hz.items() if slowest_hz <= rate_hz <= fastest_hz]
        said = rates_hz[(plausible or list(rates_hz))[0]][0]
        for stated_hz, contradiction in (
            (commented_hz, "a comment says {:g} Hz; correct one of them"),
            (given_hz, "leave out `rate_hz`={:g}, or correct the column"),
        ):
            if stated_hz is not None and not any(
                abs(stated_hz - rate_hz) <= off_hz for rate_hz, off_hz in rates_hz.values()
            ):
                problem = f"{self.path}: the time column says {said:g} Hz"
                raise TextureError(problem, action=contradiction.format(stated_hz), parameter="rate_hz")
        if stated := commented_hz or given_hz:
            return stated
        if self.unit is None and "s" not in plausible:
            possible = ", ".join(f"{rate_hz:g} Hz in {unit}" for unit, (rate_hz, _) in rates_hz.items())
            raise unusable(
                self.path,
                f"the column {self.name!r} states no unit, and its rate may be {possible}",
                "name it time_s, time_ms or time_us (or index, if it counts the samples), or give `rate_hz`",
                "rate_hz",
            )
        return said

    def _rates_hz(self) -> dict[str, tuple[float, float]]:
        """Return the rate for each unit that the times may have, whole if they allow it, and its possible error.

        Times with few digits scatter about their grid. So may the first and the last one, which give the rate.
        """
        try:
            step = uniform_step(self.values, f"{self.path}: column of times")
        except TextureError as error:
            raise TextureError(
                str(error), action="or remove that column and give `rate_hz`", parameter="rate_hz"
            ) from error
        intervals = np.arange(len(self.values))
        scatter = float(np.ptp(self.values - step * intervals))
        rates_hz = {}
        for unit in [self.unit] if self.unit else SECONDS:
            rate_hz = 1 / step / SECONDS[unit]
            off_hz = rate_hz * (scatter / step / intervals[-1] + RATE_TOLERANCE)
            whole_hz = float(np.round(rate_hz))
            rates_hz[unit] = (whole_hz if abs(rate_hz - whole_hz) <= off_hz else rate_hz, off_hz)
        return rates_hz


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
            raise TextureError(f"{path}: holds no numbers; give a file with one sample a line")
        if len(line) == MAX_LINE_CHARACTERS or "\0" in line:
            raise TextureError(f"{path}: not a text file of numbers; write one sample a line")
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
    unit = known_unit(statements["unit"], str(path)) if "unit" in statements else None
    try:
        rate_hz = float(statements["rate_hz"]) if "rate_hz" in statements else None
    except ValueError as error:
        raise TextureError(f"{path}: rate_hz {statements['rate_hz']!r} is not a number; correct it") from error
    return Table(values, names, units, unit, rate_hz)


def _delimiter(line: str) -> str | None:
    return next((delimiter for delimiter in "\t;," if delimiter in line.strip()), None)


def _fields(line: str, delimiter: str | None) -> list[str]:
    """Split a line at the delimiter or at blanks, and remove quotes around fields."""
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
    """Return whether all remaining lines may hold numbers with decimal commas and commas between them."""
    lines = (line.partition("#")[0].strip().replace('"', "") for line in file)
    return all(_DECIMAL_COMMAS.fullmatch(line) for line in lines if line)


def _values(file: TextIO, delimiter: str | None, first_fields: list[str], path: Path) -> Signal:
    """Return the remaining lines as float64 (rows, columns); a delimiter at the end of all lines makes no column."""
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
    elif delimiter is None:  # where blanks separate columns, "x (m/s^2)" is one name
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
