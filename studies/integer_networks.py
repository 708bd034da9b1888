"""Compares integer networks with ONNX graphs: `python -m studies.integer_networks FOLDER --out docs/benchmarks`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from statistics import fmean

from studies import page
from vibrocast import codec, models, progress, textures
from vibrocast.codec import eva
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.eva_image import EvaImage
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.evaluation.curves import Curve, Panel, curves
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


@dataclass(frozen=True)
class Loss:
    """A model's mean SNR in integers, and what it loses against the graph: mean and worst recording, in dB."""

    family: str
    model: str
    snr_db: float
    mean_db: float
    worst_db: float


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Decode a folder of recordings by every model of EVA that ships, in integers and by ONNX Runtime."""
    recordings = [dataset.load(trace) for trace in dataset.entries(folder)]
    chosen = [model for model in models.shipped() if model.codec_identifier == eva.IDENTIFIER]
    with progress.bar("decoding twice") as update:
        rows = []
        for number, model in enumerate(chosen, 1):
            rows += list(compared(model, recordings))
            update(number / len(chosen), model.name)
    rows.sort(key=attrgetter("family", "model", "recording"))
    losses = losses_of(rows)
    draw(page.results_folder(out) / f"{STEM}.png", losses)
    limited = [loss for loss in losses if loss.snr_db <= LIMIT_TO_SNR_DB]
    text = page.render(
        STEM,
        losses=losses,
        recordings=len(recordings),
        worst=max(limited, key=attrgetter("mean_db"), default=None),
        limit_db=LIMIT_DB,
        limit_to_snr_db=LIMIT_TO_SNR_DB,
        stem=STEM,
    )
    page.publish(out, STEM, text, [(f"{STEM}.csv", rows, Row)])


def compared(model: Model, recordings: Sequence[textures.Recording]) -> Iterator[Row]:
    """Yield a row for each recording. Raises CodecError, and OSError where the model's synthesis cannot be read."""
    both = with_graph(model)
    for recording in recordings:
        coded = encode_recording(recording, round(recording.rate_hz), model=both, highpass_hz=None)
        decoded = (replace(coded.stream, runtime=runtime).decode() for runtime in codec.RUNTIMES)
        snr_db = dict(zip(codec.RUNTIMES, (codec.snr_db(coded.recording.samples, one) for one in decoded), strict=True))
        if (integers := snr_db["core"]) is not None and (floats := snr_db["onnx"]) is not None:
            yield Row(model.family, model.name, recording.name, integers, floats)


def with_graph(model: Model) -> Model:
    """Return a model whose image holds the ONNX graph of its synthesis next to the integer network.

    Raises OSError where the graph cannot be read.
    """
    image = ModelImage.unpack(model.image)
    payload = replace(EvaImage.unpack(image.payload), graph=(model.path.parent / "synthesis.onnx").read_bytes())
    return replace(model, image=replace(image, payload=payload.pack()).pack())


def losses_of(rows: Sequence[Row]) -> list[Loss]:
    """Return the loss of each model, of rows that are sorted by family and model."""
    losses = []
    for (family, model), own in groupby(rows, key=attrgetter("family", "model")):
        group = list(own)
        differences_db = [row.snr_db_by_onnx - row.snr_db for row in group]
        snr_db = fmean(row.snr_db for row in group)
        losses.append(Loss(family, model, snr_db, fmean(differences_db), max(differences_db)))
    return losses


def draw(path: Path, losses: Sequence[Loss]) -> None:
    """Draw the mean loss of each model over its SNR, a line for each family. Raises OSError."""
    lines = []
    for family, own in groupby(losses, key=attrgetter("family")):
        snrs_db, lost_db = zip(*sorted((loss.snr_db, loss.mean_db) for loss in own), strict=True)
        lines.append(Curve(family, snrs_db, lost_db))
    curves(path, [Panel("", "SNR in integers, dB", "lost to int8, dB", lines, lines=(LIMIT_DB,))])


if __name__ == "__main__":
    main()
