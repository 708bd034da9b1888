"""Charts of the tables of evaluation.comparison, to be read in grey print: every line and mark named beside it."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray

from vibrocast.evaluation.bd_rate import SPQI, ST_SIM_2800, ST_SIM_8000, Scale
from vibrocast.evaluation.comparison import FIT, TIMES
from vibrocast.evaluation.labels import spread
from vibrocast.evaluation.points import IMPORTED, MEASURED
from vibrocast.evaluation.tables import as_rows, write_table
from vibrocast.pages import size

WIDTH_IN, DPI = 8.0, 150
FONT_POINTS = 8.5
LABEL_IN, CHARACTER_IN = 0.16, 0.07
"""Height of a line of labels, and width of a character."""
MIN_PANEL_IN = 3.6
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = 0.8, 0.4, 0.3, 0.5
LEADER_IN = 0.25
MAX_NAME = 32

MIN_RATE, MAX_RATE = 0.25, 4.0
TIME_FLOOR_S = 1e-6  # a time axis is logarithmic and has no zero
LOG_MARGIN = 2.0
LONG_AXIS = 300.0  # from its end to its beginning, where ticks at 2 and 5 would touch
SATURATING = {ST_SIM_2800: (0.5, 0.998), ST_SIM_8000: (0.5, 0.998), SPQI: (0.1, 0.995)}
"""Qualities whose axis is spread towards 1, with its limits."""
SATURATING_TICKS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)
BELOW_WINDOW_DB, ABOVE_WINDOW_DB = 5, 15
FAR_DB = 20.0
"""Beyond the window by more: drawn on the edge, and named with its value."""

DASHES: Sequence[Any] = ("-", (0, (5, 2)), (0, (1, 1.3)), (0, (6, 2, 1, 2)), (0, (2.5, 1)), (0, (6, 2, 1, 2, 1, 2)))
MARKERS = ("o", "x", "^")
GREYS = ("black", "0.4", "0.6")
MARK_AREAS = (12.0, 400.0)
MAX_EXCESS_PERCENT = 300.0
FAR_PERCENT = 150.0
MAX_NUMBERED_ROWS = 80
LOGARITHMIC = (*TIMES, "flash_bytes")
COST_LABELS = {
    "encode_s_per_megasample": "encoding, s per million samples",
    "decode_s_per_megasample": "decoding, s per million samples",
    "delay_ms": "algorithmic delay, ms",
    "flash_bytes": "code and model, bytes",
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
        """How many rows are drawn."""
        return len(self.table)

    @property
    def missing(self) -> list[str]:
        """The codecs that have no row."""
        drawn = set(self.table["codec"])
        return [codec for codec in self.expected if codec not in drawn]

    def write(self, folder: Path, plot: Callable[[Path, pl.DataFrame], None]) -> "Chart":
        """Write the rows as CSV, and the chart of them if there are any; return itself. Raises OSError."""
        write_table(folder / f"{self.stem}.csv", self.table)
        image = folder / f"{self.stem}.png"
        if self.rows:
            plot(image, self.table)
        else:
            image.unlink(missing_ok=True)
        return self


@dataclass(frozen=True)
class _Label:
    """Text in the right margin, led to from the point (x, y) of a panel."""

    x: float
    y: float
    row: Any
    text: str
    heavy: bool = False


def plot_quality_against_rate(path: Path, table: pl.DataFrame, scale: Scale, main: Sequence[str]) -> None:
    """Draw mean curves: those measured, and below them those imported, beside the main ones again. Raises OSError.

    The main ones have their spread, the first of them is heavy.
    """
    curves = by_codec(as_rows(table))
    measured = {codec: curve for codec, curve in curves.items() if curve[0].source != IMPORTED}
    imported = {codec: curve for codec, curve in curves.items() if codec in main or codec not in measured}
    groups = [group for group in (measured, imported) if not set(group) <= set(main)] or [curves]
    texts = {codec: _name_and_rate(curve[0]) for codec, curve in curves.items()}
    figure = _figure([max(MIN_PANEL_IN, LABEL_IN * len(group)) for group in groups], texts.values())
    panels = figure.subplots(len(groups), squeeze=False, sharex=True).ravel()
    _set_rate_axis(panels[-1], "bits per sample, all bytes counted")
    panels[-1].set_xlim(MIN_RATE, MAX_RATE)
    for axes, group in zip(panels, groups, strict=True):
        _set_quality_axis(axes, scale)
        labels = []
        for codec, curve in group.items():
            heavy = codec in main[:1]
            dashes = DASHES[list(curves).index(codec) % len(DASHES)]
            bits, mean, low, high = np.transpose([(row.bits_per_sample, row.mean, row.low, row.high) for row in curve])
            if codec in main and group is groups[0]:
                axes.fill_between(bits, _within(axes, low), _within(axes, high), color="black", alpha=0.08, linewidth=0)
            x, y = _draw_line(
                axes,
                bits,
                mean,
                color="0.4" if curve[0].source == IMPORTED else "black",
                linewidth=2.8 if heavy else 1.3,
                linestyle="-" if heavy else dashes,
            )
            labels.append(_Label(x, y, curve[0], texts[codec], heavy))
        _write_labels(axes, labels)
    figure.savefig(path)


def plot_quality_against_ratio(path: Path, table: pl.DataFrame, scales: Sequence[Scale]) -> None:
    """Draw every trace's points and the fit to them, a panel for each quality. Raises OSError."""
    rows = as_rows(table)
    codecs = list(by_codec(rows))
    figure = _figure([MIN_PANEL_IN] * len(scales), [name(row) for row in rows])
    panels = figure.subplots(len(scales), squeeze=False, sharex=True).ravel()
    _set_rate_axis(panels[-1], "compression ratio against 16 bits per sample")
    for axes, scale in zip(panels, scales, strict=True):
        _set_quality_axis(axes, scale)
        if scale in SATURATING:  # a polynomial is no curve on an axis that is spread towards 1
            axes.set(yscale="linear", ylim=(SATURATING[scale][0], 1))
        labels = []
        for codec, points in by_codec(row for row in rows if row.quality == scale.field).items():
            grey, marker, dashes = (forms[codecs.index(codec) % len(forms)] for forms in (GREYS, MARKERS, DASHES))
            ratios, values = np.transpose([(row.compression_ratio, row.value) for row in points if row.trace != FIT])
            axes.scatter(ratios, _within(axes, values), s=9, marker=marker, color=grey, linewidth=0.6, alpha=0.7)
            if fit := [(row.compression_ratio, row.value) for row in points if row.trace == FIT]:
                end = _draw_line(axes, *np.transpose(fit), color=grey, linewidth=2.5, linestyle=dashes)
                labels.append(_Label(*end, points[0], name(points[0])))
        _write_labels(axes, labels)
    figure.savefig(path)


def plot_bd_regions(path: Path, table: pl.DataFrame, scales: Sequence[Scale]) -> None:
    """Draw two codecs' qualities over the rate, a panel for each quality; shaded where BD-rate integrates.

    Raises OSError.
    """
    rows = as_rows(table)
    figure = _figure([MIN_PANEL_IN] * len(scales), [name(row) for row in rows])
    panels = figure.subplots(len(scales), squeeze=False, sharex=True).ravel()
    _set_rate_axis(panels[-1], "bits per sample, all bytes counted")
    panels[-1].set_xlim(MIN_RATE, MAX_RATE)
    for axes, scale in zip(panels, scales, strict=True):
        of_scale = by_codec(row for row in rows if row.quality == scale.field)
        _set_quality_axis(axes, scale)
        labels, edges = [], []
        for codec, grey, marker, dashes in zip(of_scale, GREYS, MARKERS, DASHES, strict=False):
            points, edge = (
                np.transpose([(row.bits_per_sample, row.value) for row in of_scale[codec] if row.in_region == inside])
                for inside in (False, True)
            )
            axes.plot(points[0], _within(axes, points[1]), marker=marker, markersize=4, color=grey, linewidth=0)
            edges.append(edge)
            end = _draw_line(axes, *edge, color=grey, linewidth=1.5, linestyle=dashes)
            labels.append(_Label(*end, of_scale[codec][0], name(of_scale[codec][0])))
        if edges:
            (test, values), (anchor, _) = edges
            axes.fill_betweenx(values, test, anchor, color="0.75", linewidth=0, zorder=1)
            title = f"BD-rate {of_scale[codec][0].percent:+.1f} % at equal {scale.name}, {of_scale[codec][0].trace}"
            axes.set_title(_plain(title), fontsize=FONT_POINTS, loc="left")
        _write_labels(axes, labels)
    figure.savefig(path)


