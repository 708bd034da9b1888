"""Maps and curves that can be read in grey: letters in shaded cells, dashed lines named at their ends."""

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vibrocast.evaluation.labels import spread
from vibrocast.evaluation.stability.trials import Outcome, Verdict
from vibrocast.files import atomic_write

SHADES = {
    Outcome.HOLDS: ("white", "0.55"),
    Outcome.NOT_TRIED: ("white", "0.55"),
    Outcome.REJECTED: ("0.87", "0.2"),
    Outcome.DEGRADED: ("0.65", "black"),
    Outcome.FAILS: ("0.1", "white"),
}
"""Grey of a cell and of its letter."""
DASHES: tuple[tuple[str, str], ...] = (
    ("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ("-", "v"),
    ("--", "x"), (":", "P"), ("-.", "*"), ("-", "+"), ("--", "h"),
)  # fmt: skip
_WIDTH_IN, _PANEL_IN, _LEGEND_IN, _ROW_IN, _COLUMN_IN = 7.2, 2.6, 3.2, 0.18, 0.185
"""Of a page, so that letters of _POINTS are so large in print, and heights and widths of what is drawn."""
_POINTS = 8
_DPI = 120
_LABEL_DISTANCE = 0.07  # of an axis' height, for each line
_LABEL_CHARACTERS = {1: 40, 2: 20, 3: 13}
"""By how many panels are beside each other."""
_SAME_HEIGHT = 0.004
_MIN_TICK_DISTANCE = 0.13  # of its width


@dataclass(frozen=True)
class Curve:
    """A named curve; NaN where it has no value. `marked`: the points at which quality falls, or that fail."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    marked: Sequence[bool] = ()


@dataclass(frozen=True)
class Panel:
    """Axes with curves. `lines`: levels drawn across. `min_span`: of the vertical axis."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    log_x: bool = False
    lines: Sequence[float] = ()
    min_span: float = 0.0


def outcome_map(
    path: Path,
    cells: Sequence[Verdict],
    place: Callable[[Verdict], tuple[str, str]],
    caption: str,
    columns: Sequence[str] = (),
    groups: Sequence[str] = (),
) -> None:
    """Draw the letter of each cell at its `place`, a row and a column. Raises OSError.

    Without `columns` these stand in the order of the cells, as rows do. `groups`: names, each of as many columns; the
    columns themselves without any.
    """
    outcomes = {place(cell): cell.outcome for cell in cells}
    rows = list(dict.fromkeys(row for row, _ in outcomes))
    columns = columns or list(dict.fromkeys(column for _, column in outcomes))
    groups = groups or columns
    each = len(columns) // len(groups)
    upright = sum(map(len, groups)) > 3 * len(columns)  # they would run into each other
    above_in = 0.08 * max(map(len, groups)) if upright else 0.2
    names_in = 0.075 * max(map(len, rows))
    width_in = names_in + max(_LEGEND_IN, _COLUMN_IN * len(columns))
    with _figure(path, width_in, 0.7 + above_in + _ROW_IN * len(rows)) as figure:
        axes = figure.subplots()
        for y, row in enumerate(rows):
            for x, column in enumerate(columns):
                outcome = outcomes.get((row, column), Outcome.NOT_TRIED)
                shade, ink = SHADES[outcome]
                axes.fill_between([x, x + 1], y, y + 1, color=shade, linewidth=0)
                axes.text(x + 0.5, y + 0.52, outcome.letter, color=ink, ha="center", va="center")
        for x in range(len(columns) + 1):
            boundary = x % each == 0
            axes.axvline(
                x, color="black" if boundary and each > 1 else "0.8", linewidth=1 if boundary and each > 1 else 0.5
            )
        for y in range(len(rows) + 1):
            axes.axhline(y, color="0.8", linewidth=0.5)
        axes.set(xlim=(0, len(columns)), ylim=(len(rows), 0))
        axes.set_yticks(np.arange(len(rows)) + 0.5, rows)
        axes.set_xticks((np.arange(len(groups)) + 0.5) * each, groups, rotation=90 if upright else 0)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.set_title("H holds   D degraded   F fails   R rejected   - not tried", loc="left")
        axes.set_xlabel(caption)


def curves_of(
    cells: Sequence[Verdict],
    figure: str,
    name: Callable[[Verdict], str] = lambda cell: cell.method,
    marked: Callable[[Verdict], bool] = lambda cell: cell.outcome is Outcome.FAILS,
) -> list[Curve]:
    """Return a curve of a figure over what is varied for each name, by default each method; what fails is marked."""
    named: dict[str, list[Verdict]] = {}
    for cell in cells:
        named.setdefault(name(cell), []).append(cell)
    return [
        Curve(
            curve,
            [cell.value or 0.0 for cell in own],
            [cell.figure(figure) if math.isfinite(cell.figure(figure)) else math.nan for cell in own],
            [marked(cell) for cell in own],
        )
        for curve, own in named.items()
    ]


def curves(path: Path, panels: Sequence[Panel], across: int = 2) -> None:
    """Draw panels of curves, `across` beside each other; marked points are ringed. Raises OSError."""
    across = min(across, len(panels))
    down = -(-len(panels) // across)
    with _figure(path, _WIDTH_IN, _PANEL_IN * down) as figure:
        places = figure.subplots(down, across, squeeze=False).ravel()
        for panel, axes in zip(panels, places, strict=False):
            _draw_panel(axes, panel, _LABEL_CHARACTERS[across])
        for axes in places[len(panels) :]:
            axes.set_visible(False)


def dots(
    path: Path, names: Sequence[str], values: Mapping[str, Sequence[float]], label: str, line: float | None
) -> None:
    """Draw named values, each series with its own marker, and a line that they should not pass. Raises OSError."""
    with _figure(path, 0.8 * _WIDTH_IN, 0.9 + _ROW_IN * len(names)) as figure:
        axes = figure.subplots()
        rows = np.arange(len(names))
        for (series, numbers), (_, marker), shade in zip(values.items(), DASHES, cycle(("black", "0.5")), strict=False):
            axes.plot(numbers, rows, marker, color=shade, markerfacecolor=shade, markersize=5, label=series)
        if line is not None:
            axes.axvline(line, color="0.4", linestyle="--", linewidth=1)
        axes.set_yticks(rows, names)
        axes.set(ylim=(len(names) - 0.5, -0.5), xlabel=label)
        axes.grid(axis="y", color="0.9")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=min(4, len(values)), frameon=False)


def dots_of(path: Path, cells: Sequence[Verdict], figure: str, label: str, line: float) -> None:
    """Draw a figure of each case, a series for each method. Raises OSError."""
    cases = list(dict.fromkeys(cell.case for cell in cells))
    found = {(cell.method, cell.case): cell.figure(figure) for cell in cells}
    methods = dict.fromkeys(cell.method for cell in cells)
    values = {method: [found.get((method, case), math.nan) for case in cases] for method in methods}
    dots(path, cases, values, label, line)


@contextmanager
def _figure(path: Path, width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a figure to draw on, which is written when the block succeeds. Raises OSError."""
    with rc_context({"font.size": _POINTS, "axes.titlesize": _POINTS}):
        figure = Figure((width_in, height_in), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with atomic_write(path) as partial:
            figure.savefig(partial)


def _draw_panel(axes: Axes, panel: Panel, label_characters: int) -> None:
    if panel.log_x:
        axes.set_xscale("log")
    ends: list[tuple[float, float, str]] = []
    for index, curve in enumerate(panel.curves):
        style, marker = DASHES[index % len(DASHES)]
        shade = ("black", "0.45")[index % 2]
        axes.plot(curve.x, curve.y, linestyle=style, marker=marker, markersize=3, color=shade, linewidth=1.1)
        points = [(x, y) for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(y)]
        if points:
            ends.append((*max(points), curve.name))
        ringed = [
            (x, y) for x, y, mark in zip(curve.x, curve.y, curve.marked, strict=False) if mark and math.isfinite(y)
        ]
        if ringed:
            axes.plot(*zip(*ringed, strict=True), "o", markersize=8, markerfacecolor="none", color="black", linewidth=0)
    for level in panel.lines:
        axes.axhline(level, color="0.4", linestyle=(0, (1, 2)), linewidth=1)
    axes.set_title(panel.title, loc="left")
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    axes.grid(color="0.92")
    low, high = axes.get_ylim()
    missing = max(0.0, panel.min_span - (high - low))
    never_negative = all(not y < 0 for curve in panel.curves for y in curve.y)
    low = max(low - missing / 2, -0.04 * panel.min_span) if never_negative else low - missing / 2
    axes.set_ylim(low, high + missing / 2)
    if panel.log_x:
        ticks = _apart(sorted({x for curve in panel.curves for x in curve.x}))
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    elif all(float(x).is_integer() for curve in panel.curves for x in curve.x):
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    _name_ends(axes, ends, label_characters)


def _apart(ticks: Sequence[float]) -> list[float]:
    """Return those of rising positive numbers that have room for their names on a logarithmic axis."""
    chosen: list[float] = []
    for tick in ticks:
        if not chosen or math.log(tick / chosen[-1]) >= _MIN_TICK_DISTANCE * math.log(ticks[-1] / ticks[0]):
            chosen.append(tick)
    return chosen


def _name_ends(axes: Axes, ends: Sequence[tuple[float, float, str]], label_characters: int) -> None:
    """Name curves right of the axes, at the heights of their last points, moved apart where they would collide.

    Curves that end in the same point share a label.
    """
    low, high = axes.get_ylim()
    together: dict[tuple[int, float], list[tuple[float, str]]] = {}
    for x, y, name in ends:
        together.setdefault((round((y - low) / (high - low) / _SAME_HEIGHT), x), []).append((y, name))
    labels = [
        (x, some[0][0], textwrap.fill(", ".join(name for _, name in some), label_characters, break_on_hyphens=False))
        for (_, x), some in sorted(together.items())
    ]
    rooms = [_LABEL_DISTANCE * (label.count("\n") + 1) for _, _, label in labels]
    placed = spread([(y - low) / (high - low) for _, y, _ in labels], rooms)
    for (x, y, label), height in zip(labels, placed, strict=True):
        axes.annotate(
            label,
            (x, y),
            (1.03, height),
            textcoords="axes fraction",
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": "0.75", "linewidth": 0.6, "relpos": (0, 0.5)},
        )
