"""Draws what was recorded, what was decoded and what the skin gets, over time and against the detection threshold."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.threshold import read_threshold
from vibrocast.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

CHANNELS_SHOWN = 4
ZOOM_S = 0.06
# Pixels across one time axis: a longer trace is drawn as the band between its extremes in each pixel.
COLUMNS = 1200
MIN_HZ = 10.0
# Levels below this are silence for the skin at every frequency.
FLOOR_DB = -60.0
# Distinct in grey print: by lightness from the first to the last, and by dashes.
STYLES: tuple[dict[str, object], ...] = (
    {"color": "#f0a030", "linestyle": "-", "linewidth": 2.6},
    {"color": "#2a7fb8", "linestyle": (0, (5, 2)), "linewidth": 1.6},
    {"color": "#20123a", "linestyle": "-", "linewidth": 1.1},
)
THRESHOLD_STYLE: dict[str, object] = {"color": "#707070", "linestyle": ":", "linewidth": 1.4}


@dataclass(frozen=True)
class Trace:
    """A named signal to draw: float64 values (n, channels) in `unit`, and what it does to the skin where that is known.

    `displacement_um`: float64 (m, channels) at `displacement_rate_hz`, the displacement the signal asks for or makes.
    """

    name: str
    values: NDArray[np.float64]
    rate_hz: float
    unit: str
    displacement_um: NDArray[np.float64]
    displacement_rate_hz: float


def draw(path: Path, title: str, caption: str, traces: Sequence[Trace]) -> None:
    """Write a picture (format by suffix) of up to three traces of equal channel count, the first drawn lightest.

    Raises OSError when the file cannot be written and ValueError for a suffix that matplotlib does not know.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    channels = traces[0].values.shape[1]
    shown = min(channels, CHANNELS_SHOWN)
    figure = Figure(figsize=(13, 5.2 * shown + 0.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    if shown < channels:
        title += f" (the first {shown} of {channels} channels)"
    figure.suptitle(title, fontweight="bold", parse_math=False)
    figure.supxlabel(caption, fontsize="small", parse_math=False)
    blocks = np.atleast_1d(np.asarray(figure.subfigures(shown, 1), dtype=object))
    threshold = read_threshold()
    for channel, block in enumerate(blocks):
        if channels > 1:
            block.suptitle(f"channel {channel + 1}", x=0.02, horizontalalignment="left")
        _draw_channel(block, traces, channel, threshold)
    with atomic_write(path) as partial, warnings.catch_warnings():
        # Boxes stand for the letters of a file's name that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        figure.savefig(partial)


def third_octave_levels(values: NDArray[np.float64], rate_hz: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies in Hz and the level of the third octave around each: of a sine of that power, dB re 1 peak.

    The band (IEC 61260: edges at 2^(+-1/6) of the centre) makes noise and tones comparable with a threshold for sines,
    whatever the length of the recording. `values` is float64 (n,); bands narrower than the resolution are left out.
    """
    samples = len(values)
    power = 2 * np.abs(np.fft.rfft(values)) ** 2 / samples**2
    cumulative = np.concatenate([[0.0], np.cumsum(power[1:])])
    # Bin k holds the power between (k - 1/2) and (k + 1/2) bins; bin 0, the mean, is not felt.
    edges_hz = (np.arange(len(cumulative)) + 0.5) * rate_hz / samples
    lowest_hz = max(MIN_HZ, 4.5 * rate_hz / samples)
    highest_hz = rate_hz / 2 / 2 ** (1 / 6)
    if lowest_hz >= highest_hz:
        return np.empty(0), np.empty(0)
    centres_hz = np.geomspace(lowest_hz, highest_hz, max(2, int(12 * np.log2(highest_hz / lowest_hz))))
    band = np.interp(centres_hz * 2 ** (1 / 6), edges_hz, cumulative)
    band -= np.interp(centres_hz / 2 ** (1 / 6), edges_hz, cumulative)
    return centres_hz, 10 * np.log10(np.maximum(2 * band, 1e-30))


def _draw_channel(
    block: "Figure | SubFigure", traces: Sequence[Trace], channel: int, threshold: NDArray[np.float64]
) -> None:
    grid = block.add_gridspec(len(traces), 3, width_ratios=(1.15, 1, 1.25))
    last = traces[-1]
    centre_s = (int(np.argmax(np.abs(last.values[:, channel]))) + 0.5) / last.rate_hz
    duration_s = max(len(trace.values) / trace.rate_hz for trace in traces)
    zoom_start_s = min(max(centre_s - ZOOM_S / 2, 0.0), max(duration_s - ZOOM_S, 0.0))
    windows = ((0.0, duration_s), (zoom_start_s, min(zoom_start_s + ZOOM_S, duration_s)))
    for column, window in enumerate(windows):
        for row, trace in enumerate(traces):
            axes = block.add_subplot(grid[row, column])
            before = traces[row - 1]
            if column == 1 and row > 0 and before.unit == trace.unit:
                _draw_trace(axes, before, channel, window, {**STYLES[row - 1], "linewidth": 3.0})
                axes.set_title(f"over the {before.name}", fontsize="medium", loc="left")
            _draw_trace(axes, trace, channel, window, {**STYLES[row], "linewidth": 1.1})
            if row < len(traces) - 1:
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("time, s" if column == 0 else "time, s (around the strongest moment)")
            if column == 0:
                axes.set_ylabel(trace.unit)
                axes.set_title(trace.name, fontsize="medium", loc="left")
                if duration_s > 2 * ZOOM_S:
                    axes.axvspan(*windows[1], color="#d8d8d8", zorder=0)
    _draw_spectra(block.add_subplot(grid[:, 2]), traces, channel, threshold)


def _draw_trace(
    axes: "Axes", trace: Trace, channel: int, window_s: tuple[float, float], style: dict[str, object]
) -> None:
    first, last = (int(np.floor(edge_s * trace.rate_hz)) for edge_s in window_s)
    values = trace.values[first : last + 1, channel]
    time_s = (first + np.arange(len(values))) / trace.rate_hz
    if len(values) > 2 * COLUMNS:
        bounds = np.linspace(0, len(values), COLUMNS, endpoint=False).astype(int)
        low, high = np.minimum.reduceat(values, bounds), np.maximum.reduceat(values, bounds)
        axes.fill_between(time_s[bounds], low, high, color=style["color"], linewidth=0.4)
    else:
        marker = "o" if len(values) == 1 else None
        axes.plot(time_s, values, color=style["color"], linewidth=style["linewidth"], marker=marker)
    axes.set_xlim(window_s)
    extent = float(np.max(np.abs(values), initial=0.0))
    if extent == 0.0:
        axes.set_ylim(-1, 1)
        axes.text(0.5, 0.6, "silent", transform=axes.transAxes, horizontalalignment="center")
    axes.grid(alpha=0.3)


def _draw_spectra(axes: "Axes", traces: Sequence[Trace], channel: int, threshold: NDArray[np.float64]) -> None:
    curves = [
        (trace.name, style, *third_octave_levels(trace.displacement_um[:, channel], trace.displacement_rate_hz))
        for trace, style in zip(traces, STYLES, strict=False)
    ]
    curves.append(("detection threshold", THRESHOLD_STYLE, threshold[:, 0], threshold[:, 1]))
    # The first trace has the stream's rate: the skin's spectrum above it holds nothing but images.
    highest_hz = max(float(frequencies[-1]) for frequencies in (curves[0][2], threshold[:, 0]) if len(frequencies))
    top_db = max(float(np.max(levels)) for _, _, _, levels in curves if len(levels)) + 20
    for index, (name, style, frequencies, levels) in enumerate(curves):
        felt = (levels > FLOOR_DB) & (frequencies <= highest_hz)
        if not felt.any():
            reason = "silent" if len(levels) else "too short for a spectrum"
            axes.text(0.03, 0.03 + 0.04 * index, f"{name}: {reason}", transform=axes.transAxes, color=style["color"])
            continue
        axes.plot(frequencies, np.where(felt, levels, np.nan), **style)  # type: ignore[arg-type]
        # Labels stand in a row above the curves, each with a line down to its own, where no two can collide.
        label_hz = MIN_HZ * (highest_hz / MIN_HZ) ** (0.88 - 0.26 * index)
        nearest = int(np.argmin(np.where(felt, np.abs(np.log(frequencies / label_hz)), np.inf)))
        axes.annotate(
            name.replace(" ", "\n", 1),
            xy=(float(frequencies[nearest]), float(levels[nearest])),
            xytext=(label_hz, top_db - 2),
            color=style["color"],
            fontweight="bold",
            horizontalalignment="center",
            verticalalignment="top",
            arrowprops={"arrowstyle": "-", "color": style["color"], "linewidth": 0.7},
        )
    axes.set_xscale("log")
    axes.set_xlim(MIN_HZ, highest_hz)
    axes.set_ylim(FLOOR_DB, top_db)
    ticks = [tick for tick in (10, 20, 50, 100, 200, 500, 1000, 2000, 5000) if tick <= highest_hz]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("displacement in a third octave, dB re 1 um peak")
    axes.yaxis.set_label_position("right")
    axes.yaxis.tick_right()
    axes.set_title("spectra, as displacement", fontsize="medium", loc="left")
    axes.grid(alpha=0.3)