def plot_waveforms(path: Path, table: pl.DataFrame) -> None:
    """Draw a row of panels for each codec, a column for each rate: decoded samples over the original. Raises OSError.

    Columns of the table: `codec`, `source`, `compression_ratio`, `snr_db`, `time_ms`, `original`, `decoded`.
    """
    of_codecs = by_codec(as_rows(table))
    figure = _figure([MIN_PANEL_IN / 2] * len(of_codecs))
    columns = max(len({row.compression_ratio for row in rows}) for rows in of_codecs.values())
    panels = figure.subplots(len(of_codecs), columns, squeeze=False, sharex=True, sharey=True)
    for rows, row_of_panels in zip(of_codecs.values(), panels, strict=True):
        ratios = sorted({row.compression_ratio for row in rows})
        for ratio, axes in zip(ratios, row_of_panels, strict=False):
            at_ratio = [row for row in rows if row.compression_ratio == ratio]
            time_ms, original, decoded = np.transpose([(row.time_ms, row.original, row.decoded) for row in at_ratio])
            axes.plot(time_ms, original, color="0.7", linewidth=3)
            axes.plot(time_ms, decoded, color="black", linewidth=0.9)
            title = f"{name(at_ratio[0])}, ratio {ratio:.3g}: {at_ratio[0].snr_db:.1f} dB"
            axes.set_title(title, fontsize=FONT_POINTS, loc="left")
            axes.set_axisbelow(True)
            axes.grid(color="0.92")
    figure.supxlabel("time, ms; wide and grey: original; thin and black: decoded", fontsize=FONT_POINTS)
    figure.savefig(path)


