"""Charts of studies.rate_control, to be read in grey print: every line and mark named beside it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vibrocast.evaluation.charts import DASHES, DPI, FONT_POINTS, WIDTH_IN
from vibrocast.evaluation.labels import spread

_ROW_IN = 0.2
_PANEL_IN = 2.6
_LIMIT_PERCENT = 1.0


@dataclass(frozen=True)
class Held:
    """One recording coded at a constant rate, of each channel and with frames.

    `rate_buffer_s`: the rate buffer's size. `rejected`: why the codec cannot, and then nothing else.
    `furthest_percent`: by how much the run of packets of 2 s that is furthest from the rate differs. `snr_...`: of
    packets.
    """

    recording: str
    codec: str
    bits_per_second: int
    rate_buffer_s: float
    packet_ms: float = 0.0
    sent_bps: float = 0.0
    packets_bps: float = 0.0
    furthest_percent: float | None = None
    padding_percent: float = 0.0
    snr_db: float = 0.0
    snr_deviation_db: float = 0.0
    snr_low_db: float = 0.0
    snr_high_db: float = 0.0
    rejected: str = ""


@dataclass(frozen=True)
class RefreshCost:
    """Mean SNR over recordings at a rate with a refresh every so many seconds."""

    bits_per_second: int
    refresh_s: float
    snr_db: float


def plot_recordings(path: Path, rows: Sequence[Held]) -> None:
    """Draw the SNR's mean and range of each recording, a panel for each rate, the deviation beside. Raises OSError."""
    names = sorted({row.recording for row in rows}, reverse=True)
    rates = sorted({row.bits_per_second for row in rows})
    figure = _figure(0.8 + len(names) * _ROW_IN)
    panels = figure.subplots(1, len(rates), squeeze=False, sharey=True)[0]
    for axes, rate in zip(panels, rates, strict=True):
        for row in (row for row in rows if row.bits_per_second == rate):
            height = names.index(row.recording)
            axes.plot((row.snr_low_db, row.snr_high_db), (height, height), color="black", linewidth=1)
            axes.plot(row.snr_db, height, "o", color="black", markersize=4)
            if row.furthest_percent is not None:
                axes.annotate(
                    f"{row.furthest_percent:+.1f} %",
                    (1, height),
                    xycoords=("axes fraction", "data"),
                    ha="right",
                    va="center",
                    fontsize=FONT_POINTS - 1.5,
                )
        axes.set_title(f"{rate} bit/s", fontsize=FONT_POINTS)
        axes.set_xlabel("SNR, dB", fontsize=FONT_POINTS)
        axes.tick_params(labelsize=FONT_POINTS - 1)
        low, high = axes.get_xlim()
        axes.set_xlim(low, high + 0.5 * (high - low))  # room for the numbers
        axes.grid(axis="y", color="0.9", linewidth=0.5)
    panels[0].set_yticks(range(len(names)), names)
    figure.savefig(path, bbox_inches="tight")


def plot_codecs(path: Path, rows: Sequence[Held]) -> None:
    """Draw worst deviation, mean SNR and its mean deviation over the rates, a line for each codec. Raises OSError."""
    recordings = len({row.recording for row in rows})
    panels: Sequence[tuple[str, Callable[[Sequence[Held]], float]]] = (
        ("worst over 2 s, %", lambda some: max(abs(row.furthest_percent or 0.0) for row in some)),
        ("mean SNR, dB", lambda some: fmean(row.snr_db for row in some)),
        ("deviation of SNR, dB", lambda some: fmean(row.snr_deviation_db for row in some)),
    )
    figure = _figure(len(panels) * _PANEL_IN)
    all_axes = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, value) in zip(all_axes, panels, strict=True):
        lines = {}
        for name in dict.fromkeys(row.codec for row in rows):
            of_rate = {
                rate: [row for row in rows if (row.codec, row.bits_per_second) == (name, rate)]
                for rate in sorted({row.bits_per_second for row in rows})
            }
            lines[name] = [(rate, value(some)) for rate, some in of_rate.items() if len(some) == recordings]
        _draw(axes, lines)
        axes.set_ylabel(label, fontsize=FONT_POINTS)
    all_axes[0].axhline(_LIMIT_PERCENT, color="0.6", linewidth=0.8)
    all_axes[0].set_ylim(0, 1.2 * _LIMIT_PERCENT)
    all_axes[-1].set_xlabel("bit/s, frames included", fontsize=FONT_POINTS)
    figure.savefig(path, bbox_inches="tight")


def plot_rate_buffers(path: Path, rows: Sequence[Held]) -> None:
    """Draw mean deviations of SNR and rate over the rate buffer's size, a line for each rate. Raises OSError."""
    panels: Sequence[tuple[str, Callable[[Held], float]]] = (
        ("deviation of SNR, dB", lambda row: row.snr_deviation_db),
        ("worst over 2 s, %", lambda row: abs(row.furthest_percent or 0.0)),
    )
    figure = _figure(len(panels) * _PANEL_IN)
    all_axes = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, value) in zip(all_axes, panels, strict=True):
        lines = {
            f"{rate} bit/s": [
                (
                    rate_buffer_s,
                    fmean(
                        value(row) for row in rows if (row.bits_per_second, row.rate_buffer_s) == (rate, rate_buffer_s)
                    ),
                )
                for rate_buffer_s in sorted({row.rate_buffer_s for row in rows})
            ]
            for rate in sorted({row.bits_per_second for row in rows})
        }
        _draw(axes, lines)
        axes.set_ylabel(label, fontsize=FONT_POINTS)
        axes.set_ylim(bottom=0)
    all_axes[-1].set_xlabel("rate buffer, s", fontsize=FONT_POINTS)
    figure.savefig(path, bbox_inches="tight")


def _figure(height_in: float) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def _draw(axes: Axes, lines: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Draw lines over a logarithmic axis with ticks at their points, each named at its end."""
    drawn = {name: points for name, points in lines.items() if points}
    for index, points in enumerate(drawn.values()):
        axes.plot(
            *zip(*points, strict=True), color="black", linewidth=1.2, linestyle=DASHES[index], marker="o", markersize=3
        )
    ticks = sorted({x for points in drawn.values() for x, _ in points})
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.tick_params(labelsize=FONT_POINTS - 1)
    low, high = axes.get_ylim()
    ends = sorted(drawn.items(), key=lambda line: line[1][-1][1])
    heights = spread([(points[-1][1] - low) / (high - low) for _, points in ends], [0.08] * len(ends))
    for height, (name, points) in zip(heights, ends, strict=True):
        axes.annotate(
            name,
            points[-1],
            (1.04, float(height)),
            textcoords="axes fraction",
            va="center",
            fontsize=FONT_POINTS,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.5, "relpos": (0, 0.5)},
        )
