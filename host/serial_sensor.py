"""Serial accelerometers: reads lines of text (docs/reference/serial_sensors.md)."""

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from vibrocast.device_protocol.transports import BAUD, Closing, SerialTransport, Transport, TransportError
from vibrocast.files import plain
from vibrocast.progress import notes
from vibrocast.textures import INPUT_UNITS, TextureError, sidecar
from vibrocast.textures.columns import axis_of, is_time, name_and_unit
from vibrocast.textures.recording import SECONDS, Signal, known_unit, spelt
from vibrocast.textures.sensitivity import Sensitivity
from vibrocast.textures.times import CLOCK_TOLERANCE, GAP_STEPS, MAX_FILLED_S, interpolated

MAX_LINE_BYTES = 200
MAX_CHANNELS = 3
MAX_RATE_HZ = 100_000

_SILENT_S = 5.0  # opening the port restarts some boards, which then need seconds
_UNKNOWN_BYTES = 1 << 16  # of which nothing was understood
_STATED_WITHIN_S = 2.0  # a sensor of text should repeat its comment every second
_LINES = 8  # of one form make it text
_MEASURED_S = 1.0  # by this computer's clock, or by the times
_MEASURED_LINES = 32
_MAX_MEASURED_LINES = 20_000
_MAX_NUMBERS = 16  # in a line
_SHOWN_LINES, _SHOWN_CHARACTERS = 3, 60
_RETRY_S = 0.2
_MAX_BAD_LINES = 200  # in a row
_LEAST_BURSTS = 3
_WRAP = 1 << 32  # of micros() and millis() on a board
_US = {unit: 1e6 * seconds for unit, seconds in SECONDS.items()}
_COUNT_TOLERANCE = 0.05  # a count of samples that steps by 1 is no time in ms unless 1000 a second come
_COARSE = 0.1  # times of fewer digits, in periods, are smoothed
_BURST = 0.5  # lines come in bursts if most steps are shorter than this part of the mean
_ARRIVAL_TOLERANCE = 0.25  # of the lines that come in a second, by this computer's clock
_SMOOTHING = 1 / 16
_MAX_PLACES = 100
_MAX_VALUE = 1e9

_NUMBER = re.compile(r"(?<![\w.^/])[+-]?(?:\d{1,20}\.?\d{0,20}|\.\d{1,20})(?:[eE][+-]?\d{1,2})?(?=[^\d.]|$)(?!\.)")
_BRACKETS = str.maketrans(dict.fromkeys("(){}[]\"'", " "))
_FACT = re.compile(r"(\w+)\s*=\s*(\S+)")


@dataclass(frozen=True)
class Description:
    """The facts that a sensor states of its samples; None = not stated.

    Attributes:
        rate_hz: Samples per second, a whole number.
        unit: One of INPUT_UNITS.
        counts_per_unit: The number that it sends for one `unit`.
        full_scale: The highest value that it can measure, in `unit`.
        axes: One small letter of x, y and z for each channel.
    """

    rate_hz: int | None = None
    unit: str | None = None
    counts_per_unit: float | None = None
    full_scale: float | None = None
    axes: str | None = None

    def with_facts(self, text: str) -> "Description":
        """Return this description with those of a text such as `rate_hz=3200 unit=g axes=xyz`.

        Words without a known name are comments. Raises TransportError for wrong values, and for changed ones.
        """
        given: dict[str, int | float | str] = {}
        known = [each.name for each in fields(self)]
        for name, value in _FACT.findall(text):
            if name in known:
                given[name] = _fact(name, value)
        for name, fact in given.items():
            if getattr(self, name) not in (None, fact):
                raise TransportError(
                    f"the sensor states {name}={getattr(self, name)}, and then {name}={fact}; correct its program"
                )
        return replace(self, **given)  # type: ignore[arg-type]


def _fact(name: str, text: str) -> int | float | str:
    try:
        if name == "unit":
            unit = known_unit(text, "unit")
            if INPUT_UNITS[unit][0] == "full scale":
                raise ValueError
            return unit
        if name == "axes":
            if not sidecar.is_axes("".join(sorted(text))):
                raise ValueError
            return text.lower()
        number = float(text)
        if name == "rate_hz" and (number != int(number) or number > MAX_RATE_HZ):
            raise ValueError
        if not 1 / _MAX_VALUE < number < _MAX_VALUE:
            raise ValueError
    except (ValueError, OverflowError):
        raise TransportError(
            f"the sensor states {name}={plain(text[:40])}, which cannot be; correct its program"
        ) from None
    return int(number) if name == "rate_hz" else number