def plot_cost_points(path: Path, table: pl.DataFrame, scale: Scale) -> None:
    """Draw quality over each cost, a row of panels for each rate, with their Pareto fronts. Raises OSError.

    A mark's area is proportional to the bytes of decoder and model; it is hollow where they are not known, and a
    diamond where the figures are imported.
    """
    rows = as_rows(table)
    rates, costs = sorted({row.bits_per_sample for row in rows}), list(dict.fromkeys(row.cost for row in rows))
    of_rates = [[row for row in rows if row.bits_per_sample == rate] for rate in rates]
    heights = [max(MIN_PANEL_IN / 2, LABEL_IN * len(by_codec(of_rate))) for of_rate in of_rates]
    max_bytes = max((row.flash_bytes or 0 for row in rows), default=0) or 1
    figure = _figure(heights, [_name_and_bytes(row) for row in rows])
    panels = figure.subplots(len(rates), len(costs), squeeze=False, sharex="col", sharey="row", height_ratios=heights)
    for of_rate, panels_of_rate in zip(of_rates, panels, strict=True):
        _set_quality_axis(panels_of_rate[0], scale, [row.quality for row in of_rate])
        for cost, axes in zip(costs, panels_of_rate, strict=True):
            if cost in LOGARITHMIC:
                _set_log_axis(axes, [_cost(row) for row in rows if row.cost == cost])
            axes.grid(axis="x", color="0.92")
            axes.grid(False, axis="y")
            shown = sorted((row for row in of_rate if row.cost == cost), key=lambda row: -(row.flash_bytes or 0))
            for row in shown:
                axes.axhline(_within(axes, row.quality), color="0.85", linewidth=0.6, zorder=0)
                axes.scatter(_cost(row), _within(axes, row.quality), zorder=2, **_mark_style(row, max_bytes))
            front = sorted((_cost(row), row.quality) for row in shown if row.on_front)
            axes.plot(*np.transpose(front or [(math.nan, math.nan)]), color="black", linewidth=1, zorder=1)
    for cost, axes in zip(costs, panels[-1], strict=True):
        axes.set_xlabel(COST_LABELS[cost])
    for rate, of_rate, (first, *_, last) in zip(rates, of_rates, np.repeat(panels, 2, axis=1), strict=True):
        first.set_title(f"at {rate:g} bit/sample", fontsize=FONT_POINTS, loc="left")
        right = last.get_xlim()[1]
        marks = [of_codec[0] for of_codec in by_codec(of_rate).values()]
        low, high = last.get_ylim()
        _write_labels(
            last,
            [
                _Label(
                    right,
                    float(np.clip(row.quality, low, high)),
                    row,
                    _name_and_bytes(row) if low <= row.quality <= high else f"{name(row)}: {row.quality:.0f} (off)",
                )
                for row in marks
            ],
        )
    figure.savefig(path)


def plot_bd_rates(path: Path, table: pl.DataFrame, scales: Sequence[Scale], kinds: Mapping[str, str]) -> None:
    """Draw a line of marks for each codec, a mark for each trace, its form by kind; a bar is the mean. Raises OSError.

    What is beyond FAR_PERCENT stands on the edge.
    """
    rows = as_rows(table)
    codecs = by_codec(rows)
    forms = dict(zip(dict.fromkeys(kinds.get(row.trace, "") for row in rows), cycle(MARKERS), strict=False))
    height_in = 2 * LABEL_IN * len(codecs)
    figure = _figure([height_in], left=[name(of_codec[0]) for of_codec in codecs.values()], bottom_in=0.75)
    panels = figure.subplots(1, len(scales), squeeze=False, sharey=True).ravel()
    for scale, axes in zip(scales, panels, strict=True):
        for place, of_codec in enumerate(codecs.values()):
            own = [row for row in of_codec if row.quality == scale.field]
            for kind, marker in forms.items():
                of_kind = [row.percent for row in own if kinds.get(row.trace, "") == kind]
                places = np.clip(of_kind, -FAR_PERCENT, FAR_PERCENT), [place] * len(of_kind)
                axes.scatter(*places, s=18, marker=marker, color="0.35", facecolor="none" if marker != "x" else None)
            if own:
                mean = np.clip(fmean(row.percent for row in own), -FAR_PERCENT, FAR_PERCENT)
                axes.plot([mean, mean], [place - 0.35, place + 0.35], color="black", linewidth=2)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_title(scale.name, fontsize=FONT_POINTS, loc="left")
        axes.grid(axis="x", color="0.92")
        axes.set_axisbelow(True)
    panels[0].set_yticks(range(len(codecs)), [name(of_codec[0]) for of_codec in codecs.values()])
    panels[0].set_ylim(len(codecs) - 0.5, -0.5)
    words = {"o": "rings", "x": "crosses", "^": "triangles"}
    named = "; ".join(f"{words[marker]}: {kind}" for kind, marker in forms.items() if kind)
    figure.supxlabel("\n".join(filter(None, ("% of bits beyond the anchor's", named))), fontsize=FONT_POINTS)
    figure.savefig(path)


