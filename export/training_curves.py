"""The curves of a training, stored next to its model: a table and a picture of the same numbers."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

CSV, PICTURE = "curves.csv", "curves.png"


def files(curves: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """Return the table and the picture of all validations of a training, by file name.

    `curves`: the records of a checkpoint, see export.training.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, curves[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(curves)
    return {CSV: table.getvalue().encode(), PICTURE: _picture(curves)}


def _picture(curves: Sequence[Mapping[str, Any]]) -> bytes:
    """Return a PNG: losses over steps, and next to them rate and SNR of the held-back materials."""
    figure = Figure(figsize=(8, 2.8), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    steps = [record["step"] for record in curves]

    def line(name: str) -> list[float]:
        return [record[name] for record in curves]

    left.plot(steps, line("training_loss"), color="0.6", label="training")
    left.plot(steps, line("loss"), color="black", label="held-back materials")
    left.set(xlabel="step", ylabel="loss", yscale="log")
    left.legend(frameon=False, fontsize=8)
    right.plot(line("bits_per_sample"), line("snr_db"), color="0.6", marker=".")
    right.annotate(f"step {steps[-1]}", (curves[-1]["bits_per_sample"], curves[-1]["snr_db"]), fontsize=8)
    right.set(xlabel="bit/sample of held-back materials", ylabel="SNR, dB")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    stored = io.BytesIO()
    figure.savefig(stored, format="png")
    return stored.getvalue()
