"""Writes the report of a study: one page with charts, and the same figures as JSON and CSV."""

import json
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vibrocast import pages
from vibrocast.evaluation import pictures
from vibrocast.files import atomic_folder
from vibrocast.study import analysis
from vibrocast.study.analysis import METRICS, Analysis
from vibrocast.study.methods import GRADES, QUALITIES
from vibrocast.study.session import as_csv
from vibrocast.study.statistics import Interval

PAGE, JSON = "report.html", "report.json"
_PANEL_IN = (3.2, 2.7)
_MAX_COLUMNS = 3
_NAME_CHARACTERS = 18
_MARKERS = "osD^v<>pP*"
# From light to dark, so that grades stay apart in grey print.
_SHADES = ("#d9e6ee", "#9ec1d6", "#4f8fb5", "#00558c", "#20123a")
_COLOURS = (pictures.BLUE, pictures.ORANGE, pictures.GREEN, pictures.PURPLE, pictures.BROWN, pictures.SKY)
_OF_SIMULATION = "Simulated observers, not people"


def write_report(folder: Path, out: Path) -> Path:
    """Analyse a results folder and write the report into `out`; return the page. Raises InputError, OSError."""
    read = analysis.analyse(folder)
    tables, charts = analysis.tables(read), _charts(read)
    page = pages.render(
        Path(__file__).with_name("report.html.jinja"),
        study=read.study,
        read=read,
        simulated=_OF_SIMULATION if read.is_simulated else None,
        findings=analysis.findings(read),
        charts=[(title, pictures.inlined(figure)) for title, figure in charts],
        tables=tables,
        cell=_cell,
    )
    with atomic_folder(out) as partial:
        (partial / PAGE).write_text(page, encoding="utf-8")
        document = {
            "study": read.study.name,
            "method": read.study.method,
            "study_sha256": read.study.sha256,
            "simulated": read.is_simulated,
            "excluded": {str(number): reason for number, reason in read.excluded.items()},
            "warnings": list(read.warnings),
            "findings": analysis.findings(read),
            **{name: [_plain(row) for row in rows] for name, rows in tables.items()},
        }
        (partial / JSON).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        for name, rows in tables.items():
            (partial / f"{name}.csv").write_text(as_csv(list(rows[0]), rows), encoding="utf-8", newline="")
        for title, figure in charts:
            pictures.write(figure, partial / f"{title.split()[0].lower()}.svg")
        (partial / "report.tex").write_text("\n".join(map(_latex, tables.items())), encoding="utf-8")
    return out / PAGE


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row that JSON can hold: None for a number that is none."""
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()}


def _latex(table: tuple[str, list[dict[str, Any]]]) -> str:
    name, rows = table
    words, cells = ([key.replace("_", " ") for key in rows[0]], [list(map(_cell, row.values())) for row in rows])
    return pages.latex_table(name.replace("_", " "), words, cells, "l" + "r" * (len(words) - 1))


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if not math.isfinite(value) else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    text = str(value)
    return text if len(text) <= 40 else f"{text[:16]}..."


# ---- charts ----


def _charts(read: Analysis) -> list[tuple[str, Figure]]:
    """Return the charts of a study with their titles."""
    charts = []
    if read.ratings:
        charts.append(("Means with 95 % intervals", _means(read)))
        charts.append(("Distribution of the answers", _distributions(read)))
        if read.correlations and any(each.pearson.value is not None for each in read.correlations.values()):
            charts.append(("Ratings against metrics", _scatter(read)))
    if read.detections:
        charts.append(("Sensitivity d' with 95 % intervals", _sensitivities(read)))
    if read.preferences:
        charts.append(("Preference with 95 % intervals", _strengths(read)))
    if read.thresholds:
        charts.append(("Staircases, a line for each participant", _tracks(read)))
    if read.is_simulated:
        for _, figure in charts:
            figure.suptitle(_OF_SIMULATION, fontsize=pictures.SMALL_POINTS, color=pictures.GREY)
    return charts


def _panels(titles: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each title."""
    columns = min(_MAX_COLUMNS, len(titles))
    rows = math.ceil(len(titles) / columns)
    figure = Figure(figsize=(columns * _PANEL_IN[0], rows * _PANEL_IN[1]), layout="constrained")
    axes = [figure.add_subplot(rows, columns, number) for number in range(1, len(titles) + 1)]
    for each, title in zip(axes, titles, strict=True):
        each.set_title(title, fontsize=pictures.POINTS, color=pictures.INK)
        each.tick_params(labelsize=pictures.SMALL_POINTS)
        each.spines[["top", "right"]].set_visible(False)
        each.grid(color=pictures.PALE, linewidth=0.7)
        each.set_axisbelow(True)
    return figure, axes