def plot_rate_excesses(path: Path, table: pl.DataFrame) -> None:
    """Draw a map, traces by codecs, of the excess bits; darker is more, hatched has none. Raises OSError.

    Of more than MAX_NUMBERED_ROWS traces only some are named, and no number is written.
    """
    rows = as_rows(table)
    codecs = dict(sorted(by_codec(rows).items(), key=lambda group: median(row.excess_percent for row in group[1])))
    traces = sorted({row.trace for row in rows})
    cells = np.full((len(traces), len(codecs)), np.nan)
    for column, of_codec in enumerate(codecs.values()):
        for row in of_codec:
            cells[traces.index(row.trace), column] = row.excess_percent
    every = math.ceil(len(traces) / MAX_NUMBERED_ROWS)
    codecs_named = [name(of_codec[0]) for of_codec in codecs.values()]
    traces_named = [_short(trace) for trace in traces[::every]]
    height_in = LABEL_IN * min(len(traces), MAX_NUMBERED_ROWS) * 1.25
    figure = _figure([height_in], left=traces_named, top=codecs_named, bottom_in=0.1)
    axes = figure.subplots()
    axes.imshow(np.sqrt(cells), cmap="Greys", vmin=0, vmax=math.sqrt(MAX_EXCESS_PERCENT), aspect="auto")
    axes.patch.set(facecolor="white", edgecolor="0.7", hatch="////")
    axes.set_xticks(range(len(codecs)), codecs_named, rotation=90)
    axes.xaxis.tick_top()
    axes.set_yticks(range(0, len(traces), every), traces_named)
    axes.tick_params(length=0)
    if every == 1:
        for (row_number, column), excess in np.ndenumerate(cells):
            if math.isfinite(excess):
                color = "white" if excess > MAX_EXCESS_PERCENT / 4 else "black"
                text = f"{excess:.0f}"
                axes.text(column, row_number, text, ha="center", va="center", color=color, fontsize=FONT_POINTS)
    figure.savefig(path)


def by_codec(rows: Iterable[Any]) -> dict[str, list[Any]]:
    """Return rows by their codec, in their order."""
    groups: dict[str, list[Any]] = {}
    for row in rows:
        groups.setdefault(row.codec, []).append(row)
    return groups


def name(row: Any) -> str:
    """Return the name of a row's codec, and where its figures come from unless measured of a codec here."""
    return _short(row.codec) if row.source == MEASURED else f"{_short(row.codec)}, {row.source}"


def _name_and_rate(row: Any) -> str:
    return name(row) if row.bits_per_sample <= MAX_RATE else f"{name(row)}: {row.bits_per_sample:.1f} bit/sample"


def _name_and_bytes(row: Any) -> str:
    return name(row) if row.flash_bytes is None else f"{name(row)}, {size(row.flash_bytes)}"


def _cost(row: Any) -> float:
    return float(max(row.value, TIME_FLOOR_S) if row.cost in TIMES else row.value)


def _mark_style(row: Any, max_bytes: int) -> dict[str, Any]:
    imported = row.source == IMPORTED
    least, largest = MARK_AREAS
    return {
        "s": max(least, largest * (row.flash_bytes or 0) / max_bytes),
        "marker": "D" if imported else "o",
        "facecolor": "white" if row.flash_bytes is None else "0.7",
        "edgecolor": "0.5" if imported else "black",
        "linewidth": 0.8,
        "clip_on": False,
    }


def _short(text: str) -> str:
    """Return a name of at most MAX_NAME characters, that matplotlib takes for nothing but text.

    Its middle is left out: of a trace of IEEE P1918.1.1 the end tells the material and speed.
    """
    return _plain(text if len(text) <= MAX_NAME else f"{text[:10]}...{text[13 - MAX_NAME :]}")


