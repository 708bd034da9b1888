"""Charts of studies.rate_control, readable in grey print: each line and mark has its name next to it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TypeVar

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vibrocast.evaluation.charts import DPI, FONT_POINTS, WIDTH_IN
from vibrocast.evaluation.curves import Curve, Panel, curves

_ROW_IN = 0.2
_LIMIT_PERCENT = 1.0

Key = TypeVar("Key")


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
    """Mean SNR over recordings at a rate with a refresh every `refresh_s` seconds."""

    bits_per_second: int
    refresh_s: float
    snr_db: float


def plot_recordings(path: Path, rows: Sequence[Held]) -> None:
    """Draw the SNR's mean and range of each recording, a panel for each rate, with the deviation. Raises OSError."""
    names = sorted({row.recording for row in rows}, reverse=True)
    rates = sorted({row.bits_per_second for row in rows})
    figure = Figure(figsize=(WIDTH_IN, 0.8 + len(names) * _ROW_IN), dpi=DPI)
    FigureCanvasAgg(figure)
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
    panels: Mapping[str, Callable[[Sequence[Held]], float]] = {
        "worst over 2 s, %": lambda some: max(abs(row.furthest_percent or 0.0) for row in some),
        "mean SNR, dB": lambda some: fmean(row.snr_db for row in some),
        "deviation of SNR, dB": lambda some: fmean(row.snr_deviation_db for row in some),
    }
    codecs = _grouped(rows, lambda row: row.codec)
    whole = {
        codec: {
            rate: some
            for rate, some in _grouped(own, lambda row: float(row.bits_per_second)).items()
            if len(some) == recordings
        }
        for codec, own in codecs.items()
    }
    _plot(path, whole, panels, "bit/s, frames included", (_LIMIT_PERCENT,))


def plot_rate_buffers(path: Path, rows: Sequence[Held]) -> None:
    """Draw mean deviations of SNR and rate over the rate buffer's size, a line for each rate. Raises OSError."""
    panels: Mapping[str, Callable[[Sequence[Held]], float]] = {
        "deviation of SNR, dB": lambda some: fmean(row.snr_deviation_db for row in some),
        "worst over 2 s, %": lambda some: fmean(abs(row.furthest_percent or 0.0) for row in some),
    }
    rates = _grouped(sorted(rows, key=lambda row: row.bits_per_second), lambda row: row.bits_per_second)
    lines = {f"{rate} bit/s": _grouped(own, lambda row: row.rate_buffer_s) for rate, own in rates.items()}
    _plot(path, lines, panels, "rate buffer, s")


def _plot(
    path: Path,
    lines: Mapping[str, Mapping[float, Sequence[Held]]],
    values: Mapping[str, Callable[[Sequence[Held]], float]],
    x_label: str,
    levels: Sequence[float] = (),
) -> None:
    """Draw a panel for each of the values, with a line over the groups of rows. `levels`: of the first."""
    panels = [
        Panel(
            title,
            x_label,
            "",
            [Curve(name, sorted(line), [value(line[x]) for x in sorted(line)]) for name, line in lines.items() if line],
            log_x=True,
            lines=levels if not place else (),
        )
        for place, (title, value) in enumerate(values.items())
    ]
    curves(path, panels, across=1)


def _grouped(rows: Iterable[Held], key: Callable[[Held], Key]) -> dict[Key, list[Held]]:
    groups: dict[Key, list[Held]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups
