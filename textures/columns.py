"""The columns of a table: which of them are times, which are axes, and which are the channels of a texture."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.textures.axes import AXES, are_axes
from vibrocast.textures.recording import (
    FILE_UNITS,
    SECONDS,
    Contents,
    Signal,
    TextureError,
    known_unit,
    spelt,
    unusable,
)
from vibrocast.textures.times import TimeColumn, is_uniform, rate_of

# The first and the last: pandas' names for its index, written and read.
INDEX_NAMES = ("", "index", "idx", "n", "i", "no", "nr", "sample", "samples", "sample number", "row", "unnamed 0")
NO_UNITS = ("", "-", "1", "count", "counts", "lsb", "raw", "a.u.", "none", "n/a")
"""What stands in place of the unit of a column that has none."""
RISING_LINES = 16
"""A column without a name that rises over so many lines is no vibration, but a time or a count."""

_TIME = re.compile(r"time|stamp|elapsed|epoch|clock|uptime|\b(?:t|ts|tow|dt|delta t|date|utc|millis|micros|nanos)\b")
_SENSOR = r"accelerometer|accelero|acceleration|accel|acc|a|linear|lin|user|raw|axis|vibration|vib|displacement|disp"
_WORD = rf"{_SENSOR}|position|pos|sensor|imu|device|dev|body|calibrated|cal|filtered|data|value|channel|ch|\d+|[ .]"
_AXIS = re.compile(rf"((?:{_WORD})*)([xyz])((?:{_WORD})*)")
_ANY_AXIS = re.compile(rf"{_AXIS.pattern}|(.*)\b([xyz])\b(.*)")
_MAGNITUDE = re.compile(r"(?!.*\b[xyz]\b).*\b(?:absolute|abs|magnitude|mag|norm|total|resultant|vector sum)\b.*")
_BRACKETED = re.compile(r"(.*?)[\s_]*[(\[]\s*(.*?)\s*[)\]]")
_PER_SECOND = re.compile(r"(.+?)[_ ]([munkc]?m|rad|deg|degrees?|radians?|rev)[_ ]s", re.IGNORECASE)
"""Names of speeds, which end like times: `gyro_x_rad_s`."""
_CHANNEL = re.compile(r"(?:channel|ch|actuator|motor|sensor|left|right)[ \d]*[a-d]?(?: ?raw)?")


@dataclass(frozen=True)
class Table:
    """Numbers in columns, and the facts that a file states of them.

    `values`: float64 (rows, columns), NaN in a column of text. `names`: one for each column, "" without. `own_units`:
    the unit that each column states itself, as in SPELLINGS where it is known, or None. `unit` and `rate_hz`: of all
    channels, from lines such as `# unit: m/s^2` and `# rate_hz: 2800`, or None. `lines`: how many lines of the file are
    above the first row. `texts`: the first field of each column of text, "" of others, or none. `notes`: as in
    Recording.
    """

    values: Signal
    names: tuple[str, ...]
    own_units: tuple[str | None, ...]
    unit: str | None = None
    rate_hz: float | None = None
    lines: int = 0
    texts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """The names in small letters, their words apart: `AccelX` is "accel x"."""
        return tuple(_words(name) for name in self.names)

    @property
    def units(self) -> tuple[str | None, ...]:
        """The unit of each column: its own, or that of all channels."""
        times = self.times
        common = (None if column in times else self.unit for column in range(len(self.names)))
        return tuple(own or unit for own, unit in zip(self.own_units, common, strict=True))

    @property
    def times(self) -> list[int]:
        """The columns that hold times or durations, by name or unit."""
        return [
            column
            for column, (words, unit) in enumerate(zip(self.words, self.own_units, strict=True))
            if unit in SECONDS or is_time(words)
        ]

    @property
    def axes(self) -> dict[int, tuple[str, str]]:
        """The axis and the sensor of each column whose name states an axis, in any language if it states its unit."""
        forms = [_ANY_AXIS if unit in FILE_UNITS else _AXIS for unit in self.own_units]
        found = enumerate(_axis(name, form) for name, form in zip(self.names, forms, strict=True))
        return {column: axis for column, axis in found if axis[0]}

    @property
    def counts(self) -> list[int]:
        """The columns named as an index that count the lines."""
        return [
            column
            for column, (words, unit) in enumerate(zip(self.words, self.own_units, strict=True))
            if any(self.names) and words in INDEX_NAMES and unit is None and _counts_lines(self.values[:, column])
        ]

    def listed(self) -> str:
        """Return numbers and names of the columns, for people."""
        return ", ".join(f"{number} {name!r}" if name else str(number) for number, name in enumerate(self.names, 1))


def signal_of(
    table: Table, path: Path, rate_hz: float | None = None, columns: Sequence[str] | None = None, resample: bool = False
) -> Contents:
    """Return the channels of a table, and the rate that its times give.

    `columns`: names or numbers, from 1, of the channels. None takes the only column besides times and counts, or the
    axes in the order X, Y, Z, or else all columns that state a unit. `rate_hz`: the user's rate, which
    decides if the times allow several. `resample`: interpolates uneven times and short gaps.

    Raises TextureError for a column that may be none of these, for columns that contradict each other, a comment or
    `rate_hz`, and for times that are no uniform grid.
    """
    if columns is None:
        channels = _channels(table, path)
    else:
        table = replace(table, names=_or_axes(table.names))
        channels = [_chosen(name, table, path) for name in columns]
    if text := [column for column in channels if np.isnan(table.values[:, column]).all()]:
        example = f": {table.texts[text[0]]!r} is none" if table.texts else ""
        raise unusable(
            path,
            f"column {table.names[text[0]] or text[0] + 1!r} holds no numbers{example}",
            "choose others with `columns`, or write plain numbers, such as 1234.5",
            "columns",
        )
    units = {table.units[column] for column in channels}
    if len(units) > 1:
        named = ", ".join(f"{table.names[column]!r} in {table.units[column] or 'no unit'}" for column in channels)
        raise unusable(path, f"columns of different units: {named}", "choose some with `columns`", "columns")
    unit = units.pop()
    if unit is not None:
        unit = known_unit(unit, f"{path}: column {table.names[channels[0]]!r}", FILE_UNITS)
    if table.unit not in (None, unit):
        raise TextureError(f"{path}: a comment says {table.unit}, and the columns {unit}; correct one of them")
    axes = AXES if are_axes([table.words[column] for column in channels]) else ()
    samples = table.values if channels == list(range(len(table.names))) else table.values[:, channels]
    stated_hz, notes = table.rate_hz, table.notes
    times = [
        TimeColumn(table.names[column], table.own_units[column], table.values[:, column], table.lines)
        for column in table.times
        if column not in channels and not _is_constant(table.values[:, column])
    ]
    if times:
        stated_hz, samples, more = rate_of(times, samples, path, table.rate_hz, rate_hz, resample)
        notes += more
    names = tuple(table.names[column] for column in channels)
    return Contents(samples, stated_hz, unit, axes=axes, names=names, notes=notes)


def select(contents: Contents, columns: Sequence[str], path: Path) -> Contents:
    """Return the chosen channels of a file without column names. `columns`: numbers from 1; of three, also x, y, z.

    Raises TextureError.
    """
    count = contents.samples.shape[1]
    names = contents.names or _or_axes(("",) * count)
    chosen = [_chosen(name, Table(contents.samples, names, (None,) * count), path) for name in columns]
    axes = AXES if tuple(names[column].upper() for column in chosen) == AXES else ()
    return Contents(
        contents.samples[:, chosen],
        contents.rate_hz,
        contents.unit,
        contents.full_scale,
        axes,
        tuple(names[column] for column in chosen),
        contents.notes,
    )


def _channels(table: Table, path: Path) -> list[int]:
    """Return the columns of the signal. Raises TextureError where they are not certain."""
    skipped = {*table.times, *table.counts}
    rest = [column for column in range(len(table.names)) if column not in skipped]
    if not rest:
        raise TextureError(f"{path}: no column of a signal next to those of a time or an index; add one")
    _reject_rising(table, rest, path)
    if len(rest) == 1 or not any(table.names):
        return rest
    axes = {column: axis for column, axis in table.axes.items() if column in rest}
    others = [column for column in rest if column not in axes and not _MAGNITUDE.fullmatch(table.words[column])]
    letters = {letter for letter, _ in axes.values()}
    if axes and not others and len({sensor for _, sensor in axes.values()}) == 1 and len(letters) == len(axes):
        return sorted(axes, key=lambda column: axes[column])
    if len(letters) < len(AXES) and all(_is_channel(table, column) for column in rest):
        return rest
    unknown = [column for column in others if not _is_channel(table, column)] or others or list(axes)
    named = ", ".join(repr(table.names[column]) for column in unknown)
    raise unusable(
        path,
        f"nothing says whether {named} {'is' if len(unknown) == 1 else 'are'} to be played",
        f"choose columns by name or number with `columns`; there are {table.listed()}",
        "columns",
    )


def table_of_frame(frame: Any) -> Table:
    """Return a DataFrame of pandas or Polars as a table, with its index where this holds times."""
    columns = {str(name): np.asarray(frame[name]) for name in frame.columns}
    index = np.asarray(getattr(frame, "index", ()))
    if index.dtype.kind in "mM":
        columns = {"time": index, **columns}
    fields = [name_and_unit(name) for name in columns]
    named = any(isinstance(name, str) for name in frame.columns)
    values = np.column_stack([_numbers(each) for each in columns.values()]) if columns else np.zeros((0, 0))
    units = ["s" if each.dtype.kind in "mM" else unit for each, (_, unit) in zip(columns.values(), fields, strict=True)]
    return Table(values, tuple(name if named else "" for name, _ in fields), tuple(units))


def _numbers(values: NDArray[Any]) -> Signal:
    """Return a column as float64, moments in s since the first; NaN for text."""
    if values.dtype.kind in "mM":
        return np.asarray((values - values[:1]) / np.timedelta64(1, "s"), np.float64)
    return values.astype(np.float64) if values.dtype.kind in "iuf" else np.full(len(values), np.nan)


def _chosen(name: str, table: Table, path: Path) -> int:
    """Return the column of a name, of an axis, or of a number from 1. Raises TextureError."""
    wanted = {_words(name), _words(name_and_unit(name)[0])}
    found = [column for column, words in enumerate(table.words) if words and words in wanted]
    if not found and name:
        found = [column for column, (letter, _) in table.axes.items() if letter == name.lower()]
    if not found and name.isdecimal() and 1 <= int(name) <= len(table.names):
        found = [int(name) - 1]
    if len(found) != 1:
        problem = f"several columns are {name!r}" if found else f"no column is {name!r}"
        raise unusable(path, problem, f"choose with `columns` among {table.listed()}", "columns")
    return found[0]


def _or_axes(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return names, or those of the axes for three columns without."""
    return names if any(names) or len(names) != len(AXES) else tuple(axis.lower() for axis in AXES)


