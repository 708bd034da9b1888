"""Charts of the tables of evaluation.comparison: few codecs in colour, others thin and grey, each named in place."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib import rc_context
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
from vibrocast.evaluation.pictures import GREY, INK, POINTS, SMALL_POINTS, Style
from vibrocast.evaluation.points import IMPORTED, MEASURED
from vibrocast.evaluation.tables import by, write_table

WIDTH_IN = 8.0
PANEL_IN = 3.8
AROUND_IN, TITLE_IN = 0.6, 0.3
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
MAX_EXCESS_PERCENT = 300.0
AREA_OF_BYTE = 0.0015
"""Of a mark, in square points."""
MARKED_BYTES = (20_000, 200_000)
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
            pictures.remove(image)
        return self


def plot_comparison(path: Path, table: pl.DataFrame, title: str, rate_hz: float | None) -> None:
    """Draw mean SNR over bits per sample, a curve for each group of MAIN, on linear axes. Raises OSError."""
    texts = {codec: named(codec).name for codec in main_curves(table)}
    with _panels(path, title, [3.3], width_in=7.0) as (_, ((axes,),)):
        axes.set(xlim=(0, MAX_RATE), ylim=(0, 30), xlabel=_rate_label(rate_hz), ylabel="SNR, dB")
        _draw_mean_curves(axes, table.filter(pl.col("mean").is_finite()), texts, _inked)


def plot_quality_against_rate(
    path: Path, table: pl.DataFrame, title: str, scale: Scale, rate_hz: float | None = None
) -> None:
    """Draw the mean curve of each group of codecs, and the spread of the first. Raises OSError."""
    lowest = dict(table.group_by("codec").agg(pl.first("bits_per_sample")).rows())
    texts = {}
    for codec in best_of_groups(table, _TYPICAL_MEAN):
        beyond = f": {lowest[codec]:.1f} bit/sample" if lowest[codec] > MAX_RATE else ""
        texts[codec] = _short(named(codec).name) + beyond
    with _panels(path, title, [PANEL_IN]) as (_, ((axes,),)):
        _set_rate_axis(axes, _rate_label(rate_hz))
        axes.set_xlim(MIN_RATE, MAX_RATE)
        _set_quality_axis(axes, scale)
        codec = next(iter(texts))
        bits, low, high = table.filter(codec=codec).select("bits_per_sample", "low", "high").to_numpy().T
        area = _within(axes, low), _within(axes, high)
        axes.fill_between(bits, *area, color=style_of(codec).colour, alpha=0.12, linewidth=0)
        _draw_mean_curves(axes, table, texts, style_of)


def _draw_mean_curves(
    axes: Axes, table: pl.DataFrame, texts: Mapping[str, str], style_for: Callable[[str], Style]
) -> None:
    """Draw the curves of codecs with their names, the first of them in front."""
    labels: list[Label] = []
    for codec, text in texts.items():
        own = table.filter(codec=codec)
        end = _draw_line(axes, own, "bits_per_sample", "mean", style_for(codec), front=not labels)
        labels.append(_label(*end, text, style_for(codec), bold=not labels))
    write_beside(axes, labels)


def plot_quality_against_ratio(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw every recording's points, joined, and the fit to all, a panel for each quality. Raises OSError."""
    with _panels_of_pair(path, table, title, scales, "compression ratio against 16 bits per sample") as (
        panels,
        styles,
    ):
        for axes, scale in zip(panels, scales, strict=True):
            if scale in SATURATING:  # a polynomial is no curve on an axis that is spread towards 1
                axes.set(yscale="linear", ylim=(SATURATING[scale][0], 1))
            labels = []
            for (codec, trace), own in by(table.filter(quality=scale.field), "codec", "trace"):
                style = styles[codec]
                if trace == FIT:
                    end = _draw_line(axes, own, "compression_ratio", "value", replace(style, width=2.4))
                    labels.append(_label(*end, name(own.row(0, named=True)), style))
                else:
                    ratios, values = own.sort("compression_ratio", maintain_order=True)["compression_ratio", "value"]
                    axes.plot(ratios, _within(axes, values), color=style.colour, linewidth=0.6, alpha=0.5)
            write_beside(axes, labels)


