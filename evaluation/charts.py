"""Charts of rate against SNR that can be read in grey: lines named where they end, one heavy line for our codec."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from evaluation.bd_rate import WINDOW_DB, bits_per_sample_at, monotone_envelope
from evaluation.points import Point

Curves = Mapping[str, Mapping[str, Sequence[Point]]]

PEER_DASHES = ("-", "--", "-.", ":", (0, (6, 2, 1, 2, 1, 2)), (0, (1, 3)), (0, (8, 3)))
MAX_BITS_PER_SAMPLE = 5.0
LABEL_DISTANCE_DB = 0.9
COLUMNS = 4


def plot_mean(path: Path, curves: Curves, codec_name: str) -> None:
    """Draw SNR over bits per sample, averaged over the traces at equal SNR, where a codec has a value for every trace.

    `curves`: points by codec and trace. Raises OSError when the file cannot be written.
    """
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    grid_db = np.arange(2.0, 22.01, 0.25)
    traces = curves[codec_name]
    ends: list[tuple[float, float, str]] = []
    peers = [name for name in curves if name != codec_name and set(traces) <= set(curves[name])]
    for index, name in enumerate([codec_name, *peers]):
        bits = np.mean([bits_per_sample_at(curves[name][trace], grid_db) for trace in traces], axis=0)
        shown = bits <= MAX_BITS_PER_SAMPLE
        if shown.any():
            ours = name == codec_name
            dashes = "-" if ours else PEER_DASHES[index % len(PEER_DASHES)]
            axes.plot(
                bits[shown],
                grid_db[shown],
                color="black" if ours else "0.4",
                linewidth=3 if ours else 1.2,
                linestyle=dashes,
            )
            ends.append((grid_db[shown][-1], bits[shown][-1], name))
    # Labels of lines that end close together are moved apart, downwards from the highest and leftmost.
    label_db = np.inf
    for snr_db, bits_per_sample, name in sorted(ends, key=lambda end: (-end[0], end[1])):
        label_db = min(snr_db, label_db - LABEL_DISTANCE_DB)
        axes.annotate(
            name,
            (bits_per_sample, snr_db),
            (MAX_BITS_PER_SAMPLE + 0.15, label_db),
            va="center",
            fontsize=9,
            fontweight="bold" if name == codec_name else "normal",
            arrowprops={"arrowstyle": "-", "color": "0.75", "linewidth": 0.6, "relpos": (0, 0.5)},
        )
    axes.axhspan(*WINDOW_DB, color="0.95", zorder=0)
    axes.set(
        xlabel="bits per sample, all bytes counted",
        ylabel="SNR, dB",
        title=f"Mean over {len(traces)} traces (shaded: the window of BD-rate)",
        xlim=(0, MAX_BITS_PER_SAMPLE + 1.8),
        ylim=(grid_db[0], grid_db[-1] + 0.5),
    )
    axes.set_xticks(np.arange(0, MAX_BITS_PER_SAMPLE + 1))
    axes.grid(color="0.9")
    figure.savefig(path, dpi=120)


def plot_traces(path: Path, curves: Curves, codec_name: str) -> None:
    """Draw one small chart for each trace: our codec in black over the peers in grey. Raises OSError."""
    traces = sorted(curves[codec_name])
    rows = -(-len(traces) // COLUMNS)
    figure = Figure(figsize=(3 * COLUMNS, 2.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
    for trace, axes in zip(traces, panels, strict=False):
        for name in sorted(curves, key=lambda name: name == codec_name):
            envelope = monotone_envelope(curves[name].get(trace, []))
            bits = [point.bits_per_sample for point in envelope]
            ours = name == codec_name
            style = {"color": "black", "linewidth": 2.5} if ours else {"color": "0.6", "linewidth": 0.8}
            axes.plot(bits, [point.snr_db for point in envelope], **style)
        axes.set_title(trace, fontsize=9)
        axes.set(xlim=(0, MAX_BITS_PER_SAMPLE), ylim=(0, 26))
        axes.grid(color="0.9")
    for axes in panels[len(traces) :]:
        axes.set_visible(False)
    figure.supxlabel("bits per sample, all bytes counted")
    figure.supylabel("SNR, dB")
    figure.suptitle(f"Each trace: {codec_name} black, peers grey")
    figure.savefig(path, dpi=110)