def _is_channel(table: Table, column: int) -> bool:
    """Return whether a column states by its own unit or its name that it is a channel of a texture."""
    return table.own_units[column] in FILE_UNITS or bool(_CHANNEL.fullmatch(table.words[column]))


def is_time(name: str) -> bool:
    """Return whether a name is that of a time or a duration."""
    return bool(_TIME.search(_words(name)))


def axis_of(name: str) -> str:
    """Return the axis of acceleration or displacement that a name states, a small letter; "" for any other name."""
    return _axis(name)[0]


def _axis(name: str, forms: re.Pattern[str] = _AXIS) -> tuple[str, str]:
    """Return the axis that a name states in one of the forms, and the rest of the name, which is that of the sensor."""
    match = forms.fullmatch(_words(name))
    before, axis, after = [part for part in match.groups() if part is not None] if match else ["", "", ""]
    return axis, before + after


def _words(name: str) -> str:
    """Return a name in small letters with single blanks between its words: `AccelX`, `accel_x` -> "accel x"."""
    return " ".join(re.findall(r"[^\W_]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name))).lower()


def name_and_unit(field: str) -> tuple[str, str | None]:
    """Return the name and the unit of a column: `time_s`, `x (m/s^2)`, `acceleration [g]`, `seconds_elapsed`, `ms`.

    The unit is as in SPELLINGS where it is known there, else as in the field, or None.
    """
    field = field.strip().strip("\"'").strip()
    if bracketed := _BRACKETED.fullmatch(field):
        unit = None if bracketed[2].lower() in NO_UNITS else bracketed[2]
        return bracketed[1], unit and (spelt(unit) or unit)
    if unit := spelt(field):
        return field, unit
    if speed := _PER_SECOND.fullmatch(field):
        return speed[1], f"{speed[2]}/s"
    for start in re.finditer(r"[_ ]", field):
        if start.start() and (unit := spelt(field[start.end() :])):
            return field[: start.start()], unit
    in_words = {unit for word in _words(field).split() if len(word) > 1 and (unit := spelt(word)) in SECONDS}
    return field, in_words.pop() if len(in_words) == 1 else None


def _is_constant(values: Signal) -> bool:
    """Return whether a column of times says nothing: text, or the same step in several lines."""
    return bool(np.isnan(values).all() or (len(values) > 1 and np.all(values == values[0])))


def _counts_lines(values: Signal) -> bool:
    return bool(np.array_equal(values, values[0] + np.arange(len(values))))


def _reject_rising(table: Table, columns: Sequence[int], path: Path) -> None:
    """Raise TextureError where one of several columns without a stated unit rises, as a time or a count does."""
    for column in columns if len(columns) > 1 else ():
        values = table.values[:, column]
        steps = np.diff(values)
        rises = bool(np.all(steps > 0)) and len(values) >= RISING_LINES
        even = not table.names[column] and len(steps) > 1 and is_uniform(values, float(np.mean(steps)))
        if table.own_units[column] is None and (rises or even) and table.words[column] in INDEX_NAMES[1:]:
            gap = int(np.argmax(steps != np.median(steps)))
            raise unusable(
                path,
                f"column {table.names[column]!r} counts the samples, and goes from {values[gap]:g} to "
                f"{values[gap + 1]:g}: samples are missing",
                "choose the other columns with `columns` to take the samples as they are",
                "columns",
            )
        if table.own_units[column] is None and (rises or even):
            raise unusable(
                path,
                f"column {column + 1} rises like a time or an index",
                "name it time_s, time_ms or index in a first line, or choose other columns with `columns`",
                "columns",
            )