def plot_bd_regions(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw two codecs' qualities over the rate, a panel for each quality; shaded where BD-rate integrates.

    Raises OSError.
    """
    with _panels_of_pair(path, table, title, scales, "bits per sample") as (panels, styles):
        panels[-1].set_xlim(MIN_RATE, MAX_RATE)
        for axes, scale in zip(panels, scales, strict=True):
            of_scale = table.filter(quality=scale.field)
            labels = []
            for (codec,), own in by(of_scale, "codec"):
                measured, edge = own.filter(in_region=False), own.filter(in_region=True)
                places = measured["bits_per_sample"], _within(axes, measured["value"])
                axes.plot(*places, "o", markersize=3.5, color=styles[codec].colour)
                end = _draw_line(axes, edge, "bits_per_sample", "value", styles[codec])
                labels.append(_label(*end, name(own.row(0, named=True)), styles[codec]))
            if labels:
                (_, test), (_, anchor) = by(of_scale.filter(in_region=True), "codec")
                edges = test["value"], test["bits_per_sample"], anchor["bits_per_sample"]
                axes.fill_betweenx(*edges, color=GREY, alpha=0.35, linewidth=0, zorder=1)
                first = test.row(0, named=True)
                axes.set_title(f"{name(first)} {first['percent']:+.1f} % at equal {scale.name}, {first['trace']}")
            write_beside(axes, labels)


@contextmanager
def _panels_of_pair(
    path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale], label: str
) -> Iterator[tuple[Sequence[Axes], Mapping[str, Style]]]:
    """Yield a panel for each quality over the rate, and a style for each of two codecs."""
    with _panels(path, title, [2.3] * len(scales), sharex=True) as (_, rows):
        panels = [axes for (axes,) in rows]
        _set_rate_axis(panels[-1], label)
        for axes, scale in zip(panels, scales, strict=True):
            _set_quality_axis(axes, scale)
        yield panels, _distinct_styles(table["codec"].unique(maintain_order=True))


def plot_waveforms(path: Path, table: pl.DataFrame, title: str = "") -> None:
    """Draw a row of panels for each codec, a column for each rate: decoded samples over the original. Raises OSError.

    Columns of the table: `codec`, `source`, `compression_ratio`, `snr_db`, `time_ms`, `original`, `decoded`.
    """
    of_codecs = list(by(table, "codec"))
    styles = _distinct_styles(codec for (codec,), _ in of_codecs)
    columns = max(own["compression_ratio"].n_unique() for _, own in of_codecs)
    with _panels(path, title, [1.8] * len(of_codecs), columns, sharex=True, sharey=True) as (figure, panels):
        for ((codec,), own), row_of_panels in zip(of_codecs, panels, strict=True):
            ratios = by(own.sort("compression_ratio", maintain_order=True), "compression_ratio")
            for ((ratio,), at_ratio), axes in zip(ratios, row_of_panels, strict=False):
                axes.plot(at_ratio["time_ms"], at_ratio["original"], color="#c4c4c4", linewidth=3)
                axes.plot(at_ratio["time_ms"], at_ratio["decoded"], color=styles[codec].colour, linewidth=0.9)
                first = at_ratio.row(0, named=True)
                axes.set_title(f"{name(first)}, ratio {ratio:.3g}: {first['snr_db']:.1f} dB")
        figure.supxlabel("time, ms; wide and grey: original; thin: decoded", fontsize="medium")


def plot_cost_points(path: Path, table: pl.DataFrame, title: str, scale: Scale) -> None:
    """Draw quality over each cost at the lowest rate, a panel for each cost, with their Pareto fronts. Raises OSError.

    Of grey and of imported codecs, one of each group is drawn; imported ones are hollow. Models are there as the
    controller decodes them.
    """
    table = table.filter(~pl.col("codec").str.ends_with(OTHER_RUNTIME))
    table = table.filter(pl.col("bits_per_sample") == pl.min("bits_per_sample"))
    foremost = best_of_groups(table, pl.max("quality"))
    grey = pl.col("codec").map_elements(is_grey, pl.Boolean)
    table = table.filter(pl.col("codec").is_in(foremost) | ((pl.col("source") != IMPORTED) & ~grey))
    costs = list(by(table, "cost"))
    height_in = max(PANEL_IN, 0.019 * POINTS * table["codec"].n_unique())
    with _panels(path, title, [height_in], len(costs), sharey=True) as (_, (panels,)):
        _set_quality_axis(panels[0], scale, table["quality"])
        low, high = panels[0].get_ylim()
        for ((cost,), shown), axes in zip(costs, panels, strict=True):
            values = shown["value"].clip(TIME_FLOOR_S) if cost in TIMES else shown["value"]
            shown = shown.with_columns(value=values, shown=pl.col("quality").clip(low, high))
            axes.set_xlabel(COST_LABELS[cost])
            if cost in LOGARITHMIC:
                _set_log_axis(axes, values, 1000 if cost == "flash_bytes" else 1)
            front = best_of(shown.filter(pl.col("source") != IMPORTED).select("value", "quality").rows())
            axes.plot(*np.transpose(front or [(math.nan, math.nan)]), color=GREY, linewidth=1, zorder=1)
            labels = []
            for row in shown.iter_rows(named=True):
                style, place = style_of(row["codec"]), (row["value"], row["shown"])
                fill = "white" if row["source"] == IMPORTED else style.colour
                axes.plot(*place, "o", markersize=5, color=style.colour, markerfacecolor=fill, clip_on=False)
                text = _short(named(row["codec"].removesuffix(CORE)).name)
                text += "" if row["shown"] == row["quality"] else f": {row['quality']:.0f} (off)"
                labels.append(_label(*place, text, style, row["codec"] == MAIN[0]))
            write_beside(axes, labels)


def plot_loads(path: Path, table: pl.DataFrame, title: str, scales: Sequence[Scale]) -> None:
    """Draw quality over the load of processors: a row of panels for each quality, one for each `cost` of the rows.

    The area of a mark is `memory_bytes`. No mark lies above the line; dots mark a full processor. Raises OSError.
    """
    costs = table["cost"].unique(maintain_order=True).to_list()
    heights_in = [PANEL_IN * 0.75] * len(scales)
    with _panels(path, title, heights_in, len(costs), sharex="col", sharey="row") as (figure, panels):
        for scale, cost, axes in ((s, c, panels[i][j]) for i, s in enumerate(scales) for j, c in enumerate(costs)):
            of_scale = table.filter(quality=scale.field)
            shown = of_scale.filter(cost=cost)
            _set_quality_axis(axes, scale, of_scale["value"])
            _set_log_axis(axes, table.filter(cost=cost)["load_percent"])
            if cost != costs[0]:
                axes.set_ylabel("")
            if scale == scales[-1]:
                axes.set_xlabel(cost)
            axes.axvline(100, color=INK, linewidth=0.8, linestyle=":")
            front = best_of(shown.select("load_percent", "value").rows())
            (first, _), (_, best) = front[0], front[-1]
            edges = [(first, axes.get_ylim()[0]), *front, (axes.get_xlim()[1], best)]
            axes.step(*np.transpose(edges), where="post", color=GREY, linewidth=1, zorder=1)
            labels = []
            for row in shown.iter_rows(named=True):
                style, place = _inked(row["codec"]), (row["load_percent"], row["value"])
                axes.scatter(*place, row["memory_bytes"] * AREA_OF_BYTE, color=style.colour, alpha=0.6, linewidth=0)
                labels.append(_label(*place, _short(row["codec"]), style, row["codec"] == MAIN[0]))
            write_beside(axes, labels)
        marks = [
            panels[0][0].scatter([], [], size * AREA_OF_BYTE, color=GREY, label=f"{size // 1000} kB")
            for size in MARKED_BYTES
        ]
        figure.legend(
            handles=marks, loc="outside lower left", ncols=2, frameon=False, title="area: code, model and RAM"
        )


def plot_rate_excesses(path: Path, table: pl.DataFrame, title: str) -> None:
    """Draw a map, recordings by a codec of each group, of the excess bits; darker is more, hatched has none.

    Of more than MAX_NUMBERED_ROWS recordings only some are named, and no number is written. Raises OSError.
    """
    medians = table.group_by("codec").agg(pl.median("excess_percent")).sort("excess_percent", "codec")
    foremost = best_of_groups(table, -pl.median("excess_percent"))
    codecs = [codec for codec in medians["codec"] if codec in foremost]
    cells = table.pivot("codec", index="trace", values="excess_percent").sort("trace").select("trace", *codecs)
    traces, excesses = cells["trace"].to_list(), cells.drop("trace").to_numpy().astype(np.float64)
    every = math.ceil(len(traces) / MAX_NUMBERED_ROWS)
    with _panels(path, title, [0.21 * min(len(traces), MAX_NUMBERED_ROWS) + 0.5]) as (_, ((axes,),)):
        shades = LinearSegmentedColormap.from_list("excess", ["white", pictures.BLUE])
        axes.pcolormesh(np.sqrt(excesses), cmap=shades, vmin=0, vmax=math.sqrt(MAX_EXCESS_PERCENT), edgecolors="white")
        axes.patch.set(facecolor="white", edgecolor=GREY, hatch="////")
        axes.invert_yaxis()
        places = np.arange(len(codecs)) + 0.5
        axes.set_xticks(places, [_short(named(codec).name) for codec in codecs], rotation=35, ha="left")
        axes.xaxis.tick_top()
        axes.set_yticks(np.arange(0, len(traces), every) + 0.5, map(_short, traces[::every]))
        axes.grid(visible=False)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        for (row, column), excess in np.ndenumerate(excesses) if every == 1 else ():
            if math.isfinite(excess):
                colour = "white" if excess > MAX_EXCESS_PERCENT / 2.5 else INK
                axes.text(column + 0.5, row + 0.5, f"{excess:.0f}", ha="center", va="center", color=colour)


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


def best_of_groups(table: pl.DataFrame, merit: pl.Expr) -> list[str]:
    """Return the one codec that stands for each group, in colour first: of the group's name, or of the most merit."""
    merits = table.group_by("codec", maintain_order=True).agg(merit=merit.fill_null(-math.inf))
    best = {group_of(codec): codec for codec in merits["codec"]}
    for codec in merits.reverse().sort("merit", maintain_order=True)["codec"]:
        best[group_of(codec)] = codec
    best.update({group: group for group in best if group in merits["codec"]})
    ranks = {group: rank for rank, group in enumerate((*pictures.CODECS, "", *BACKGROUND))}
    return [best[group] for group in sorted(best, key=lambda each: ranks.get(each, ranks[""]))]


_TYPICAL_MEAN = pl.col("mean").filter(pl.col("bits_per_sample") <= TYPICAL_RATE).max()
"""The merit of a mean curve: the highest mean up to TYPICAL_RATE."""


def main_curves(table: pl.DataFrame) -> list[str]:
    """Return the codecs whose mean curves stand for the groups of MAIN, in their order."""
    curves = [codec for codec in best_of_groups(table, _TYPICAL_MEAN) if group_of(codec) in MAIN]
    return sorted(curves, key=lambda codec: MAIN.index(group_of(codec)))


def name(row: Mapping[str, Any]) -> str:
    """Return the name of a row's codec, and where its figures come from unless measured of a codec here."""
    known = _short(named(row["codec"]).name)
    return known if row["source"] == MEASURED else f"{known}, {row['source']}"


def _distinct_styles(codecs: Iterable[str]) -> dict[str, Style]:
    """Return a style for each codec of a pair, in which no two are alike."""
    found: dict[str, Style] = {}
    for codec in codecs:
        style = style_of(codec)
        taken = style.colour == GREY or style in found.values()
        found[codec] = Style(INK, (0, (5, 1.5))) if taken else style
    return found


def _short(text: str) -> str:
    """Return a name of at most MAX_NAME characters.

    Its middle is left out: in IEEE P1918.1.1, the end tells the material and speed.
    """
    return text if len(text) <= MAX_NAME else f"{text[:10]}...{text[13 - MAX_NAME :]}"


@contextmanager
def _panels(
    path: Path, title: str, heights_in: Sequence[float], across: int = 1, width_in: float = WIDTH_IN, **shared: Any
) -> Iterator[tuple[Figure, Any]]:
    """Yield a figure and its panels, rows of these heights and `across` next to each other; write it at the end.

    `shared`: which axes are shared, as `Figure.subplots` takes it.
    """
    height_in = sum(heights_in) + AROUND_IN + (TITLE_IN if title else 0)
    with rc_context(pictures.AXES), pictures.figure_file(path, width_in, height_in) as figure:
        if title:
            figure.suptitle(title, x=0.01, ha="left", color=INK, fontsize=POINTS + 1, fontweight="bold")
        yield figure, figure.subplots(len(heights_in), across, squeeze=False, **shared)


def _rate_label(rate_hz: float | None) -> str:
    """Return the label of an axis of bits per sample; `rate_hz`: of all recordings."""
    return "bits per sample" if not rate_hz else f"bits per sample; 1 is {rate_hz / 1000:g} kbit/s at {rate_hz:g} Hz"


def _set_rate_axis(axes: Axes, label: str) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _set_log_axis(axes: Axes, values: Iterable[float], unit: float = 1) -> None:
    """Show these values in a unit, with room for a tick or two where they are all alike."""
    values = list(values)
    low, high = min(values) / LOG_MARGIN, max(values) * LOG_MARGIN
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(LogLocator(subs=(1,) if high / low > LONG_AXIS else (1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / unit:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _set_quality_axis(axes: Axes, scale: Scale, values: Iterable[float] = ()) -> None:
    """Show the values given, or what a decoded texture may reach; saturating qualities spread towards 1."""
    axes.set_ylabel(scale.label)
    values = list(values)
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
    axes: Axes, table: pl.DataFrame, across: str, upwards: str, style: Style, front: bool = False
) -> tuple[float, float]:
    """Draw a line of two columns; return where it ends within the panel.

    A single point, an infinite one, or a line outside of the panel is a mark at the nearest place on the edge.
    """
    x, y = table.select(across, upwards).to_numpy().T
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
    """Return a name for the point (x, y), smaller where its curve is grey."""
    return Label(x, y, text, style.colour, SMALL_POINTS if style.colour == GREY else POINTS, bold)
