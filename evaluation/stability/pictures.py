"""The picture of a map: a coloured cell for each condition, with a figure or the letter of its outcome."""

import itertools
import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline

from vibrocast.evaluation.pictures import figure_file
from vibrocast.evaluation.stability.maps import Map, Place
from vibrocast.evaluation.stability.trials import Outcome, Verdict

COLOURS = {
    Outcome.HOLDS: ("#e4efe8", "0.35"),
    Outcome.REJECTED: ("#b5cfe8", "0.1"),
    Outcome.DEGRADED: ("#f0a830", "black"),
    Outcome.FAILS: ("#9b1c31", "white"),
}
"""Of a cell and of its text. The lightness differs too, for those who see or print them in grey."""
MAX_SVG_BYTES = 200_000
_MIN_WIDTH_IN, _ROW_IN, _COLUMN_IN, _LINE_IN = 5.0, 0.18, 0.17, 0.16
_CHARACTER_IN, _BOLD_CHARACTER_IN = 0.07, 0.066


def write(folder: Path, each: Map, cells: Sequence[Verdict]) -> str:
    """Draw a map's cells into a folder; return the file's name: SVG, or PNG where that would be too large.

    Raises OSError.
    """
    vector, raster = (folder / f"{each.name}.{suffix}" for suffix in ("svg", "png"))
    _draw(vector, each, cells)
    if vector.stat().st_size <= MAX_SVG_BYTES:
        raster.unlink(missing_ok=True)
        return vector.name
    vector.unlink()
    _draw(raster, each, cells)
    return raster.name


def _draw(path: Path, each: Map, cells: Sequence[Verdict]) -> None:
    """Draw each cell with its label at its place, on the colour of its outcome. Raises OSError.

    Where several cells share a place, the worst of them shows. Rows stand in the order of the cells. So do columns that
    are words; columns that are numbers follow them, rising.
    """
    shown = _worst_of_each(cells, each.place)
    rows = list(dict.fromkeys(place.row for place in shown))
    columns = _columns(shown)
    names = [column if isinstance(column, str) else f"{column:g}" for _, column in columns]
    groups = list(dict.fromkeys(group for group, _ in columns))
    rows_in = _CHARACTER_IN * _longest(rows) + 0.2
    text_in = 0.06 + _CHARACTER_IN * _longest(map(each.label, shown.values()))
    column_in = max(_COLUMN_IN, text_in, (_MIN_WIDTH_IN - rows_in) / len(columns))
    upright = _CHARACTER_IN * _longest(names) > column_in
    names_in = {
        group: _CHARACTER_IN * _longest(name for name, (own, _) in zip(names, columns, strict=True) if own == group)
        if upright
        else _LINE_IN
        for group in groups
    }
    upright_groups = any(
        _CHARACTER_IN * len(group) > column_in * sum(own == group for own, _ in columns) for group in groups
    )
    groups_in = _CHARACTER_IN * _longest(groups) if upright_groups else _LINE_IN
    width_in = rows_in + column_in * len(columns)
    heading = textwrap.fill(each.message(cells), int(width_in / _BOLD_CHARACTER_IN))
    lines = heading.count("\n") + 3 + bool(each.caption)
    with figure_file(
        path, width_in, _ROW_IN * len(rows) + _LINE_IN * lines + max(names_in.values()) + groups_in
    ) as figure:
        outcomes = [outcome for outcome in COLOURS if any(cell.outcome is outcome for cell in shown.values())]
        figure.legend(
            handles=[Patch(color=COLOURS[outcome][0], label=f"{outcome.letter}: {outcome}") for outcome in outcomes],
            title=heading,
            title_fontproperties={"weight": "bold"},
            loc="outside upper left",
            alignment="left",
            ncols=len(outcomes),
            frameon=False,
            borderpad=0,
        )
        axes = figure.subplots()
        grid = [[shown.get(Place(row, column, group)) for group, column in columns] for row in rows]
        for outcome in outcomes:
            axes.add_patch(_bars(outcome, grid))
        for y, row in enumerate(grid):
            for x, cell in enumerate(row):
                if cell is not None and (text := each.label(cell)):
                    axes.text(x + 0.5, y + 0.53, text, color=COLOURS[cell.outcome][1], ha="center", va="center")
        axes.vlines(range(len(columns) + 1), 0, len(rows), color="white", linewidth=0.8)
        axes.hlines(range(len(rows) + 1), 0, len(columns), color="white", linewidth=0.8)
        axes.set(xlim=(0, len(columns)), ylim=(len(rows), 0), xlabel=each.caption)
        axes.set_yticks(np.arange(len(rows)) + 0.5, rows)
        axes.set_xticks(np.arange(len(columns)) + 0.5, names, rotation=90 if upright else 0)
        axes.xaxis.tick_top()
        axes.tick_params(length=0, pad=2)
        axes.spines[:].set_visible(False)
        for group in filter(None, groups):
            own = [x for x, (name, _) in enumerate(columns) if name == group]
            if own[0]:
                axes.vlines(own[0], 0, len(rows), color="0.3", linewidth=0.8)
            axes.annotate(
                group,
                (sum(own) / len(own) + 0.5, 0),
                (0, 72 * (max(names_in.values()) if upright_groups else names_in[group]) + 3),
                textcoords="offset points",
                ha="center",
                va="bottom",
                rotation=90 if upright_groups else 0,
            )


def _worst_of_each(cells: Sequence[Verdict], place: Callable[[Verdict], Place]) -> dict[Place, Verdict]:
    def badness(cell: Verdict) -> tuple[bool, int]:
        return not cell.sound, list(Outcome).index(cell.outcome)

    worst: dict[Place, Verdict] = {}
    for cell in cells:
        if badness(cell) >= badness(worst.setdefault(place(cell), cell)):
            worst[place(cell)] = cell
    return worst


def _columns(places: Collection[Place]) -> list[tuple[str, str | float]]:
    """Return group and column of all columns."""
    of_groups: dict[str, dict[str | float, None]] = {}
    for each in places:
        of_groups.setdefault(each.group, {})[each.column] = None
    return [
        (group, column)
        for group, columns in of_groups.items()
        for column in sorted(columns, key=lambda column: -math.inf if isinstance(column, str) else column)
    ]


def _bars(outcome: Outcome, grid: Sequence[Sequence[Verdict | None]]) -> PathPatch:
    """Return the cells of one outcome, neighbours in a row as one bar: one shape keeps files small."""
    corners = []
    for y, row in enumerate(grid):
        x = 0
        for own, run in itertools.groupby(cell is not None and cell.outcome is outcome for cell in row):
            width = len(list(run))
            if own:
                corners.append([(x, y), (x + width, y), (x + width, y + 1), (x, y + 1)])
            x += width
    return PathPatch(
        Outline.make_compound_path(*(Outline([*each, each[0]], closed=True) for each in corners)),
        color=COLOURS[outcome][0],
        linewidth=0,
    )


def _longest(texts: Iterable[str]) -> int:
    return max(map(len, texts), default=0)
