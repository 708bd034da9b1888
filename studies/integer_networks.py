"""Compares integer networks with ONNX graphs: `python -m studies.integer_networks FOLDER --out docs/benchmarks`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl

from studies import page
from vibrocast import codec, models, textures
from vibrocast.codec import eva
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.eva_image import EvaImage
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.tables import as_rows, frame
from vibrocast.models import Model
from vibrocast.textures import dataset

LIMIT_DB, LIMIT_TO_SNR_DB = 0.3, 20.0
"""A model whose mean SNR is at most the second loses at most the first to its int8 weights, or it does not ship."""
STEM = "integer_networks"


@dataclass(frozen=True)
class Row:
    """A recording coded by a model, and decoded twice: SNR by the integer network and by the ONNX graph, in dB."""

    family: str
    model: str
    recording: str
    snr_db: float
    snr_db_by_onnx: float


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Decode a folder of recordings by every model of EVA that ships, in integers and by ONNX Runtime."""
    recordings = [dataset.load(trace) for trace in dataset.entries(folder)]
    chosen = [model for model in models.shipped() if model.codec_identifier == eva.IDENTIFIER]
    every = (row for model in chosen for row in compared(model, recordings))
    rows = page.collected("decoding twice", every, len(chosen) * len(recordings), lambda row: row.model)
    rows.sort(key=lambda row: (row.family, row.model, row.recording))
    losses = losses_of(rows)
    families = {loss.family: [own for own in losses if own.family == loss.family] for loss in losses}
    lines = [
        Curve(family, *zip(*sorted((loss.snr_db, loss.mean_db) for loss in own), strict=True))
        for family, own in families.items()
    ]
    panel = Panel("", "SNR in integers, dB", "lost to int8, dB", lines, lines=(LIMIT_DB,))
    curves(page.results_folder(out) / f"{STEM}.png", [panel])
    limited = [loss for loss in losses if loss.snr_db <= LIMIT_TO_SNR_DB]
    worst = max(limited, key=lambda loss: loss.mean_db, default=None)
    text = page.render(STEM, globals(), losses=losses, recordings=len(recordings), worst=worst)
    page.publish(out, "further_results", text, [(f"{STEM}.csv", rows, Row)])


def compared(model: Model, recordings: Sequence[textures.Recording]) -> Iterator[Row]:
    """Yield a row for each recording. Raises CodecError, and OSError where the model's synthesis cannot be read."""
    both = with_graph(model)
    for recording in recordings:
        coded = encode_recording(recording, round(recording.rate_hz), model=both, highpass_hz=None)
        integers, floats = (
            codec.snr_db(coded.recording.samples, replace(coded.stream, runtime=runtime).decode())
            for runtime in ("core", "onnx")
        )
        if integers is not None and floats is not None:
            yield Row(model.family, model.name, recording.name, integers, floats)


def with_graph(model: Model) -> Model:
    """Return a model whose image holds the ONNX graph of its synthesis next to the integer network.

    Raises OSError where the graph cannot be read.
    """
    image = ModelImage.unpack(model.image)
    payload = replace(EvaImage.unpack(image.payload), graph=(model.path.parent / "synthesis.onnx").read_bytes())
    return replace(model, image=replace(image, payload=payload.pack()).pack())


def losses_of(rows: Sequence[Row]) -> list[Any]:
    """Return a row for each model: its mean SNR in integers, and what it loses against the graph.

    Attributes: `family`, `model`, `snr_db`; `mean_db` and `worst_db`, of the loss over the recordings.
    """
    lost = pl.col("snr_db_by_onnx") - pl.col("snr_db")
    of_model = frame(rows, Row).group_by("family", "model", maintain_order=True)
    return as_rows(of_model.agg(pl.col("snr_db").mean(), mean_db=lost.mean(), worst_db=lost.max()))


if __name__ == "__main__":
    main()