@dataclass
class Losses:
    """Lost samples of a recording. `places`: start in s and number of samples, None = unknown; only the first ones."""

    gaps: int = 0
    samples: int = 0
    places: list[tuple[float, int | None]] = field(default_factory=list)

    def add(self, at_s: float, samples: int | None) -> None:
        """Note a gap."""
        self.gaps += 1
        self.samples += samples or 0
        if len(self.places) < _MAX_PLACES:
            self.places.append((round(at_s, 4), samples))


class Form(NamedTuple):
    """The name and the unit of each number in a line; "" = none."""

    names: tuple[str, ...]
    units: tuple[str, ...]


def read_line(text: str) -> tuple[Form, tuple[float, ...]] | None:
    """Return the form of a line and its numbers, None where a field holds no number or two.

    Numbers stand between commas, semicolons, tabs, blanks, brackets or quotes. A name may stand before a number, and a
    unit behind it: `12,0.1,0.2`, `x:0.1 y:0.2`, `X: 0.04  Y: 0.12  m/s^2`.
    """
    between, values, end = [], [], 0
    text = text.translate(_BRACKETS)
    if "." not in text and all(field.count(",") < 2 for field in re.split(r"[;\t]", text)[1:]):
        text = text.replace(",", ".")
    for match in _NUMBER.finditer(text):
        between.append(text[end : match.start()])
        values.append(float(match[0]))
        end = match.end()
    between.append(text[end:])
    if not 0 < len(values) <= _MAX_NUMBERS or re.search(r"\b(nan|inf)\b", text, re.IGNORECASE):
        return None
    names, units = [], []
    for place, each in enumerate(between):
        parts = [part.strip(" :=") for part in re.split(r" *[,;|] *|\t+", each)]
        if len(parts) == 1 and place:
            first, _, rest = parts[0].partition(" ")
            parts = [first, rest.strip(" :=")] if spelt(first) else ["", *parts]
        unit, name = parts if place and len(parts) == 2 else ("", "".join(parts))
        if len(parts) > 2 or not all(re.fullmatch(r"(?:[^\W\d]|[%°]).*|", part) for part in parts):
            return None
        units.append(unit or name if place == len(values) else unit)
        names.append(name)
    return Form(tuple(names[:-1]), tuple(units[1:])), tuple(values)


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a line belong.

    `time`: the column of the time, None = there is none, and `us`: one of its counts in us. `columns`: of the channels,
    with their `axes` as far as they are named, and their `unit`. `left_out`: names of the other columns.
    """

    form: Form
    time: int | None
    us: float
    columns: tuple[int, ...]
    axes: str
    unit: str | None
    left_out: tuple[str, ...]

    def sample(self, values: tuple[float, ...]) -> tuple[float, tuple[float, ...]]:
        """Return the time in us, NaN without one, and the values of the channels."""
        time_us = math.nan if self.time is None else values[self.time] * self.us
        return time_us, tuple(values[column] for column in self.columns)


class Lines:
    """Finds samples in lines of text; holds at most one line, whatever arrives.

    `settle` chooses the form of line whose numbers are samples; before that, rows are gathered. `shown`: the first
    lines. `bad`: lines that were neither samples nor comments, without the first line. `bad_in_a_row`: how many of
    these have come since the last sample. `channels`: of a sample.
    """

    def __init__(self) -> None:
        self.description = Description()
        self.shown: list[str] = []
        self.layout: Layout | None = None
        self.bad = self.bad_in_a_row = 0
        self.channels = 0
        self._rows: dict[Form, list[tuple[float, ...]]] = {}
        self._arrivals_s: dict[Form, list[float]] = {}
        self._headers: dict[int, tuple[str, ...]] = {}
        self._pending = bytearray()
        self._whole = False  # the first line may have begun before the port was open

    @property
    def gathered(self) -> int:
        """How many rows of one form there are, 0 while they are too few to be text."""
        most = max(map(len, self._rows.values()), default=0)
        return most if most >= _LINES else 0

    def begin_again(self) -> None:
        """Forget the line that came in part: the port was opened again."""
        self._pending.clear()
        self._whole = False

    def feed(self, data: bytes, now_s: float = 0.0) -> list[tuple[float, tuple[float, ...]]]:
        """Take bytes that arrived at a time; return the times in us and values of the lines that they complete.

        None before `settle`. Raises TransportError for a comment that states wrong facts.
        """
        samples = []
        *closed, rest = data.split(b"\n")
        for piece in closed:
            self._keep(piece)
            line, whole = bytes(self._pending), self._whole
            self._pending.clear()
            self._whole = True
            if (whole or line.startswith(b"#")) and (sample := self._sample(line, now_s)):
                samples.append(sample)
        self._keep(rest)
        return samples

    def _keep(self, piece: bytes) -> None:
        # Keep one byte more than the longest line, as a mark that the line is too long.
        self._pending += piece[: MAX_LINE_BYTES + 1 - len(self._pending)]

    def _sample(self, line: bytes, now_s: float) -> tuple[float, tuple[float, ...]] | None:
        text = line.decode("utf-8", "replace").strip()
        if not text:
            return None
        if len(self.shown) < _SHOWN_LINES:
            self.shown.append(text[:_SHOWN_CHARACTERS])
        if text.startswith("#") and len(line) <= MAX_LINE_BYTES:
            self.description = self.description.with_facts(text)
            return None
        row = read_line(text) if len(line) <= MAX_LINE_BYTES else None
        if row is not None and self.layout is None:
            form, values = row
            self._rows.setdefault(form, []).append(values)
            self._arrivals_s.setdefault(form, []).append(now_s)
            return None
        if row is not None and self.layout is not None and row[0] == self.layout.form:
            sample = self.layout.sample(row[1])
            if max(map(abs, sample[1])) <= _MAX_VALUE:
                self.bad_in_a_row = 0
                return sample
        elif row is not None and len(self._rows.get(row[0], ())) >= _LINES:
            return None  # of another measurement
        elif self.layout is None and len(line) <= MAX_LINE_BYTES:
            names = tuple(re.split(r"\s*[,;\t]\s*|\s+", text))
            if any(axis_of(name) for name in names):
                self._headers[len(names)] = names
        self.bad += 1
        self.bad_in_a_row += 1
        return None

    def settle(self, name: str) -> list[tuple[float, tuple[float, ...]]]:
        """Choose the form of the samples, and return those so far. `name`: of the sensor.

        Raises TransportError where no form, or more than one, holds an acceleration or a displacement.
        """
        layouts = [self._layout(form) for form, rows in self._rows.items() if len(rows) >= _LINES]
        most = max(len(layout.axes) for layout in layouts)
        chosen = [layout for layout in layouts if len(layout.axes) == most]
        chosen = [layout for layout in chosen if layout.unit] or chosen
        chosen = [layout for layout in chosen if 0 < len(layout.columns) <= MAX_CHANNELS]
        if len(chosen) != 1:
            problem = "sends several kinds of lines" if chosen else "sends lines in which no axis is known"
            raise TransportError(
                f"{name} {problem}: {self.told()}; let it send a time and up to {MAX_CHANNELS} numbers in each line, "
                "or name them: x:0.1,y:0.2,z:0.9"
            )
        self.layout = layout = chosen[0]
        self.channels = len(layout.columns)
        if layout.unit is not None and self.description.unit is None:
            self.description = replace(self.description, unit=layout.unit)
        return [layout.sample(values) for values in self._rows[layout.form]]

    @property
    def settled(self) -> Layout:
        """The layout that `settle` chose."""
        assert self.layout is not None, "settled"
        return self.layout

    def told(self) -> str:
        """Return the first lines, for people."""
        return ", ".join(f"'{plain(line)}'" for line in self.shown) or "no line"

    def per_second(self) -> float:
        """Return how many of the lines with samples came in a second; infinite where they came at once."""
        arrivals_s = self._arrivals_s[self.settled.form]
        elapsed_s = arrivals_s[-1] - arrivals_s[0]
        return sum(each > arrivals_s[0] for each in arrivals_s) / elapsed_s if elapsed_s else math.inf

    def _layout(self, form: Form) -> Layout:
        """Return where the numbers of lines of a form belong."""
        count = len(form.names)
        own = [
            name_and_unit(name) for name in (form.names if any(form.names) else self._headers.get(count, form.names))
        ]
        names = [name for name, _ in own]
        units = [spelt(unit or "") or stated for unit, (_, stated) in zip(form.units, own, strict=True)]
        time, us = self._time(form, names, units)
        others = [column for column in range(count) if column != time]
        axes = {column: axis for column in others if (axis := axis_of(names[column]))}
        if len(set(axes.values())) < len(axes):
            axes = {}
        columns = sorted(axes, key=axes.__getitem__) if axes else [] if any(names) and len(others) > 1 else others
        found = {unit for column in columns if (unit := units[column]) in INPUT_UNITS}
        if units[-1] in INPUT_UNITS:
            found.add(units[-1])
        left_out = tuple(names[column] or f"column {column + 1}" for column in others if column not in columns)
        unit = found.pop() if len(found) == 1 else None
        return Layout(
            form,
            time if us else None,
            us,
            tuple(columns),
            "".join(axes[each] for each in axes and columns),
            unit,
            left_out,
        )

    def _time(self, form: Form, names: list[str], units: list[str | None]) -> tuple[int | None, float]:
        """Return the column of the time, and one of its counts in us; None where there is none, 0 if it counts lines.

        Without a name, it is the first column if that rises. Without a unit, this computer's clock tells it.
        """
        rows, count = np.array(self._rows[form]), len(names)
        axes = len(self.description.axes or "")
        named = [column for column in range(count) if is_time(names[column]) or units[column] in _US]
        if len(named) > 1 or (named and count == 1):
            named = named[:1] if count > 1 else []
        time = named[0] if named else 0 if count > 1 and not names[0] else None
        if time is None or (not named and axes == count):
            return None, 0.0
        steps = np.diff(rows[:, time])
        if not named and axes != count - 1 and (steps < 0).any() | (not steps.any()):
            return None, 0.0
        if units[time] in _US:
            return time, _US[units[time] or ""]
        elapsed_us = 1e6 * (self._arrivals_s[form][-1] - self._arrivals_s[form][0])
        counts = rows[-1, time] - rows[0, time]
        if not (elapsed_us > 0 and counts > 0):
            return time, 1.0
        us = min(_US.values(), key=lambda each: abs(math.log(each * counts / elapsed_us)))
        is_count = bool((steps == 1).all()) and us == _US["ms"] and abs(us * counts / elapsed_us - 1) > _COUNT_TOLERANCE
        return time, 0.0 if is_count else us


class Clock:
    """Turns the times of lines into those of a clock that rises evenly, in us.

    True times stay as they are, except that boards begin again at 2^32. Times that are whole ms, or those at which a
    sensor's memory was read in bursts, are smoothed by a critically damped phase-locked loop of the second order (F. M.
    Gardner, Phaselock Techniques, 2005, chapter 2). It follows the first line behind each long step. Lines without a
    time are a period apart.

    Attributes:
        period_us: From one sample to the next.
        kind: In words, for people.
    """

    def __init__(self, times_us: Sequence[float], us: float, name: str, rate_hz: int | None) -> None:
        """`times_us`: the first ones, NaN = none. `us`: of one count.

        Raises TransportError for times that do not rise.
        """
        self._wrap_us = _WRAP * us
        self.begin_again()
        if math.isnan(times_us[0]):
            assert rate_hz is not None, "asked for"
            self.period_us, self.kind, self._begins_us = 1e6 / rate_hz, "no time, taken as evenly spaced", math.inf
            return
        steps_us = np.diff(times_us)
        steps_us[steps_us < -self._wrap_us / 2] += self._wrap_us
        mean_us, median_us = float(np.mean(steps_us)), float(np.median(steps_us))
        if mean_us < 1e6 / MAX_RATE_HZ:
            raise TransportError(f"{name}: its times do not rise; correct its program")
        in_bursts = median_us < _BURST * mean_us
        self.kind = f"time in {next(unit for unit, each in _US.items() if each == us)}"
        self._begins_us = 0.0
        if not in_bursts and _resolution(np.asarray(times_us) / us) * us <= _COARSE * mean_us:
            self.period_us = float(np.mean(steps_us[(steps_us > 0) & (steps_us <= GAP_STEPS * median_us)]))
            return
        self.kind += (" in bursts" if in_bursts else " of few digits") + ", taken as evenly spaced"
        self._begins_us = 0.99 * mean_us
        rows = np.flatnonzero(steps_us >= self._begins_us) + 1
        if len(rows) < _LEAST_BURSTS:
            raise TransportError(f"{name}: its times come in bursts of over 0.3 s; let it send its samples more often")
        at_us = np.cumsum(steps_us)[rows - 1]
        self.period_us = float((at_us[-1] - at_us[0]) / (rows[-1] - rows[0]))
        errors_us = at_us - at_us[0] - self.period_us * (rows - rows[0])
        self._limit_us = float(np.max(np.abs(errors_us))) + GAP_STEPS * self.period_us

    def begin_again(self) -> None:
        """Take the next line for the first one."""
        self._wraps_us = 0.0
        self._before_us = self._now_us = self._offset_us = math.nan
        self._rows = 0

    def __call__(self, time_us: float) -> float:
        """Return the time of the next line."""
        if time_us + self._wraps_us - self._before_us < -self._wrap_us / 2 and self._before_us < self._wrap_us:
            self._wraps_us += self._wrap_us
        time_us += self._wraps_us
        step_us, self._before_us = time_us - self._before_us, time_us
        if not self._begins_us:
            return time_us
        if math.isnan(self._now_us):
            self._now_us = 0.0 if math.isnan(time_us) else time_us
            return self._now_us
        self._now_us += self.period_us
        self._rows += 1
        if step_us >= self._begins_us:
            if math.isnan(self._offset_us):
                self._offset_us = time_us - self._now_us
            error_us = time_us - self._now_us - self._offset_us
            if abs(error_us) > self._limit_us:
                self._now_us += error_us
            else:
                self._now_us += _SMOOTHING * error_us
                self.period_us += _SMOOTHING**2 / 4 * error_us / self._rows
            self._rows = 0
        return self._now_us


def _resolution(counts: Signal) -> float:
    """Return the smallest step that times (n,) can show by their digits, down to 1e-9."""
    for digits in range(10):
        scaled = counts * 10.0**digits
        if np.all(np.abs(scaled - np.rint(scaled)) < 1e-3):
            return 10.0**-digits
    return 0.0


class TimedSamples:
    """Puts samples of lines on a uniform grid, interpolated from their times. `losses`: the samples that were lost."""

    def __init__(self, lines: Lines, rate_hz: int, clock: Clock) -> None:
        self.losses = Losses()
        self.worst_jitter_us = 0.0
        self._lines, self._rate_hz, self._clock, self._period_us = lines, rate_hz, clock, clock.period_us
        self._late = self._all_late = 0
        self._begin()
        self._squares = 0.0
        self._steps = 0
        self._bad_before = lines.bad
        self._slowest_hz = self._fastest_hz = 1e6 / clock.period_us
        self._second: list[float] = []

    def _begin(self) -> None:
        self._times_us = np.zeros(0)  # since the first sample; the last ones, whose surroundings are not all known
        self._samples = np.zeros((0, self._lines.channels))
        self._first_us: float | None = None
        self._last_us = 0.0
        self._placed = 0

    def begin_again(self) -> None:
        """Take the next sample for the first one: the port was opened again."""
        self._lines.begin_again()
        self._clock.begin_again()
        self._begin()

    def feed(self, data: bytes) -> Signal:
        """Take bytes that arrived; return the samples (n, channels) that are now known. Raises TransportError."""
        found = self._lines.feed(data)
        if self._lines.bad_in_a_row > _MAX_BAD_LINES:
            raise TransportError(
                f"the sensor has sent {self._lines.bad_in_a_row} lines in a row that hold no sample; check its "
                "program, its cable and the @BAUD of its address"
            )
        return self.place(found)

    def place(self, found: list[tuple[float, tuple[float, ...]]]) -> Signal:
        """Return the samples on the grid that further lines determine. Raises TransportError."""
        times_us, samples = [], []
        for stated_us, values in found:
            time_us = self._clock(stated_us)
            if self._first_us is None:
                self._first_us = self._last_us = time_us
            else:
                step_us = time_us - self._last_us
                if step_us > 1e6 * MAX_FILLED_S:
                    raise TransportError(
                        f"the sensor's time jumps by {step_us / 1e6:g} s; check its cable and that it does not restart"
                    )
                if step_us <= 0:
                    self._late += 1
                    self._all_late += 1
                    if self._late > _MAX_BAD_LINES:
                        raise TransportError("the sensor's time runs back; check that it does not restart")
                    continue
                self._late = 0
                self._note_step(step_us, time_us - self._first_us)
                self._last_us = time_us
            times_us.append(time_us - self._first_us)
            samples.append(values)
        if not samples:
            return self._samples[:0]
        self._times_us = np.concatenate((self._times_us, times_us))
        self._samples = np.concatenate((self._samples, np.asarray(samples, np.float64)))
        if len(self._times_us) < 4:
            return self._samples[:0]
        return self._interpolated()

    def _note_step(self, step_us: float, now_us: float) -> None:
        steps = step_us / self._period_us
        if steps > GAP_STEPS:
            self.losses.add((now_us - step_us) / 1e6, max(1, round(steps) - 1))
            return
        jitter_us = abs(step_us - self._period_us)
        self.worst_jitter_us = max(self.worst_jitter_us, jitter_us)
        self._squares += jitter_us**2
        self._steps += 1
        self._second.append(step_us)
        if len(self._second) >= self._rate_hz:
            # Slow drift of the sensor's clock is no jitter.
            rate_hz = 1e6 * len(self._second) / sum(self._second)
            self._slowest_hz, self._fastest_hz = min(self._slowest_hz, rate_hz), max(self._fastest_hz, rate_hz)
            self._period_us = 1e6 / rate_hz
            self._second.clear()

    def _interpolated(self) -> Signal:
        """Return the grid up to the last but one sample, whose slope is known, and forget what it needs no more."""
        t, x = self._times_us, self._samples
        step_us = 1e6 / self._rate_hz
        end = math.floor(t[-2] / step_us) + 1
        grid_us = step_us * np.arange(self._placed, max(end, self._placed))
        result = interpolated(t, x, grid_us, GAP_STEPS * self._period_us)
        self._placed = max(end, self._placed)
        keep = max(0, int(np.searchsorted(t, step_us * self._placed, side="right")) - 2)
        self._times_us, self._samples = t[keep:], x[keep:]
        return result

    def warnings(self) -> list[str]:
        """Return remarks on the stream, for people."""
        remarks = []
        if damaged := self._lines.bad - self._bad_before:
            remarks.append(f"{damaged} line(s) without a sample")
        if self._all_late:
            remarks.append(f"{self._all_late} line(s) whose time did not rise")
        if self._fastest_hz > (1 + CLOCK_TOLERANCE) * self._slowest_hz:
            remarks.append(f"the sensor's rate changed between {self._slowest_hz:.1f} and {self._fastest_hz:.1f} Hz")
        return remarks

    @property
    def jitter_us(self) -> float:
        """The RMS deviation of the steps in time from their mean, without gaps."""
        return math.sqrt(self._squares / max(1, self._steps))


class SerialSensor(Closing):
    """A serial sensor that sends samples.

    `rate_hz`, `sensitivity` and `axes`: needed where the sensor does not state them. `axes` may also choose some of
    those that it states. `reconnect_s`: for how long `read` tries to open a lost port again, and returns no samples. It
    finds the port as `SerialTransport.reopen` does.

    Raises TransportError, and TextureError for options that are missing or contradict the sensor.

    Attributes:
        rate_hz: Of the samples that `read` returns.
        unit: "m/s^2" or "um".
        axes: One letter for each channel, or none.
        channels: How many there are.
        full_scale: The highest value that the sensor can measure, in `unit`; None = unknown.
        description: What the sensor states.
        understood: How what it sends is read, in words.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        rate_hz: int | None = None,
        sensitivity: Sensitivity | None = None,
        axes: str = "",
        reconnect_s: float = 0.0,
        open_port: Callable[[str, int], Transport] = SerialTransport,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = f"serial:{port}"
        self.sensitivity = None if sensitivity is None else sensitivity.text
        self._transport = open_port(port, baud)
        self._clock, self._reconnect_s = clock, 0.0  # not yet
        self._lost_s: float | None = None
        try:
            self._began_s = self._heard_s = self._tried_s = clock()
            self._lines = self._recognised()
            found = self._lines.settle(self.name)
            self.description = self._lines.description
            self._scale, self.unit = self._scaled(sensitivity)
            self._columns, self.axes = self._chosen(axes)
            self.channels = len(self._columns)
            self.full_scale: float | None = None
            if self.description.full_scale is not None and self.description.unit is not None:
                self.full_scale = self.description.full_scale * INPUT_UNITS[self.description.unit][1]
            evenly = self._clock_of(rate_hz, [time_us for time_us, _ in found])
            self._placing = TimedSamples(self._lines, self.rate_hz, evenly)
            self._first = self._placing.place(found)
            self.understood = self._in_words(evenly)
            self._reconnect_s = reconnect_s
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the port; may be called again."""
        self._transport.close()

    @property
    def losses(self) -> Losses:
        """The samples that were lost on the way, which `read` has interpolated."""
        return self._placing.losses

    def introduction(self) -> list[str]:
        """Return the first lines that came, and how they are read, for people."""
        return [*(f"  {line}" for line in self._lines.shown), f"understood as {self.understood}"]

    def warnings(self) -> list[str]:
        """Return remarks on the stream so far, for people."""
        return self._placing.warnings()

    def facts(self) -> dict[str, object]:
        """Return what is known of the stream, for the sidecar."""
        return {
            "understood": self.understood,
            "jitter_us": round(self._placing.jitter_us, 2),
            "worst_jitter_us": round(self._placing.worst_jitter_us, 2),
        }

    def read(self, timeout_s: float) -> Signal:
        """Return the samples (n, channels) since the last call; none after `timeout_s`.

        Raises TransportError if the port breaks off, and if the sensor sends no samples any more.
        """
        first, self._first = self._first, self._first[:0]
        if len(first):
            return self._finished(first)
        return self._finished(self._placing.feed(self._bytes(timeout_s)))

    def _finished(self, samples: Signal) -> Signal:
        return samples[:, self._columns] * self._scale

    def _bytes(self, timeout_s: float) -> bytes:
        if self._lost_s is not None:
            self._reopen(self._lost_s, timeout_s)
            return b""
        try:
            data = self._transport.read(timeout_s)
        except TransportError:
            if not self._reconnect_s:
                raise
            self._lost_s = self._clock()
            notes.warning("%s; trying to open it again for %g s", self._lost(self._lost_s), self._reconnect_s)
            return b""
        now_s = self._clock()
        if data:
            self._heard_s = now_s
        elif now_s - self._heard_s > _SILENT_S:
            raise TransportError(f"{self.name} sends nothing; check that the sensor runs, and that this is its port")
        return data

    def _lost(self, lost_s: float) -> str:
        return f"{self.name} was lost after {lost_s - self._began_s:.1f} s"

    def _reopen(self, lost_s: float, timeout_s: float) -> None:
        """Try now and then to open the port again. Raises TransportError after `reconnect_s`."""
        if self._clock() - self._tried_s < _RETRY_S:
            time.sleep(timeout_s)
            return
        self._tried_s = self._clock()
        try:
            self._transport.reopen()
        except TransportError as error:
            if self._tried_s - lost_s > self._reconnect_s:
                error.problem = f"{self._lost(lost_s)}: {error.problem}"
                raise
            return
        self._lost_s = None
        self._heard_s = self._clock()
        self._placing.begin_again()
        notes.warning("%s is back", self.name)

    def _recognised(self) -> Lines:
        """Read until format and rate can be known, and return the reader, which knows the description."""
        lines = Lines()
        received = 0
        first_s = math.inf  # of text, or else of bytes
        while True:
            data = self._bytes(0.1)
            now_s = self._clock()
            if data and not (received and lines.gathered):
                first_s = min(first_s, now_s)
            received += len(data)
            lines.feed(data, now_s)
            elapsed_s = now_s - first_s
            if lines.gathered:
                known = lines.description != Description() or elapsed_s >= _STATED_WITHIN_S
                enough = lines.gathered >= _MEASURED_LINES and elapsed_s >= _MEASURED_S
                if (known and enough) or lines.gathered > _MAX_MEASURED_LINES:
                    return lines
                if elapsed_s > _SILENT_S:
                    raise TransportError(
                        f"{self.name} sends only {lines.gathered / elapsed_s:.1f} lines a second, too few for a "
                        f"vibration: {lines.told()}; raise its rate"
                    )
            elif received > _UNKNOWN_BYTES or elapsed_s > 2 * _SILENT_S:
                garbled = sum(not line.isprintable() or "\ufffd" in line for line in lines.shown)
                if lines.shown and 2 * garbled < len(lines.shown):
                    raise TransportError(
                        f"{self.name} sends lines that hold no samples: {lines.told()}; let it send a time and up to "
                        f"{MAX_CHANNELS} numbers in each line"
                    )
                raise TransportError(
                    f"{self.name} sends no lines of samples; check the @BAUD of its address (many boards use 115200 "
                    "or 9600), and that this is the sensor's port"
                )

    def _scaled(self, sensitivity: Sensitivity | None) -> tuple[float, str]:
        """Return the value of one count, and its unit. Raises TextureError."""
        stated = self.description
        if stated.unit is not None:
            if sensitivity is not None:
                raise TextureError(
                    f"{self.name} states its unit, {stated.unit}",
                    action="leave out `sensitivity`",
                    parameter="sensitivity",
                )
            unit, factor = INPUT_UNITS[stated.unit]
            return factor / (stated.counts_per_unit or 1.0), unit
        if sensitivity is None:
            raise TextureError(
                f"{self.name} does not state its unit",
                action="give `sensitivity`, such as 256/g where 256 is one g",
                parameter="sensitivity",
            )
        if sensitivity.in_volts:
            raise TextureError(
                f"{self.name} sends numbers, not volts",
                action="give `sensitivity` in counts, such as 256/g where 256 is one g",
                parameter="sensitivity",
            )
        return 1 / sensitivity.per_unit, sensitivity.unit

    def _chosen(self, axes: str) -> tuple[list[int], str]:
        """Return the columns to record, in the order x, y, z, and their axes. Raises TextureError."""
        width, named = self._lines.channels, self._lines.settled.axes
        stated = self.description.axes or named or (axes if axes else "xyz" if width == MAX_CHANNELS else "")
        if stated and len(stated) != width:
            raise TextureError(
                f"{self.name} sends {width} channels, and {len(stated)} axes are named",
                f"`axes`={stated}",
                parameter="axes",
            )
        if missing := [axis for axis in axes if axis not in stated]:
            raise TextureError(
                f"{self.name} has the axes {stated}", action=f"leave {missing[0]} out of `axes`", parameter="axes"
            )
        chosen = "".join(sorted(axes or stated))
        return ([stated.index(axis) for axis in chosen] if chosen else list(range(width))), chosen

    def _clock_of(self, rate_hz: int | None, times_us: Sequence[float]) -> Clock:
        """Return the clock of lines with these times, and set `rate_hz`. Raises TextureError and TransportError."""
        stated_hz = self.description.rate_hz
        if rate_hz is not None and stated_hz not in (None, rate_hz):
            raise TextureError(
                f"{self.name} states {stated_hz} Hz", action=f"leave out `rate_hz`={rate_hz}", parameter="rate_hz"
            )
        wanted_hz = rate_hz or stated_hz
        layout, arriving_hz = self._lines.settled, self._lines.per_second()
        has_time = layout.time is not None
        if not has_time and wanted_hz is None:
            raise TextureError(
                f"{self.name} sends no time: {self._lines.told()}",
                action=f"give `rate_hz`; about {arriving_hz:.0f} lines came in a second",
                parameter="rate_hz",
            )
        clock = Clock(times_us, layout.us, self.name, wanted_hz)
        measured_hz = 1e6 / clock.period_us if has_time else arriving_hz
        tolerance = CLOCK_TOLERANCE if has_time else _ARRIVAL_TOLERANCE
        if wanted_hz is not None and abs(measured_hz - wanted_hz) > tolerance * wanted_hz:
            raise TransportError(
                f"{self.name} gives its rate as {wanted_hz} Hz, and its {'times' if has_time else 'lines'} say "
                f"{measured_hz:.1f} Hz; correct one of them, or raise the @BAUD of its address if it loses lines"
            )
        self.rate_hz = wanted_hz or max(1, round(measured_hz))
        return clock

    def _in_words(self, clock: Clock) -> str:
        """Return how the samples are read, for people."""
        what = f"{', '.join(self.axes) or f'{self.channels} channel(s)'} in {self.description.unit or self.sensitivity}"
        left_out = self._lines.settled.left_out
        without = f"; left out: {', '.join(left_out)}" if left_out else ""
        return f"text: {clock.kind}; {what}; {self.rate_hz} Hz{without}"
