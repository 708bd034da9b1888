"""The picture of a map: a coloured cell for each condition, with a figure or the letter of its outcome."""

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from vibrocast.evaluation.pictures import figure_file
from vibrocast.evaluation.stability.maps import LEVELS, Cells, Map
from vibrocast.evaluation.stability.trials import Outcome

COLOURS = {
    Outcome.HOLDS: ("#e4efe8", "0.35"),
    Outcome.REJECTED: ("#b5cfe8", "0.1"),
    Outcome.DEGRADED: ("#f0a830", "black"),
    Outcome.FAILS: ("#9b1c31", "white"),
}
"""Of a cell and of its text. The lightness differs too, for those who see or print them in grey."""
_MIN_WIDTH_IN, _ROW_IN, _COLUMN_IN, _LINE_IN = 5.0, 0.18, 0.17, 0.16
_CHARACTER_IN, _BOLD_CHARACTER_IN = 0.07, 0.066


class Place(NamedTuple):
    """Where a picture shows a cell. `heading`: above several columns."""

    heading: str
    column: str | float
    row: str


def write(path: Path, each: Map, cells: Cells) -> None:
    """Draw each cell at its place, on the colour of its outcome, a panel for each heading. Raises OSError.

    Rows stand in the order of the cells. So do columns that are words, except LEVELS; columns that are numbers rise.
    """
    shown = worst_at_each_place(each, cells)
    rows = list(dict.fromkeys(place.row for place in shown))
    columns: dict[str, list[str | float]] = {}
    for heading, column in dict.fromkeys((place.heading, place.column) for place in shown):
        columns.setdefault(heading, []).append(column)
    for own in columns.values():
        own.sort(
            key=lambda x: (isinstance(x, float), LEVELS.index(x) if x in LEVELS else x if isinstance(x, float) else 0)
        )
    count = sum(map(len, columns.values()))
    names = {heading: [f"{x:g}" if isinstance(x, float) else x for x in own] for heading, own in columns.items()}
    rows_in = _text_in(rows) + 0.2
    column_in = max(
        _COLUMN_IN, 0.06 + _text_in(label(each, cell) for cell in shown.values()), (_MIN_WIDTH_IN - rows_in) / count
    )
    names_in, headings_in = _text_in(name for own in names.values() for name in own), _text_in(columns)
    upright = names_in > column_in
    upright_headings = any(_text_in([heading]) > column_in * len(own) for heading, own in columns.items())
    width_in = rows_in + column_in * count
    title = textwrap.fill(each.message(cells), int(width_in / _BOLD_CHARACTER_IN))
    lines = title.count("\n") + 3 + bool(each.words.caption) + (not upright) + (not upright_headings)
    height_in = _ROW_IN * len(rows) + _LINE_IN * lines + upright * names_in + upright_headings * headings_in
    with figure_file(path, width_in, height_in) as figure:
        outcomes = [outcome for outcome in COLOURS if any(cell["outcome"] == outcome for cell in shown.values())]
        figure.legend(
            handles=[Patch(color=COLOURS[outcome][0], label=f"{outcome.letter}: {outcome}") for outcome in outcomes],
            title=title,
            title_fontproperties={"weight": "bold"},
            loc="outside upper left",
            alignment="left",
            ncols=len(outcomes),
            frameon=False,
            borderpad=0,
        )
        widths = [len(own) for own in columns.values()]
        panels = figure.subplots(1, len(columns), squeeze=False, sharey=True, width_ratios=widths)[0]
        for (heading, own), axes in zip(columns.items(), panels, strict=True):
            grid = np.full((len(rows), len(own)), np.nan)
            for (y, row), (x, column) in ((y, x) for y in enumerate(rows) for x in enumerate(own)):
                if cell := shown.get(Place(heading, column, row)):
                    outcome = Outcome(cell["outcome"])
                    grid[y, x] = list(COLOURS).index(outcome)
                    form = {"color": COLOURS[outcome][1], "ha": "center", "va": "center"}
                    axes.text(x + 0.5, y + 0.53, label(each, cell), **form)
            shades = ListedColormap([colour for colour, _ in COLOURS.values()])
            axes.imshow(
                grid,
                shades,
                aspect="auto",
                interpolation="none",
                vmin=-0.5,
                vmax=len(COLOURS) - 0.5,
                extent=(0, len(own), len(rows), 0),
            )
            axes.vlines(range(len(own) + 1), 0, len(rows), color="white", linewidth=0.8)
            axes.hlines(range(len(rows) + 1), 0, len(own), color="white", linewidth=0.8)
            axes.set_xticks(np.arange(len(own)) + 0.5, names[heading], rotation=90 if upright else 0)
            axes.set_title(heading, fontsize="medium", rotation=90 if upright_headings else 0)
            axes.xaxis.tick_top()
            axes.tick_params(length=0, pad=2)
            axes.spines[:].set_visible(False)
        panels[0].set_yticks(np.arange(len(rows)) + 0.5, rows)
        figure.supxlabel(each.words.caption, fontsize="medium")


def worst_at_each_place(each: Map, cells: Cells) -> dict[Place, dict[str, Any]]:
    """Return the cell that shows at each place: of several, the worst, and of equal ones the last."""
    words, worst = each.words, dict[Place, dict[str, Any]]()
    for cell in cells.iter_rows(named=True):
        value, level = cell["value"], cell["setting"].partition(":")[0]
        column = words.column.format(**cell, level=level) or (cell["case"] if value is None else value)
        heading = words.heading if words.column or value is not None else ""
        place = Place(heading.format(**cell), column, words.row.format(**cell))
        if _badness(cell) >= _badness(worst.setdefault(place, cell)):
            worst[place] = cell
    return worst


def label(each: Map, cell: dict[str, Any]) -> str:
    """Return the text in a cell: a figure, or the letter of its outcome, and nothing for one that holds."""
    name, _, form = each.words.label.partition(":")
    if name and cell[name] is not None:
        return f"{cell[name]:z{form}}".removesuffix("%")
    return "" if cell["outcome"] == Outcome.HOLDS else Outcome(cell["outcome"]).letter


def _badness(cell: dict[str, Any]) -> tuple[bool, int]:
    return not cell["sound"], list(Outcome).index(cell["outcome"])


def _text_in(texts: Iterable[str]) -> float:
    """Return the width of the longest text, in inches."""
    return _CHARACTER_IN * max(map(len, texts), default=0)
