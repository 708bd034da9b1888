"""Charts of the tables of evaluation.comparison: few codecs in colour, others thin and grey, each named in place."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray

from vibrocast.evaluation import pictures
from vibrocast.evaluation.bd_rate import SPQI, ST_SIM_2800, ST_SIM_8000, Scale
from vibrocast.evaluation.comparison import FIT, TIMES, best_of
from vibrocast.evaluation.labels import Label, write_beside
from vibrocast.evaluation.peers import named
from vibrocast.evaluation.pictures import GREY, INK, PALE, POINTS, SMALL_POINTS, Style
from vibrocast.evaluation.points import IMPORTED, MEASURED
from vibrocast.evaluation.tables import as_rows, by_codec, grouped, write_table

WIDTH_IN, DPI = 8.0, 150
FONT_POINTS = 8.5
PANEL_IN = 3.8
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN, TITLE_IN = 0.75, 0.3, 0.3, 0.5, 0.25
LINE_IN, CHARACTER_IN = 1.35 / 72, 0.6 / 72
"""Height of a line of text and width of a character, for each point of its size."""
LEADER_IN = 0.2
MAX_NAME = 32

MIN_RATE, MAX_RATE = 0.25, 4.0
TYPICAL_RATE = 2.0
"""Bits per sample up to which the curves of one group are compared."""
TIME_FLOOR_S = 1e-6  # a time axis is logarithmic and has no zero
LOG_MARGIN = 2.0
LONG_AXIS = 100.0  # from its end to its beginning, where ticks at 2 and 5 would touch
SATURATING = {ST_SIM_2800: (0.5, 0.998), ST_SIM_8000: (0.5, 0.998), SPQI: (0.1, 0.995)}
"""Qualities whose axis is spread towards 1, with its limits."""
SATURATING_TICKS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)
BELOW_WINDOW_DB, ABOVE_WINDOW_DB = 5, 10
FAR_DB = 20.0
"""A quality beyond the window by more is drawn on the edge, and named with its value."""

BACKGROUND = ("slp", "dct", "lc3", "wavpack", "g72", "amr", "flac", "parametric")
"""The first letters of curves that stay grey. All others without a style in pictures.CODECS may be a reader's own."""
MAIN = ("mdct", "slp", "eva", "vcpwq", "mpeg", "opus", "speex")
"""The groups in the chart for a first look."""
CORE, OTHER_RUNTIME = " (core)", " (onnx)"
"""End the names of costs of a model: by the controller's decoder, by one that only hosts have."""
MARKERS = {"o": "circles", "s": "squares", "^": "triangles"}
MAX_EXCESS_PERCENT = 300.0
AREA_OF_BYTE = 0.0015
"""Of a mark, in square points."""
MARKED_BYTES = (20_000, 200_000)
FAR_PERCENT = 150.0
MAX_NUMBERED_ROWS = 80
LOGARITHMIC = (*TIMES, "flash_bytes")
COST_LABELS = {
    "encode_s_per_megasample": "encoding, s per million samples",
    "decode_s_per_megasample": "decoding, s per million samples",
    "delay_ms": "algorithmic delay, ms",
    "flash_bytes": "decoder and model, kB",
}


@dataclass(frozen=True)
class Chart:
    """A chart of a page: the name of its files, its title, its rows, and the codecs that should have some."""

    stem: str
    title: str
    table: pl.DataFrame
    expected: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """How many rows the table has."""
        return len(self.table)

    @property
    def missing(self) -> list[str]:
        """The codecs that have no row."""
        drawn = set(self.table["codec"])
        return [codec for codec in self.expected if codec not in drawn]

    def write(self, folder: Path, plot: Callable[..., None]) -> "Chart":
        """Write the rows as CSV, and the chart of them if there are any; return itself. Raises OSError."""
        write_table(folder / f"{self.stem}.csv", self.table)
        image = folder / f"{self.stem}.svg"
        if self.rows:
            plot(image, self.table, title=self.title)
        else:
            image.unlink(missing_ok=True)
        return self