def _dotted(read: Analysis, found: Sequence[tuple[str, str, Interval]]) -> tuple[Figure, list[Axes]]:
    """Return a panel for each texture, with the values of its conditions and their intervals, the first one on top."""
    figure, panels = _panels(_textures(read))
    for axes, texture in zip(panels, _textures(read), strict=True):
        group = [(name, value) for its_texture, name, value in found if its_texture == texture]
        for place, (_, value) in enumerate(group):
            if value.low is not None and value.high is not None:
                axes.plot([value.low, value.high], [place, place], color=pictures.GREY, linewidth=1.4)
            if value.value is not None:
                axes.plot(value.value, place, "o", color=pictures.BLUE, markersize=5)
        _name_rows(axes, [name for name, _ in group])
    return figure, panels


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Put a name at each row, the first on top."""
    axes.set_yticks(range(len(names)), [textwrap.fill(name, _NAME_CHARACTERS) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)


def _textures(read: Analysis) -> list[str]:
    return [each.name for each in read.study.textures]


def _means(read: Analysis) -> Figure:
    figure, panels = _dotted(read, [(each.texture, each.condition, each.mean) for each in read.ratings])
    graded = read.study.method == "degradation"
    for axes in panels:
        axes.set_xlim((-0.1, len(GRADES) - 0.9) if graded else (0, 100))
        axes.set_xlabel("grade, 0 = same, 3 = different" if graded else "rating", fontsize=pictures.SMALL_POINTS)
    return figure


def _distributions(read: Analysis) -> Figure:
    figure, panels = _panels(_textures(read))
    words = GRADES if read.study.method == "degradation" else QUALITIES
    shades = _SHADES[: len(words)]
    for axes, texture in zip(panels, _textures(read), strict=True):
        group = [each for each in read.ratings if each.texture == texture]
        left = [0.0] * len(group)
        for number, (word, shade) in enumerate(zip(words, shades, strict=True)):
            widths = [100 * each.counts[number] / max(1, sum(each.counts)) for each in group]
            axes.barh(range(len(group)), widths, left=left, color=shade, edgecolor="white", linewidth=0.5, label=word)
            left = [start + width for start, width in zip(left, widths, strict=True)]
        _name_rows(axes, [each.condition for each in group])
        axes.set_xlim(0, 100)
        axes.set_xlabel("part of the answers, %", fontsize=pictures.SMALL_POINTS)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(words),
                  fontsize=pictures.SMALL_POINTS, frameon=False)  # fmt: skip
    return figure


def _scatter(read: Analysis) -> Figure:
    assert read.correlations is not None
    figure, panels = _panels(list(METRICS.values()))
    for axes, metric in zip(panels, METRICS, strict=True):
        pairs = analysis.metric_pairs(read, read.ratings, metric)
        for number, texture in enumerate(_textures(read)):
            axes.plot(
                [x for name, x, _ in pairs if name == texture],
                [y for name, _, y in pairs if name == texture],
                _MARKERS[number % len(_MARKERS)],
                color=_COLOURS[number % len(_COLOURS)],
                markersize=4.5,
                label=texture,
            )
        r = read.correlations[metric].pearson.value
        axes.set_xlabel("" if r is None else f"Pearson's r = {r:.2f}", fontsize=pictures.SMALL_POINTS)
        axes.set_ylabel("mean rating", fontsize=pictures.SMALL_POINTS)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4,
                  fontsize=pictures.SMALL_POINTS, frameon=False)  # fmt: skip
    return figure


def _sensitivities(read: Analysis) -> Figure:
    figure, panels = _dotted(read, [(each.texture, each.condition, each.sensitivity) for each in read.detections])
    for axes in panels:
        axes.set_xlabel("d'", fontsize=pictures.SMALL_POINTS)
        axes.axvline(0, color=pictures.INK, linewidth=0.8)
    return figure


def _strengths(read: Analysis) -> Figure:
    figure, panels = _dotted(read, [(each.texture, each.condition, each.strength) for each in read.preferences])
    for axes in panels:
        axes.set_xlabel("Bradley-Terry strength, log units", fontsize=pictures.SMALL_POINTS)
    return figure


def _tracks(read: Analysis) -> Figure:
    pairs = list(dict.fromkeys((each.texture, each.condition) for each in read.thresholds))
    figure, panels = _panels([f"{texture}, {condition}" for texture, condition in pairs])
    for axes, pair in zip(panels, pairs, strict=True):
        group = [each for each in read.thresholds if (each.texture, each.condition) == pair]
        for number, each in enumerate(group):
            trials = range(1, len(each.levels_db) + 1)
            colour = _COLOURS[number % len(_COLOURS)]
            axes.plot(trials, each.levels_db, "-", color=colour, linewidth=1.0, alpha=0.8)
            wrong = [(trial, level) for trial, level, right in zip(trials, each.levels_db, each.correct, strict=True)
                     if not right]  # fmt: skip
            axes.plot([x for x, _ in wrong], [y for _, y in wrong], "x", color=colour, markersize=4)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("trial; x = wrong", fontsize=pictures.SMALL_POINTS)
        axes.set_ylabel("level, dB", fontsize=pictures.SMALL_POINTS)
    return figure
