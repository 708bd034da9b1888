"""The card of a model of kind lapped: its training, and its figures on held-back recordings."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from vibrocast import codec, pages, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.evaluation import trained as trained_model
from vibrocast.evaluation.bd_rate import SNR, bd_rate
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.model_card import recordings_of, training_of
from vibrocast.export.training_data import Trace
from vibrocast.models import IMAGE_SUFFIX, Model

STEPS = tuple(2.0**exponent for exponent in (1.5, 1, 0.5, 0, -0.5, -1, -1.5, -2, -2.5))
"""Quantiser steps that the model is measured at, relative to the RMS value."""
_NEAR_SNR_DB = 15.0
"""The one point that stands for all is that of the nearest SNR."""


def made(
    checkpoint: Checkpoint,
    model: Model,
    version: str,
    data: tuple[Sequence[Trace], Sequence[Trace]],
    commands: tuple[str, str],
    progress: Callable[[float], None],
) -> dict[str, Any]:
    """Return the card of a model, ready for JSON. `data`: the traces that it was trained on, and those held back.

    `commands`: how it was trained, and how exported. `progress` is called with the part done. Raises CodecError.
    """
    trained, held_back = data
    rate_hz = checkpoint.training["training"]["rate_hz"]
    return {
        "name": model.name,
        "version": version,
        "codec": trained_model.codec_name(model),
        "family": model.name,
        "training": training_of(checkpoint, trained, held_back, commands[0]),
        "export": {"command": commands[1]},
        "results": _results(model, recordings_of(held_back, rate_hz), progress),
        "files": {
            f"{model.name}{IMAGE_SUFFIX}": {
                "bytes": len(model.image),
                "sha256": hashlib.sha256(model.image).hexdigest(),
            }
        },
    }


def as_markdown(card: Mapping[str, Any]) -> str:
    """Return a card as the text of card.md."""
    return pages.render(
        Path(__file__).with_suffix(".md.jinja"),
        card=card,
        training=card["training"],
        results=card["results"],
        other=codec.DEFAULT_CODEC,
    )


def _results(
    model: Model, recordings: Sequence[textures.Recording], progress: Callable[[float], None]
) -> dict[str, Any]:
    """Measure the model, and the codec that needs none, on recordings."""
    curves: list[list[list[tuple[float, float]]]] = []
    for number, candidate in enumerate((model, None)):
        curves.append([])
        for recording in recordings:
            curves[-1].append([_measured(recording, step, candidate) for step in STEPS])
            progress((number + len(curves[-1]) / len(recordings)) / 2)
    rates = [bd_rate(other, own, SNR) for own, other in zip(*curves, strict=True)]
    points = [
        {
            "step": step,
            "bits_per_sample": fmean(curve[number][0] for curve in curves[0]),
            "snr_db": fmean(curve[number][1] for curve in curves[0]),
        }
        for number, step in enumerate(STEPS)
    ]
    return {
        "recordings": len(recordings),
        "seconds": sum(recording.seconds for recording in recordings),
        "points": points,
        "point": min(points, key=lambda point: abs(point["snr_db"] - _NEAR_SNR_DB)),
        "bd_rate_percent": fmean(rate.percent for rate in rates if rate is not None),
    }


def _measured(recording: textures.Recording, step: float, model: Model | None) -> tuple[float, float]:
    """Return bits per sample of the whole file, and SNR."""
    rate_hz = round(recording.rate_hz)
    encoding = encode_recording(recording, rate_hz, setting={"step": step}, model=model, highpass_hz=None, touch=0)
    snr_db = encoding.quality.snr_db
    assert snr_db is not None, "traces are not silent, and the codec loses something"
    return 8 * encoding.stream.size_bytes / encoding.stream.samples, snr_db
