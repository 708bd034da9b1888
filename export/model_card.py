"""The card of a trained model: its training, its content, and its figures on held-back recordings."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from msgspec import structs

from vibrocast import codec, pages, textures
from vibrocast.codec import Stream
from vibrocast.codec.encoding import Encoding, encode_recording
from vibrocast.codec.eva_image import EvaImage
from vibrocast.codec.graphs import OPSET
from vibrocast.codec.timing import cpu_name, time_coding
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export import configuration
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.package import Package
from vibrocast.export.pruning import changed
from vibrocast.export.training_data import Trace
from vibrocast.models import Model

MEASURED_S = 3.0
"""At most, of each recording that the model is measured on."""
_REPEATS = 3


def made(
    checkpoint: Checkpoint,
    package: Package,
    trained: Sequence[Trace],
    held_back: Sequence[Trace],
    commands: tuple[str, str],
    progress: Callable[[float], None],
) -> dict[str, Any]:
    """Return the card of a model, ready for JSON; models/README.md explains its fields.

    `trained`, `held_back`: the traces of its training's data. `commands`: how it was trained, and how exported.
    `progress` is called with the part done. Raises CodecError.
    """
    rate_hz = checkpoint.training["training"]["rate_hz"]
    recordings = recordings_of(held_back, rate_hz)
    return {
        "name": package.name,
        "version": package.version,
        "codec": "eva",
        "family": package.family,
        "shape": structs.asdict(checkpoint.model.shape),
        "living_latents": len(package.living),
        "held_back_changed": changed(
            checkpoint.model, package.living, checkpoint.training["training"]["dead_zone"], recordings
        ),
        "prior": package.prior,
        "training": _training(checkpoint, trained, held_back, commands[0]),
        "export": {
            "command": commands[1],
            "image_holds": package.contents,
            "opset": OPSET,
            "parity": {
                "analysis": package.graphs.analysis_difference,
                "synthesis": package.graphs.synthesis_difference,
            },
        },
        "results": _results(package, recordings, progress),
        "files": {
            file: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for file, data in package.files.items()
        },
    }


def as_json(card: Mapping[str, Any]) -> str:
    """Return a card as the text of card.json."""
    return json.dumps(card, indent=2, allow_nan=False) + "\n"


def as_markdown(card: Mapping[str, Any]) -> str:
    """Return a card as the text of card.md."""
    training, results = card["training"], card["results"]
    return pages.render(
        Path(__file__).with_suffix(".md.jinja"),
        card=card,
        training=training,
        results=results,
        point=results["point"],
        speed=results["seconds_per_million_samples"],
    )


def _training(
    checkpoint: Checkpoint, trained: Sequence[Trace], held_back: Sequence[Trace], command: str
) -> dict[str, Any]:
    """Return a card's values of a training, given the recordings of its data and the command that ran it."""
    training, history = checkpoint.training, checkpoint.progress
    return {
        "data": _sources(trained, training),
        "held_back": sorted({trace.material for trace in held_back}),
        "command": command,
        "configuration": training,
        "seed": training["seed"],
        "steps": history["step"],
        "seconds": history["seconds"],
        "curves": checkpoint.curves,
    }


def _sources(traces: Sequence[Trace], training: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return name, description, recordings and hours of each source of a training's data.

    `training`: the configuration as a checkpoint stores it.
    """
    chosen = configuration.parsed(training)
    about = {source.name: source.about for source in chosen.sources}
    samples: dict[str, list[int]] = {}
    for trace in traces:
        samples.setdefault(trace.source, []).append(len(trace.samples))
    return [
        {
            "name": name,
            "about": about[name],
            "recordings": len(lengths),
            "hours": sum(lengths) / chosen.training.rate_hz / 3600,
        }
        for name, lengths in samples.items()
    ]


def recordings_of(traces: Sequence[Trace], rate_hz: float) -> list[textures.Recording]:
    """Return the beginning of the first trace of each material."""
    first = {trace.material: trace for trace in reversed(traces)}
    return [
        textures.Recording(trace.samples[: int(MEASURED_S * rate_hz), None].astype(float), rate_hz, "full scale", name)
        for name, trace in first.items()
    ]


def _results(
    package: Package, recordings: Sequence[textures.Recording], progress: Callable[[float], None]
) -> dict[str, Any]:
    """Measure the model by the integer network, by the graph, and with a prior that does not adapt."""
    model = Model(package.name, Path(f"{package.name}.vcmi"), package.full, package.graphs.analysis)
    encodings = []
    for recording in recordings:
        encodings.append(_encoded(recording, model))
        progress(len(encodings) / len(recordings) / 2)
    by_onnx = (
        codec.snr_db(encoding.recording.samples, replace(encoding.stream, runtime="onnx").decode())
        for encoding in encodings
    )
    static = replace(model, image=_with_static_prior(package.full))
    point = {
        "bits_per_sample": _bits_per_sample(encodings),
        "bits_per_sample_static": _bits_per_sample([_encoded(recording, static) for recording in recordings]),
        "snr_db": fmean(_known(encoding.quality.snr_db) for encoding in encodings),
        "snr_db_by_onnx": fmean(map(_known, by_onnx)),
    }
    speed = _speed(model, recordings)
    progress(1.0)
    return {
        "recordings": len(recordings),
        "seconds": sum(recording.seconds for recording in recordings),
        "point": point,
        "processor": cpu_name(),
        "seconds_per_million_samples": speed,
    }


def _with_static_prior(image: bytes) -> bytes:
    """Return a packed model image with the same prior, but static."""
    held = ModelImage.unpack(image)
    return replace(held, payload=replace(EvaImage.unpack(held.payload), prior="static").pack()).pack()


def _encoded(recording: textures.Recording, model: Model) -> Encoding:
    setting = codec.CODECS["eva"].complete({})
    return encode_recording(
        recording, round(recording.rate_hz), setting=setting, model=model, highpass_hz=None, touch=0
    )


def _bits_per_sample(encodings: Sequence[Encoding]) -> float:
    bits = sum(8 * encoding.stream.size_bytes for encoding in encodings)
    return bits / sum(encoding.stream.samples for encoding in encodings)


def _known(ratio_db: float | None) -> float:
    assert ratio_db is not None, "traces are not silent, and the codec loses something"
    return ratio_db


def _speed(model: Model, recordings: Sequence[textures.Recording]) -> dict[str, float]:
    """Return the processor seconds that a million samples take, all recordings after one another."""
    samples = np.concatenate([recording.samples for recording in recordings])
    rate_hz = round(recordings[0].rate_hz)

    def encode() -> Stream:
        return codec.encode(samples, rate_hz, {}, codec="eva", model=model)

    def decode(stream: Stream, runtime: str) -> object:
        return replace(stream, runtime=runtime).decode_integers()

    speeds = {
        runtime: time_coding(encode, partial(decode, runtime=runtime), len(samples), _REPEATS)
        for runtime in codec.RUNTIMES
    }
    return {
        "encode": speeds["core"][0],
        **{f"decode_by_{runtime}": speed[1] for runtime, speed in speeds.items()},
    }
