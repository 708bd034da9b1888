"""Times of samples: the rate that they give, what is wrong with them, and samples put on a uniform grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vibrocast.textures.recording import SECONDS, Signal, TextureError, unusable

GRID_TOLERANCE = 0.25  # of a step: the most by which a time or position may miss the uniform grid
RATE_TOLERANCE = 1e-9  # rounding error of the arithmetic of times
PLAUSIBLE_RATES_HZ = (200.0, 200_000.0)
"""Rates of textures, where a column of times states no unit. No sensor of touch is faster than the second one."""
CLOCK_TOLERANCE = 0.05
"""How far the clock of an accelerometer may be off: data sheets say 1 to 5 %."""
GAP_STEPS = 1.5
"""A longer step, in usual ones, is a gap."""
MAX_FILLED_S = 1.0
"""The longest gap that is interpolated."""

_TIME_NAMES = "time_s, time_ms, time_us or time_ns"
_DISORDER_STEPS = 20  # a line further from its place than this belongs to another take
_NEARLY_ALL = 0.95
_FEW = 100  # one flaw in so many lines is an exception
_COARSEST, _FINEST = 3, -10  # powers of ten to which times are rounded
_ROUNDING = 1.1  # of the unit to which times are rounded: the most by which they scatter about a fitted line
_LEAST_ROUNDED = 16  # lines; fewer say nothing of their rounding
_COUNTERS = (16, 32)  # bits
_FEW_DIGITS = 0.01  # of a rate: if rounded times leave more open, the user must say
_EPOCH_S = (1e9, 3e9)  # since 1970: the years 2001 to 2065


@dataclass(frozen=True)
class TimeColumn:
    """A column of times. `unit`: stated, as in SPELLINGS where it is known, or None. `lines`: of the file before it."""

    name: str
    unit: str | None
    values: Signal
    lines: int = 0

    @property
    def place(self) -> str:
        """The column, for people."""
        return f"column of times {self.name!r}"


@dataclass(frozen=True)
class _Grid:
    """A uniform grid that times may lie on.

    `step`: in the column's unit. `error`: the possible error of the step, relative. `note`: what was inferred.
    """

    step: float
    error: float
    note: str = ""


def uniform_step(values: Signal, place: str, lines: int = 0) -> float:
    """Return the step of rising values (n,) that lie on a uniform grid, to GRID_TOLERANCE of a step.

    `lines`: how many lines of the file are above the first value. Otherwise raises TextureError, which names the
    `place`, the line and the size of the flaw.
    """
    step = _mean_step(values, place, lines)
    if is_uniform(values, step):
        return step
    raise _flaw(values, place, lines, "resample to equal steps first")


def rate_of(
    columns: Sequence[TimeColumn],
    samples: Signal,
    path: Path,
    commented_hz: float | None = None,
    given_hz: float | None = None,
    resample: bool = False,
) -> tuple[float, Signal, tuple[str, ...]]:
    """Return the rate in Hz from a comment or the user, if the times allow it, else that of the times.

    `columns`: of several, those that are a uniform grid count. `samples` (n, channels) come back as they are or, with
    `resample`, interpolated at equal steps from uneven times. The texts say what was inferred or interpolated. Raises
    TextureError if times, comment and user contradict each other, for a unit that is neither stated nor obvious, and
    for times that are no uniform grid.
    """
    rates_hz: dict[str, float] = {}
    errors = []
    notes: tuple[str, ...] = ()
    for column in columns:
        try:
            column = replace(column, values=_unwrapped(column.values))
            grid = _grid_of(column, samples, path, commented_hz or given_hz)
            rate_hz = _rate(column, grid, path, commented_hz, given_hz)
        except TextureError as error:
            errors.append(error)
            continue
        if not rates_hz and grid.note:
            notes = (f"{path}: {column.place} {grid.note}; its mean step says {rate_hz:g} Hz",)
        rates_hz[column.name] = rate_hz
    if rates_hz:
        if max(rates_hz.values()) > (1 + CLOCK_TOLERANCE) * min(rates_hz.values()):
            said = ", ".join(f"{name!r} {rate_hz:g} Hz" for name, rate_hz in rates_hz.items())
            raise TextureError(f"{path}: columns of times say different rates: {said}; correct or remove one")
        return next(iter(rates_hz.values())), samples, notes
    for column in columns if resample else ():
        try:
            return _resampled(replace(column, values=_unwrapped(column.values)), samples, path, commented_hz, given_hz)
        except TextureError as error:
            errors.insert(0, error)
    raise errors[0]


def interpolated(times: Signal, samples: Signal, grid: Signal, gap: float) -> Signal:
    """Return samples (n, channels) of rising times (n,), n >= 2, at the times of a grid between the first and the last.

    Between samples by the cubic polynomial with the parabolic slope at either end (C. de Boor, A Practical Guide to
    Splines, 1978, chapter IV: Bessel interpolation), over a step longer than `gap` by a line.
    """
    steps = np.diff(times)[:, None]
    secants = np.diff(samples, axis=0) / steps
    slopes = np.concatenate(
        (
            secants[:1],
            (steps[1:] * secants[:-1] + steps[:-1] * secants[1:]) / (steps[1:] + steps[:-1]),
            secants[-1:],
        )
    )
    at = np.clip(np.searchsorted(times, grid, side="right") - 1, 0, len(steps) - 1)
    step = steps[at]
    part = (grid - times[at])[:, None] / step
    over_gap = step > gap
    slope_before = np.where(over_gap, secants[at], slopes[at])
    slope_after = np.where(over_gap, secants[at], slopes[at + 1])
    # The cubic Hermite polynomial of both values and slopes.
    result: Signal = (
        (1 + 2 * part) * (1 - part) ** 2 * samples[at]
        + part**2 * (3 - 2 * part) * samples[at + 1]
        + step * part * (1 - part) * ((1 - part) * slope_before - part * slope_after)
    )
    return result


def _mean_step(values: Signal, place: str, lines: int) -> float:
    """Return the mean step of two values or more. Raises TextureError for one, and for what is no number."""
    if len(values) < 2:
        raise TextureError(f"{place}: a single line, which has no step; give two lines or more")
    if not np.isfinite(values).all():
        line = lines + int(np.isfinite(values).argmin()) + 1
        raise TextureError(f"{place}: line {line} holds no number; repair that line")
    with np.errstate(over="ignore"):
        return float(values[-1] - values[0]) / (len(values) - 1)


def is_uniform(values: Signal, step: float) -> bool:
    """Return whether values (n,) lie on a rising grid of this step from the first one, to GRID_TOLERANCE of a step."""
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(values - (values[0] + step * np.arange(len(values))))
        return bool(np.isfinite(step) and step > 0 and deviation.max() <= GRID_TOLERANCE * step)


def _flaw(values: Signal, place: str, lines: int, remedy: str) -> TextureError:
    """Return the error for finite values that are no uniform grid: the cause, the line, and what to do."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(values)
        behind = np.maximum.accumulate(values) - values
    usual = float(np.median(steps))
    backward = (steps < 0) | ~np.isfinite(steps)
    if not steps.any():
        return TextureError(f"{place}: the same in all lines", action="a time must rise; remove the column")
    if backward.any():
        first = int(backward.argmax())
        problem = (
            f"{place}: runs back after line {lines + first + 1}, from {values[first]:.12g} to {values[first + 1]:.12g}"
        )
        if usual > 0 and behind.max() <= _DISORDER_STEPS * usual:
            return TextureError(problem, "lines are out of order", "sort the lines by this column")
        return TextureError(
            problem, "a second recording, or a clock that began again", "put each part into its own file"
        )
    if (steps == 0).any():
        first = lines + int(np.argmin(steps > 0)) + 2
        return TextureError(f"{place}: repeats in line {first}", action="remove the lines that repeat")
    lost, mean = _lost(steps)
    if lost.any():
        gap, others = int(lost.argmax()), int(np.count_nonzero(lost)) - 1
        also = f", and {others} more" if others else ""
        return TextureError(
            f"{place}: a gap of {steps[gap]:g} after line {lines + gap + 1}{also}, where the usual step is {mean:g}",
            action=f"{remedy}, or cut the file there",
        )
    deviation = values - mean * np.arange(len(values))
    deviation = np.abs(deviation - np.median(deviation))
    worst, off = int(deviation.argmax()), int(np.sum(deviation > GRID_TOLERANCE * mean))
    size = f"{deviation[worst]:.3g}, {deviation[worst] / mean:.0%} of a step"
    few = off <= max(1, len(values) // _FEW)
    cause = "only this line" if off <= 1 else f"only {off} lines are" if few else f"{off} of {len(values)} lines jitter"
    return TextureError(f"{place}: line {lines + worst + 1} is off the uniform grid by {size}", cause, remedy)


def _lost(steps: Signal) -> tuple[Signal, float]:
    """Return how many samples are missing in each positive step (n,), and the mean step where none is.

    A gap is longer than GAP_STEPS of nearly all steps, and a short step after it does not make up for it.
    """
    limit = GAP_STEPS * float(np.quantile(steps, _NEARLY_ALL, method="lower"))
    mean = float(np.mean(steps[steps <= limit]))
    late = steps + np.append(steps[1:], mean) < (1 + GAP_STEPS) * mean
    lost = np.where((steps > limit) & ~late, np.maximum(np.rint(steps / mean) - 1, 1), 0)
    return lost, float(steps.sum() / (len(steps) + lost.sum()))


def _grid_of(column: TimeColumn, samples: Signal, path: Path, stated_hz: float | None) -> _Grid:
    """Return the grid that times lie on, perhaps rounded. Raises TextureError with the cause where there is none.

    Times with few digits scatter about their grid. So may the first and the last one, which give the step.
    """
    values, place = column.values, f"{path}: {column.place}"
    step = _mean_step(values, place, column.lines)
    intervals = np.arange(len(values))
    if is_uniform(values, step):
        return _Grid(step, float(np.ptp(values - step * intervals)) / step / intervals[-1] + RATE_TOLERANCE)
    if rounded := _rounded(values, column.unit or ""):
        return rounded
    steps = np.diff(values)
    repeated = np.flatnonzero(steps == 0)
    if not len(repeated) or not steps.any() or steps.min() < 0:
        raise _with_parameters(_flaw(values, place, column.lines, "give `resample` to interpolate"))
    if stated_hz is not None and any(
        abs(stated_hz * step * seconds - 1) <= CLOCK_TOLERANCE for seconds in _seconds(column).values()
    ):
        return _Grid(step, CLOCK_TOLERANCE)
    same = bool(np.all(samples[repeated] == samples[repeated + 1]))
    few = len(repeated) <= len(values) // _FEW
    other = "samples without a time of their own" if few else "the sensor was read in bursts"
    means = " or ".join(f"{1 / step / seconds:.4g} Hz" for seconds in _seconds(column).values())
    raise unusable(
        place,
        f"{len(repeated)} of {len(values)} lines repeat the time before, the first is line "
        f"{column.lines + int(repeated[0]) + 2}: " + ("duplicates, whose samples are equal too" if same else other),
        "give `resample` to leave them out"
        if same
        else f"give the sensor's rate as `rate_hz`, about {means}, or `resample` to spread them evenly",
        "rate_hz",
        "resample",
    )


def _with_parameters(error: TextureError) -> TextureError:
    return TextureError(error.problem, error.cause, error.action, ("resample", "rate_hz"))


def _rounded(values: Signal, unit_name: str) -> _Grid | None:
    """Return the grid of rising times that are rounded to about a step or more; None if rounding does not explain them.

    They are whole multiples of a power of ten, and lie within it of a straight line. So do their steps.
    """
    unit = next((10.0**power for power in range(_COARSEST, _FINEST, -1) if _are_multiples(values, 10.0**power)), None)
    steps = np.diff(values)
    if unit is None or steps.min() < 0 or len(values) < _LEAST_ROUNDED:
        return None
    places = np.arange(len(values)) - (len(values) - 1) / 2
    step = float(places @ (values - values.mean()) / (places @ places))
    if step <= 0 or max(np.ptp(values - step * places), np.ptp(steps)) > _ROUNDING * unit:
        return None
    how = "repeats, as if rounded to or read every" if steps.min() == 0 else "is rounded to"
    return _Grid(step, unit / step / (len(values) - 1), f"{how} {unit:g} {unit_name}".rstrip())


def _spread(times: Signal) -> Signal:
    """Return times (n,) that never fall, with those that are equal spread evenly up to the next one."""
    distinct, first, counts = np.unique(times, return_index=True, return_counts=True)
    steps = np.append(np.diff(distinct), (distinct[-1] - distinct[0]) / max(1, first[-1]) * counts[-1])
    part = (np.arange(len(times)) - np.repeat(first, counts)) / np.repeat(counts, counts)
    spread: Signal = times + part * np.repeat(steps, counts)
    return spread


def _unwrapped(values: Signal) -> Signal:
    """Return times (n,) of a counter of 16 or 32 bits that began again at 0, as if it had more bits."""
    steps = np.diff(values)
    if not len(steps) or not np.isfinite(values).all() or steps.min() >= 0:
        return values
    usual = float(np.median(steps))
    for bits in _COUNTERS:
        over = (steps < 0) & (np.abs(steps + 2.0**bits - usual) <= GAP_STEPS * usual)
        if over.any() and not (steps[~over] < 0).any():
            return values + 2.0**bits * np.concatenate(([0], np.cumsum(over)))
    return values


def _are_multiples(values: Signal, unit: float) -> bool:
    """Return whether values are whole multiples of a unit, to the rounding of float64."""
    rounding = float(np.max(np.abs(np.spacing(values)))) + RATE_TOLERANCE * unit
    off = np.abs(values - unit * np.rint(values / unit))
    return rounding < GRID_TOLERANCE * unit and bool(np.all(off <= rounding))


def _seconds(column: TimeColumn) -> dict[str, float]:
    """Return the units that the times may have, in s: the stated one, or that of times since 1970, or all."""
    if column.unit is not None:
        return {column.unit: SECONDS[column.unit]}
    low_s, high_s = _EPOCH_S
    since_1970 = {
        unit: seconds
        for unit, seconds in SECONDS.items()
        if low_s <= column.values[0] * seconds and column.values[-1] * seconds <= high_s
    }
    return since_1970 or SECONDS


def _rate(column: TimeColumn, grid: _Grid, path: Path, commented_hz: float | None, given_hz: float | None) -> float:
    """Return the rate in Hz from a comment or the user, if the grid allows it, else its own, whole if it allows that.

    Raises TextureError if they contradict each other, or if the unit is neither stated nor obvious.
    """
    if column.unit is not None and column.unit not in SECONDS:
        raise TextureError(f"{path}: {column.place} is in {column.unit}; name it {_TIME_NAMES}")
    units = _seconds(column)
    slowest_hz, fastest_hz = PLAUSIBLE_RATES_HZ
    if all(1 / grid.step / seconds > fastest_hz for seconds in units.values()):
        units = SECONDS  # another one than stated, if the user or a comment says so
    rates_hz = {}
    for unit, seconds in units.items():
        rate_hz = 1 / grid.step / seconds
        whole_hz = float(np.round(rate_hz))
        off_hz = rate_hz * grid.error
        rates_hz[unit] = (whole_hz if abs(rate_hz - whole_hz) <= off_hz else rate_hz, off_hz)
    plausible = [unit for unit, (rate_hz, _) in rates_hz.items() if slowest_hz <= rate_hz <= fastest_hz]
    said = rates_hz[(plausible or list(rates_hz))[0]][0]
    for stated_hz, contradiction in (
        (commented_hz, "a comment says {:g} Hz; correct one of them"),
        (given_hz, "leave out `rate_hz`={:g}, or correct the column"),
    ):
        if stated_hz is not None and not any(
            abs(stated_hz - rate_hz) <= off_hz for rate_hz, off_hz in rates_hz.values()
        ):
            problem = f"{path}: the time column says {said:g} Hz"
            raise TextureError(problem, action=contradiction.format(stated_hz), parameter="rate_hz")
    if stated := commented_hz or given_hz:
        return stated
    if column.unit is not None and units is SECONDS:
        raise unusable(
            path,
            f"{column.place} in {column.unit} says {1 / grid.step / SECONDS[column.unit]:g} Hz, which no sensor has",
            f"name it by its unit ({_listed(plausible, rates_hz) or 'none fits'}), or give the rate as `rate_hz`",
            "rate_hz",
        )
    if len(units) > 1 and "s" not in plausible:
        raise unusable(
            path,
            f"the column {column.name!r} states no unit, and its rate may be {_listed(list(rates_hz), rates_hz)}",
            f"name it {_TIME_NAMES} (or index, if it counts the samples), or give `rate_hz`",
            "rate_hz",
        )
    if grid.note and grid.error > _FEW_DIGITS:
        raise unusable(
            path,
            f"{column.place} {grid.note}, and its {len(column.values)} lines leave the rate open",
            f"give `rate_hz`, about {said:.3g}",
            "rate_hz",
        )
    return said


def _listed(units: Sequence[str], rates_hz: dict[str, tuple[float, float]]) -> str:
    return ", ".join(f"{rates_hz[unit][0]:g} Hz in {unit}" for unit in units)


def _resampled(
    column: TimeColumn, samples: Signal, path: Path, commented_hz: float | None, given_hz: float | None
) -> tuple[float, Signal, tuple[str, ...]]:
    """Return the rate, the samples interpolated at equal steps, and what was done. Raises TextureError where not."""
    values, place = column.values, f"{path}: {column.place}"
    _mean_step(values, place, column.lines)
    new = np.append(True, (np.diff(values) != 0) | np.any(np.diff(samples, axis=0) != 0, axis=1))
    lines = column.lines + np.flatnonzero(new)
    times, kept = values[new], samples[new]
    if len(times) < 2 or (np.diff(times) < 0).any() or times[0] == times[-1]:
        raise _flaw(values, place, column.lines, "")
    times = _spread(times)
    steps = np.diff(times)
    lost, mean = _lost(steps)
    rate_hz = _rate(column, _Grid(mean, CLOCK_TOLERANCE), path, commented_hz, given_hz)
    seconds = min(_seconds(column).values(), key=lambda each: abs(mean * each * rate_hz - 1))
    if lost.any() and steps.max() * seconds > MAX_FILLED_S:
        gap = int(steps.argmax())
        raise TextureError(
            f"{place}: a gap of {steps[gap] * seconds:.3g} s after line {lines[gap] + 1}, and at most "
            f"{MAX_FILLED_S:g} s are interpolated; cut the file there"
        )
    times_s = (times - times[0]) * seconds
    grid_s = np.arange(int(times_s[-1] * rate_hz * (1 + RATE_TOLERANCE)) + 1) / rate_hz
    filled = f", {int(lost.sum())} in {np.count_nonzero(lost)} gap(s)" if lost.any() else ""
    dropped = f", {len(values) - len(times)} repeated line(s) left out" if len(times) < len(values) else ""
    note = f"{place}: samples interpolated at {rate_hz:g} Hz from uneven times{filled}{dropped}"
    longest_s = float(steps[lost == 0].max()) * seconds
    return rate_hz, interpolated(times_s, kept, grid_s, longest_s), (note,)
