"""Curves that can be read in grey: dashed lines, named at their ends."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from vibrocast.evaluation.labels import Label, write_beside
from vibrocast.evaluation.pictures import AXES, SMALL_POINTS, figure_file

DASHES: tuple[tuple[str, str], ...] = (
    ("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ("-", "v"),
    ("--", "x"), (":", "P"), ("-.", "*"), ("-", "+"), ("--", "h"),
)  # fmt: skip
_WIDTH_IN, _PANEL_IN = 7.2, 2.6
_LABEL_CHARACTERS = {1: 40, 2: 20}
"""By how many panels are next to each other."""
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
    """Axes with curves. `lines`: levels drawn across."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    log_x: bool = False
    lines: Sequence[float] = ()


def curves(path: Path, panels: Sequence[Panel], across: int = 2) -> None:
    """Draw panels of curves, `across` next to each other; marked points are ringed. Raises OSError."""
    across = min(across, len(panels))
    down = -(-len(panels) // across)
    with rc_context(AXES), figure_file(path, _WIDTH_IN, _PANEL_IN * down) as figure:
        places = figure.subplots(down, across, squeeze=False).ravel()
        for panel, axes in zip(panels, places, strict=False):
            _draw_panel(axes, panel, _LABEL_CHARACTERS[across])
        for axes in places[len(panels) :]:
            axes.set_visible(False)


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
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    if not any(y < 0 for curve in panel.curves for y in curve.y):
        axes.set_ylim(bottom=max(0.0, axes.get_ylim()[0]))
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
    """Name curves right of the axes; those that end in the same point share a label."""
    low, high = axes.get_ylim()
    together: dict[tuple[int, float], list[tuple[float, str]]] = {}
    for x, y, name in ends:
        together.setdefault((round((y - low) / (high - low) / _SAME_HEIGHT), x), []).append((y, name))
    labels = []
    for (_, x), some in together.items():
        text = textwrap.fill(", ".join(name for _, name in some), label_characters, break_on_hyphens=False)
        labels.append(Label(x, some[0][0], text, points=SMALL_POINTS))
    write_beside(axes, labels)