def plot_comparison(path: Path, table: pl.DataFrame, title: str, rate_hz: float | None) -> None:
    """Draw mean SNR over bits per sample, a curve for each group of MAIN, on linear axes. Raises OSError."""
    curves = main_curves(table)
    texts = [named(codec).name for codec in curves]
    figure = _figure(title, [3.3], texts, width_in=7.0)
    axes = figure.subplots()
    axes.set(xlim=(0, MAX_RATE), ylim=(0, 30), xlabel=_rate_label(rate_hz), ylabel="SNR, dB")
    _decorate(axes)
    finite = [[row for row in curve if math.isfinite(row.mean)] for curve in curves.values()]
    _draw_mean_curves(axes, finite, [_inked(codec) for codec in curves], texts)
    pictures.write(figure, path)


def plot_quality_against_rate(
    path: Path, table: pl.DataFrame, title: str, scale: Scale, rate_hz: float | None = None
) -> None:
    """Draw the mean curve of each group of codecs, and the spread of the first. Raises OSError."""
    curves = mean_curves_by_group(table)
    texts = [_name_and_rate(curve[0]) for curve in curves.values()]
    figure = _figure(title, [PANEL_IN], texts)
    axes = figure.subplots()
    _set_rate_axis(axes, _rate_label(rate_hz))
    axes.set_xlim(MIN_RATE, MAX_RATE)
    _set_quality_axis(axes, scale)
    first, styles = next(iter(curves.values())), [style_of(codec) for codec in curves]
    bits, low, high = np.transpose([(row.bits_per_sample, row.low, row.high) for row in first])
    area = _within(axes, low), _within(axes, high)
    axes.fill_between(bits, *area, color=styles[0].colour, alpha=0.12, linewidth=0)
    _draw_mean_curves(axes, list(curves.values()), styles, texts)
    pictures.write(figure, path)


def _draw_mean_curves(
    axes: Axes, curves: Sequence[Sequence[Any]], styles: Sequence[Style], texts: Sequence[str]
) -> None:
    """Draw curves with their names, the first of them in front."""
    labels: list[Label] = []
    for curve, style, text in zip(curves, styles, texts, strict=True):
        bits, mean = np.transpose([(row.bits_per_sample, row.mean) for row in curve])
        end = _draw_line(axes, bits, mean, style, front=not labels)
        labels.append(_label(*end, text, style, bold=not labels))
    _write_labels(axes, labels)