def _plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _figure(
    heights_in: Sequence[float],
    right: Iterable[str] = (),
    left: Iterable[str] = (),
    top: Iterable[str] = (),
    bottom_in: float = BOTTOM_IN,
) -> Figure:
    """Return a figure for panels of these heights, one above the other, with margins for these labels."""
    right_in, left_in, top_in = (
        margin_in + CHARACTER_IN * max(map(len, texts), default=0)
        for margin_in, texts in ((RIGHT_IN, right), (LEFT_IN, left), (TOP_IN, top))
    )
    height_in = top_in + sum(heights_in) + TOP_IN * (len(heights_in) - 1) + bottom_in
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    figure.subplots_adjust(
        left_in / WIDTH_IN,
        bottom_in / height_in,
        1 - right_in / WIDTH_IN,
        1 - top_in / height_in,
        wspace=0.05,
        hspace=TOP_IN * len(heights_in) / sum(heights_in),
    )
    return figure


def _set_rate_axis(axes: Axes, label: str) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _set_log_axis(axes: Axes, values: Sequence[float]) -> None:
    """Show these values, with room for a tick or two where they are all alike."""
    low, high = min(values) / LOG_MARGIN, max(values) * LOG_MARGIN
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(LogLocator(subs=(1,) if high / low > LONG_AXIS else (1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _set_quality_axis(axes: Axes, scale: Scale, values: Sequence[float] | None = None) -> None:
    """Show the values given, or what a decoded texture may reach; saturating qualities spread towards 1."""
    axes.set_ylabel(scale.label)
    axes.set_axisbelow(True)
    axes.grid(color="0.92")
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
        axes.axhspan(scale.low, scale.high, color="0.96", zorder=0)
    axes.set_ylim(low, high)


def _within(axes: Axes, quality: ArrayLike) -> NDArray[np.float64]:
    return np.clip(np.asarray(quality, np.float64), *axes.get_ylim())


def _draw_line(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], **style: Any) -> tuple[float, float]:
    """Draw a line; return where it ends within the panel.

    What is one point, infinite or outside of the panel altogether, is a mark, at the nearest place on the edge.
    """
    finite = np.isfinite(y)
    axes.plot(x[finite], y[finite], **style)
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    visible = np.flatnonzero((x >= left) & (x <= right) & (y >= low) & (y <= high))
    for index in np.flatnonzero(~finite) if len(visible) > 1 else range(len(x) - 1, len(x)):
        place = np.clip(x[index], left, right), np.clip(y[index], low, high)
        axes.plot(*place, marker="o", markersize=4, color=style["color"], clip_on=False)
    end = visible[-1] if len(visible) else len(x) - 1
    return float(np.clip(x[end], left, right)), float(np.clip(y[end], low, high))


def _write_labels(axes: Axes, labels: Sequence[_Label]) -> None:
    """Write labels down the right margin, as near to the height of their points as they fit without overlap."""
    width, height = axes.get_window_extent().size
    to_axes = axes.transData + axes.transAxes.inverted()
    wanted = sorted(
        ((float(to_axes.transform((label.x, label.y))[1]), label) for label in labels),
        key=lambda placed: (placed[0], -placed[1].x),
    )
    heights = spread([height for height, _ in wanted], [LABEL_IN * DPI / height] * len(wanted))
    for label_height, (_, label) in zip(heights, wanted, strict=True):
        axes.annotate(
            label.text,
            (label.x, label.y),
            (1 + LEADER_IN * DPI / width, label_height),
            textcoords="axes fraction",
            va="center",
            annotation_clip=False,
            color="0.35" if label.row.source == IMPORTED else "black",
            fontstyle="italic" if label.row.source == IMPORTED else "normal",
            fontweight="bold" if label.heavy else "normal",
            fontsize=FONT_POINTS,
            arrowprops={
                "arrowstyle": "-",
                "color": "0.7",
                "linewidth": 0.5,
                "relpos": (0, 0.5),
                "shrinkA": 1,
                "shrinkB": 0,
            },
        )