def plot_quality_against_ratio(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw every recording's points, joined, and the fit to all, a panel for each quality. Raises OSError."""
    figure, panels, styles = _panels_of_pair(table, title, scales, "compression ratio against 16 bits per sample")
    for axes, scale in zip(panels, scales, strict=True):
        if scale in SATURATING:  # a polynomial is no curve on an axis that is spread towards 1
            axes.set(yscale="linear", ylim=(SATURATING[scale][0], 1))
        labels = []
        for codec, of_codec in by_codec(as_rows(table.filter(quality=scale.field))).items():
            style = styles[codec]
            for trace, of_trace in grouped(of_codec, lambda row: row.trace).items():
                ratios, values = np.transpose([(row.compression_ratio, row.value) for row in of_trace])
                if trace != FIT:
                    order = np.argsort(ratios, kind="stable")
                    axes.plot(ratios[order], _within(axes, values[order]), color=style.colour, linewidth=0.6, alpha=0.5)
                    continue
                end = _draw_line(axes, ratios, values, replace(style, width=2.4))
                labels.append(_label(*end, name(of_codec[0]), style))
        _write_labels(axes, labels)
    pictures.write(figure, path)


def plot_bd_regions(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw two codecs' qualities over the rate, a panel for each quality; shaded where BD-rate integrates.

    Raises OSError.
    """
    figure, panels, styles = _panels_of_pair(table, title, scales, "bits per sample")
    panels[-1].set_xlim(MIN_RATE, MAX_RATE)
    for axes, scale in zip(panels, scales, strict=True):
        of_scale = by_codec(as_rows(table.filter(quality=scale.field)))
        labels, edges = [], []
        for codec, of_codec in of_scale.items():
            points, edge = (
                np.transpose([(row.bits_per_sample, row.value) for row in of_codec if row.in_region == inside])
                for inside in (False, True)
            )
            axes.plot(points[0], _within(axes, points[1]), "o", markersize=3.5, color=styles[codec].colour)
            edges.append(edge)
            end = _draw_line(axes, edge[0], edge[1], styles[codec])
            labels.append(_label(*end, name(of_codec[0]), styles[codec]))
        if edges:
            (test, values), (anchor, _) = edges
            axes.fill_betweenx(values, test, anchor, color=GREY, alpha=0.35, linewidth=0, zorder=1)
            first = next(iter(of_scale.values()))[0]
            _set_title(axes, f"{name(first)} {first.percent:+.1f} % at equal {scale.name}, {first.trace}")
        _write_labels(axes, labels)
    pictures.write(figure, path)


def _panels_of_pair(
    table: pl.DataFrame, title: str, scales: Sequence[Scale], label: str
) -> tuple[Figure, Sequence[Axes], Mapping[str, Style]]:
    """Return a figure with a panel for each quality over the rate, and a style for each of two codecs."""
    rows = as_rows(table)
    figure = _figure(title, [2.3] * len(scales), [name(row) for row in rows])
    panels = figure.subplots(len(scales), squeeze=False, sharex=True).ravel().tolist()
    _set_rate_axis(panels[-1], label)
    for axes, scale in zip(panels, scales, strict=True):
        _set_quality_axis(axes, scale)
    return figure, panels, _distinct_styles(by_codec(rows))


def plot_waveforms(path: Path, table: pl.DataFrame, title: str = "") -> None:
    """Draw a row of panels for each codec, a column for each rate: decoded samples over the original. Raises OSError.

    Columns of the table: `codec`, `source`, `compression_ratio`, `snr_db`, `time_ms`, `original`, `decoded`.
    """
    of_codecs = by_codec(as_rows(table))
    styles = _distinct_styles(of_codecs)
    figure = _figure(title, [1.8] * len(of_codecs))
    columns = max(len({row.compression_ratio for row in rows}) for rows in of_codecs.values())
    panels = figure.subplots(len(of_codecs), columns, squeeze=False, sharex=True, sharey=True)
    for (codec, rows), row_of_panels in zip(of_codecs.items(), panels, strict=True):
        ratios = sorted({row.compression_ratio for row in rows})
        for ratio, axes in zip(ratios, row_of_panels, strict=False):
            at_ratio = [row for row in rows if row.compression_ratio == ratio]
            time_ms, original, decoded = np.transpose([(row.time_ms, row.original, row.decoded) for row in at_ratio])
            axes.plot(time_ms, original, color="#c4c4c4", linewidth=3)
            axes.plot(time_ms, decoded, color=styles[codec].colour, linewidth=0.9)
            _decorate(axes)
            _set_title(axes, f"{name(at_ratio[0])}, ratio {ratio:.3g}: {at_ratio[0].snr_db:.1f} dB")
    figure.supxlabel("time, ms; wide and grey: original; thin: decoded", fontsize=FONT_POINTS)
    pictures.write(figure, path)


def plot_cost_points(path: Path, table: pl.DataFrame, title: str, scale: Scale) -> None:
    """Draw quality over each cost at the lowest rate, a panel for each cost, with their Pareto fronts. Raises OSError.

    Of grey and of imported codecs, one of each group is drawn; imported ones are hollow. Models are there as the
    controller decodes them.
    """
    rows = [row for row in as_rows(table) if not row.codec.endswith(OTHER_RUNTIME)]
    rows = [row for row in rows if row.bits_per_sample == min(each.bits_per_sample for each in rows)]
    foremost = best_of_groups(by_codec(rows), _best_quality)
    rows = [row for row in rows if row.codec in foremost or (row.source != IMPORTED and not is_grey(row.codec))]
    costs = list(dict.fromkeys(row.cost for row in rows))
    texts = {row.codec: _plain(_short(named(row.codec.removesuffix(CORE)).name)) for row in rows}
    figure = _figure(title, [max(PANEL_IN, LINE_IN * POINTS * len(texts))], texts.values(), across=len(costs))
    panels = figure.subplots(1, len(costs), squeeze=False, sharey=True).ravel()
    _set_quality_axis(panels[0], scale, [row.quality for row in rows])
    low, high = panels[0].get_ylim()
    for cost, axes in zip(costs, panels, strict=True):
        shown = [row for row in rows if row.cost == cost]
        _decorate(axes)
        axes.set_xlabel(COST_LABELS[cost])
        if cost in LOGARITHMIC:
            _set_log_axis(axes, [_cost(row) for row in shown], 1000 if cost == "flash_bytes" else 1)
        front = best_of((_cost(row), row.quality) for row in shown if row.source != IMPORTED)
        axes.plot(*np.transpose(front or [(math.nan, math.nan)]), color=GREY, linewidth=1, zorder=1)
        labels = []
        for row in shown:
            style, x, y = style_of(row.codec), _cost(row), float(np.clip(row.quality, low, high))
            fill = "white" if row.source == IMPORTED else style.colour
            axes.plot(x, y, "o", markersize=5, color=style.colour, markerfacecolor=fill, clip_on=False)
            text = texts[row.codec] if y == row.quality else f"{texts[row.codec]}: {row.quality:.0f} (off)"
            labels.append(_label(x, y, text, style, row.codec == MAIN[0]))
        _write_labels(axes, labels)
    pictures.write(figure, path)


def plot_loads(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw quality over the load of processors: a row of panels for each quality, one for each `cost` of the rows.

    The area of a mark is `memory_bytes`. No mark lies above the line; dots mark a full processor. Raises OSError.
    """
    rows = as_rows(table)
    costs = list(dict.fromkeys(row.cost for row in rows))
    names = [_short(row.codec) for row in rows]
    figure = _figure(title, [PANEL_IN * 0.75] * len(scales), names, across=len(costs), bottom_in=0.85)
    panels = figure.subplots(len(scales), len(costs), squeeze=False, sharex="col", sharey="row")
    for scale, cost, axes in ((s, c, panels[i][j]) for i, s in enumerate(scales) for j, c in enumerate(costs)):
        of_scale = [row for row in rows if row.quality == scale.field]
        shown = [row for row in of_scale if row.cost == cost]
        _set_quality_axis(axes, scale, [row.value for row in of_scale])
        _set_log_axis(axes, [row.load_percent for row in rows if row.cost == cost])
        if cost != costs[0]:
            axes.set_ylabel("")
        if scale == scales[-1]:
            axes.set_xlabel(cost)
        axes.axvline(100, color=INK, linewidth=0.8, linestyle=":")
        front = best_of((row.load_percent, row.value) for row in shown)
        (first, _), (_, best) = front[0], front[-1]
        edges = [(first, axes.get_ylim()[0]), *front, (axes.get_xlim()[1], best)]
        axes.step(*np.transpose(edges), where="post", color=GREY, linewidth=1, zorder=1)
        labels = []
        for row in shown:
            style, place = _inked(row.codec), (row.load_percent, row.value)
            axes.scatter(*place, row.memory_bytes * AREA_OF_BYTE, color=style.colour, alpha=0.6, linewidth=0)
            labels.append(_label(*place, _short(row.codec), style, row.codec == MAIN[0]))
        _write_labels(axes, labels)
    marks = [
        panels[0][0].scatter([], [], size * AREA_OF_BYTE, color=GREY, label=f"{size // 1000} kB")
        for size in MARKED_BYTES
    ]
    figure.legend(
        handles=marks, loc="lower left", ncols=2, frameon=False, fontsize=FONT_POINTS, title="area: code, model and RAM"
    )
    pictures.write(figure, path)


def plot_bd_rates(
    path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale], kinds: Mapping[str, str]
) -> None:
    """Draw a line of marks for each codec, a mark for each recording, its form by kind; a bar is the mean.

    A mark beyond FAR_PERCENT is on the edge. Raises OSError.
    """
    rows = as_rows(table)
    codecs = by_codec(rows)
    forms = dict(zip(dict.fromkeys(kinds.get(row.trace, "") for row in rows), cycle(MARKERS), strict=False))
    names = [name(of_codec[0]) for of_codec in codecs.values()]
    figure = _figure(title, [0.32 * len(codecs)], left=names, bottom_in=0.75)
    panels = figure.subplots(1, len(scales), squeeze=False, sharey=True).ravel()
    for scale, axes in zip(scales, panels, strict=True):
        for place, (codec, of_codec) in enumerate(codecs.items()):
            own = [row for row in of_codec if row.quality == scale.field]
            for kind, marker in forms.items():
                of_kind = [row.percent for row in own if kinds.get(row.trace, "") == kind]
                places = np.clip(of_kind, -FAR_PERCENT, FAR_PERCENT), [place] * len(of_kind)
                axes.plot(*places, marker, markersize=4, color=style_of(codec).colour, markerfacecolor="none")
            if own:
                mean = np.clip(fmean(row.percent for row in own), -FAR_PERCENT, FAR_PERCENT)
                axes.plot([mean, mean], [place - 0.35, place + 0.35], color=INK, linewidth=2)
        axes.axvline(0, color=INK, linewidth=0.8)
        _decorate(axes)
        _set_title(axes, f"at equal {scale.name}")
    panels[0].set_yticks(range(len(codecs)), names)
    panels[0].set_ylim(len(codecs) - 0.5, -0.5)
    named = "; ".join(f"{MARKERS[marker]}: {kind}" for kind, marker in forms.items() if kind)
    figure.supxlabel("\n".join(filter(None, ("change in bits, %; a bar is the mean", named))), fontsize=FONT_POINTS)
    pictures.write(figure, path)


def plot_rate_excesses(path: Path, table: pl.DataFrame, title: str) -> None:
    """Draw a map, recordings by a codec of each group, of the excess bits; darker is more, hatched has none.

    Of more than MAX_NUMBERED_ROWS recordings only some are named, and no number is written. Raises OSError.
    """
    rows = as_rows(table)
    codecs = best_of_groups(by_codec(rows), lambda of_codec: -_excess(of_codec))
    codecs = dict(sorted(codecs.items(), key=lambda item: _excess(item[1])))
    traces = sorted({row.trace for row in rows})
    cells = np.full((len(traces), len(codecs)), np.nan)
    for column, of_codec in enumerate(codecs.values()):
        for row in of_codec:
            cells[traces.index(row.trace), column] = row.excess_percent
    every = math.ceil(len(traces) / MAX_NUMBERED_ROWS)
    traces_named = [_short(trace) for trace in traces[::every]]
    height_in = 0.21 * min(len(traces), MAX_NUMBERED_ROWS)
    figure = _figure(title, [height_in], ["rotated"], left=traces_named, top_in=0.7, bottom_in=0.1)
    axes = figure.subplots()
    shades = LinearSegmentedColormap.from_list("excess", ["white", pictures.BLUE])
    axes.pcolormesh(np.sqrt(cells), cmap=shades, vmin=0, vmax=math.sqrt(MAX_EXCESS_PERCENT), edgecolors="white")
    axes.patch.set(facecolor="white", edgecolor=GREY, hatch="////")
    axes.invert_yaxis()
    places = np.arange(len(codecs)) + 0.5
    axes.set_xticks(places, [_short(named(codec).name) for codec in codecs], rotation=35, ha="left")
    axes.xaxis.tick_top()
    axes.set_yticks(np.arange(0, len(traces), every) + 0.5, traces_named)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    if every == 1:
        for (row_number, column), excess in np.ndenumerate(cells):
            if math.isfinite(excess):
                colour = "white" if excess > MAX_EXCESS_PERCENT / 2.5 else INK
                axes.text(column + 0.5, row_number + 0.5, f"{excess:.0f}", ha="center", va="center", color=colour)
    pictures.write(figure, path)


def group_of(codec: str) -> str:
    """Return the group that a curve belongs to: the first letters of its name, or its name if no group is known."""
    return next((first for first in (*pictures.CODECS, *BACKGROUND) if codec.startswith(first)), codec)


def style_of(codec: str) -> Style:
    """Return how a curve is drawn: in its group's colour, thin and grey, or in a colour for unknown codecs."""
    group = group_of(codec)
    if group in pictures.CODECS:
        return pictures.CODECS[group]
    return Style(GREY, width=0.8) if group in BACKGROUND else pictures.OTHERS


def _inked(codec: str) -> Style:
    """Return the style of a curve where none stays in the background."""
    return Style(INK) if is_grey(codec) else style_of(codec)


def is_grey(codec: str) -> bool:
    """Return whether a curve stays in the background."""
    return style_of(codec).colour == GREY


def best_of_groups(curves: Mapping[str, list[Any]], merit: Callable[[list[Any]], float]) -> dict[str, list[Any]]:
    """Return the one curve that stands for each group, in colour first: of the group's name, or of the most merit."""
    groups = grouped(curves, group_of)
    ranks = {group: rank for rank, group in enumerate((*pictures.CODECS, "", *BACKGROUND))}
    best = [
        group if group in groups[group] else max(groups[group], key=lambda codec: merit(curves[codec]))
        for group in sorted(groups, key=lambda each: ranks.get(each, ranks[""]))
    ]
    return {codec: curves[codec] for codec in best}


def mean_curves_by_group(table: pl.DataFrame) -> dict[str, list[Any]]:
    """Return a mean curve for each group: the best has the highest mean up to TYPICAL_RATE."""

    def merit(rows: list[Any]) -> float:
        return max((row.mean for row in rows if row.bits_per_sample <= TYPICAL_RATE), default=-math.inf)

    return best_of_groups(by_codec(as_rows(table)), merit)


def main_curves(table: pl.DataFrame) -> dict[str, list[Any]]:
    """Return the mean curves of the groups of MAIN, in their order."""
    curves = {codec: curve for codec, curve in mean_curves_by_group(table).items() if group_of(codec) in MAIN}
    return dict(sorted(curves.items(), key=lambda item: MAIN.index(group_of(item[0]))))


def name(row: Any) -> str:
    """Return the name of a row's codec, and where its figures come from unless measured of a codec here."""
    known = _short(named(row.codec).name)
    return known if row.source == MEASURED else f"{known}, {row.source}"


def _name_and_rate(row: Any) -> str:
    text = _short(named(row.codec).name)
    return text if row.bits_per_sample <= MAX_RATE else f"{text}: {row.bits_per_sample:.1f} bit/sample"


def _distinct_styles(codecs: Iterable[str]) -> dict[str, Style]:
    """Return a style for each codec of a pair, in which no two are alike."""
    found: dict[str, Style] = {}
    for codec in codecs:
        style = style_of(codec)
        taken = style.colour == GREY or style in found.values()
        found[codec] = Style(INK, (0, (5, 1.5))) if taken else style
    return found


def _best_quality(rows: Sequence[Any]) -> float:
    return float(max(row.quality for row in rows))


def _excess(rows: Sequence[Any]) -> float:
    return float(median(row.excess_percent for row in rows))


def _cost(row: Any) -> float:
    return float(max(row.value, TIME_FLOOR_S) if row.cost in TIMES else row.value)


def _short(text: str) -> str:
    """Return a name of at most MAX_NAME characters, that matplotlib takes for nothing but text.

    Its middle is left out: in IEEE P1918.1.1, the end tells the material and speed.
    """
    return _plain(text if len(text) <= MAX_NAME else f"{text[:10]}...{text[13 - MAX_NAME :]}")


def _plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _figure(
    title: str,
    heights_in: Sequence[float],
    right: Iterable[str] = (),
    left: Iterable[str] = (),
    across: int = 1,
    width_in: float = WIDTH_IN,
    top_in: float = 0.0,
    bottom_in: float = BOTTOM_IN,
) -> Figure:
    """Return a figure with a title for panels of these heights, one above the other, with margins for these labels.

    `across`: how many panels are next to each other, each with a right margin.
    """
    right_in, left_in = (
        margin_in + CHARACTER_IN * POINTS * max(map(len, texts), default=0)
        for margin_in, texts in ((RIGHT_IN, right), (LEFT_IN, left))
    )
    top_in += TITLE_IN if title else 0
    height_in = top_in + sum(heights_in) + TOP_IN * len(heights_in) + bottom_in
    figure = Figure(figsize=(width_in, height_in), dpi=DPI)
    panel_in = (width_in - left_in - across * right_in) / across
    figure.subplots_adjust(
        left_in / width_in,
        bottom_in / height_in,
        1 - right_in / width_in,
        1 - (top_in + TOP_IN) / height_in,
        wspace=right_in / panel_in if across > 1 else 0.06,
        hspace=TOP_IN * len(heights_in) / sum(heights_in),
    )
    if title:
        figure.text(
            0.1 / width_in,
            1 - 0.1 / height_in,
            _plain(title),
            va="top",
            color=INK,
            fontsize=POINTS + 1,
            fontweight="bold",
        )
    return figure


def _decorate(axes: Axes) -> None:
    axes.grid(color=PALE)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=FONT_POINTS)
    axes.xaxis.label.set_fontsize(POINTS)
    axes.yaxis.label.set_fontsize(POINTS)


def _set_title(axes: Axes, text: str) -> None:
    axes.set_title(_plain(text), fontsize=FONT_POINTS, loc="left")


def _rate_label(rate_hz: float | None) -> str:
    """Return the label of an axis of bits per sample; `rate_hz`: of all recordings."""
    return "bits per sample" if not rate_hz else f"bits per sample; 1 is {rate_hz / 1000:g} kbit/s at {rate_hz:g} Hz"


def _set_rate_axis(axes: Axes, label: str) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _set_log_axis(axes: Axes, values: Sequence[float], unit: float = 1) -> None:
    """Show these values in a unit, with room for a tick or two where they are all alike."""
    low, high = min(values) / LOG_MARGIN, max(values) * LOG_MARGIN
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(LogLocator(subs=(1,) if high / low > LONG_AXIS else (1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / unit:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _set_quality_axis(axes: Axes, scale: Scale, values: Sequence[float] | None = None) -> None:
    """Show the values given, or what a decoded texture may reach; saturating qualities spread towards 1."""
    axes.set_ylabel(scale.label)
    _decorate(axes)
    if scale in SATURATING:
        low, high = SATURATING[scale]
        if values:
            low, high = max(0.01, 0.8 * min(values)), min(high, 1 - 0.7 * (1 - max(values)))
        axes.set_yscale("logit")
        axes.yaxis.set_major_locator(FixedLocator(SATURATING_TICKS))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    elif values:
        # One codec far off, such as one that loses all, would squeeze the others.
        low = float(np.clip(min(values) - 1, scale.low - FAR_DB, scale.high))
        high = float(np.clip(max(values) + 1, scale.low, scale.high + FAR_DB))
    else:
        low, high = scale.low - BELOW_WINDOW_DB, scale.high + ABOVE_WINDOW_DB
    axes.set_ylim(low, high)


def _within(axes: Axes, quality: ArrayLike) -> NDArray[np.float64]:
    return np.clip(np.asarray(quality, np.float64), *axes.get_ylim())


def _draw_line(
    axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], style: Style, front: bool = False
) -> tuple[float, float]:
    """Draw a line; return where it ends within the panel.

    A single point, an infinite one, or a line outside of the panel is a mark at the nearest place on the edge.
    """
    finite = np.isfinite(y)
    order = 3 if front else 2 if style.colour != GREY else 1
    form: dict[str, Any] = {"color": style.colour, "zorder": order}
    axes.plot(x[finite], y[finite], linestyle=style.dashes, linewidth=style.width, **form)
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    visible = np.flatnonzero((x >= left) & (x <= right) & (y >= low) & (y <= high))
    for index in np.flatnonzero(~finite) if len(visible) > 1 else range(len(x) - 1, len(x)):
        place = np.clip(x[index], left, right), np.clip(y[index], low, high)
        axes.plot(*place, "o", markersize=4, clip_on=False, **form)
    end = visible[-1] if len(visible) else len(x) - 1
    return float(np.clip(x[end], left, right)), float(np.clip(y[end], low, high))


def _label(x: float, y: float, text: str, style: Style, bold: bool = False) -> Label:
    """Return a name in the right margin of a panel, smaller where its curve is grey, for the point (x, y)."""
    points = SMALL_POINTS if style.colour == GREY else POINTS
    form = {"color": style.colour, "fontweight": "bold" if bold else "normal", "fontsize": points}
    arrow = {"color": style.colour, "alpha": 0.4, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 0}
    return Label((x, y), text, form, arrow)


def _write_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Write labels down the right margin, as near to the height of their points as they fit without overlap."""
    width, height = axes.get_window_extent().size
    to_axes = axes.transData + axes.transAxes.inverted()
    targets = {label: float(to_axes.transform(label.point)[1]) for label in labels}
    ordered = sorted(labels, key=lambda label: (targets[label], -label.point[0]))
    heights = [LINE_IN * label.form["fontsize"] * DPI / height for label in ordered]
    write_beside(axes, 1 + LEADER_IN * DPI / width, ordered, [targets[label] for label in ordered], heights)
