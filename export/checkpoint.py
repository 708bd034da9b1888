"""Checkpoints: a trained model with its prior, its training, and the state from which a training resumes."""

import io
import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from vibrocast.errors import located
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.priors import FactorisedPrior
from vibrocast.files import atomic_write
from vibrocast.models import ModelError

FORMAT, VERSION = "vibrocast-eva", 2
MAX_BYTES = 256 * 2**20
MAX_SHAPE = EvaShape(width=128, latents=128)
_REACHED = ("step", "seconds")
_MEASURED = ("step", "seconds", "training_loss", "loss")


@dataclass
class Checkpoint:
    """A model with its prior and its history.

    `training`: the configuration, as plain tables. `progress`: `step` and `seconds` so far. `curves`: a record for each
    validation, see export.training. `optimiser`: the state of Adam, from which a training resumes.
    """

    model: Eva
    prior: FactorisedPrior
    training: dict[str, Any]
    progress: dict[str, Any] = field(default_factory=dict)
    curves: list[dict[str, Any]] = field(default_factory=list)
    optimiser: dict[str, Any] | None = None

    def save(self, path: Path) -> None:
        """Write the checkpoint, completely or not at all. Raises OSError."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "shape": self.model.shape.as_dict(),
            "model": self.model.state_dict(),
            "prior": self.prior.state_dict(),
            "training": self.training,
            "progress": self.progress,
            "curves": self.curves,
            "optimiser": self.optimiser,
        }
        stored = io.BytesIO()
        torch.save(content, stored)
        with atomic_write(path) as partial:
            partial.write_bytes(stored.getbuffer())  # torch's own writing does not report a full disk


def load(path: Path) -> Checkpoint:
    """Read a checkpoint onto the processor, in evaluation mode.

    Raises ModelError for another file or version, for arrays of other shapes than stated, and for numbers that are not
    finite; OSError if the file cannot be read.
    """
    if not path.is_file():
        raise ModelError(
            f"{path}: no such file; give a checkpoint that `vibrocast train` wrote, such as OUT/checkpoint.pt"
        )
    if path.stat().st_size > MAX_BYTES:
        raise ModelError(f"{path}: longer than any checkpoint, {MAX_BYTES} bytes; give another file")
    stored = io.BytesIO(path.read_bytes())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's long warnings about foreign files
            content = torch.load(stored, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises errors of many kinds for damaged files
        raise ModelError(
            f"{path}: not a checkpoint that can be read; give one that `vibrocast train` wrote: OUT/checkpoint.pt"
        ) from error
    with located(path):
        return _parsed(content)


def _parsed(content: Any) -> Checkpoint:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ModelError("not a checkpoint of a model; give one that `vibrocast train` wrote")
    if content.get("version") != VERSION:
        raise ModelError(
            f"a checkpoint of version {content.get('version')!r}, and this program reads {VERSION}; train the "
            "model again, or use the program that wrote it"
        )
    model = Eva(_shape(content.get("shape")))
    prior = FactorisedPrior(model.shape.latents)
    _fill(model, content.get("model"), "model")
    _fill(prior, content.get("prior"), "prior")
    curves, optimiser = content.get("curves"), content.get("optimiser")
    if not isinstance(curves, list) or not all(_has_numbers(record, *_MEASURED) for record in curves):
        raise ModelError("its curves are no list of records; train the model again")
    if optimiser is not None and not isinstance(optimiser, dict):
        raise ModelError("its state of the optimiser is damaged; train the model again")
    training, progress = _table(content, "training"), _table(content, "progress")
    if not _has_numbers(progress, *_REACHED):
        raise ModelError("it does not state the step of its training; train the model again")
    return Checkpoint(model.eval(), prior.eval(), training, progress, curves, optimiser)


def _shape(stored: Any) -> EvaShape:
    limits = MAX_SHAPE.as_dict()
    if not isinstance(stored, dict) or stored.keys() != limits.keys():
        raise ModelError("it does not state the shape of the model; train the model again")
    for name, limit in limits.items():
        if type(stored[name]) is not int or not 1 <= stored[name] <= limit:
            raise ModelError(f"{name} {stored[name]!r} is not a number from 1 to {limit}; train a smaller model")
    return EvaShape(**stored)


def _table(content: dict[str, Any], name: str) -> dict[str, Any]:
    table = content.get(name)
    if not isinstance(table, dict):
        raise ModelError(f"it lacks its table {name!r}; train the model again")
    return table


def _has_numbers(record: Any, *names: str) -> bool:
    """Return whether a record holds a finite number under each name."""
    return isinstance(record, dict) and all(
        type(record.get(name)) in (int, float) and math.isfinite(record[name]) for name in names
    )


def _fill(module: nn.Module, state: Any, name: str) -> None:
    wanted = {key: tensor.shape for key, tensor in module.state_dict().items()}
    if not isinstance(state, dict) or state.keys() != wanted.keys():
        raise ModelError(f"the arrays of its {name} do not fit its shape; train the model again")
    for key, shape in wanted.items():
        tensor = state[key]
        if (
            not isinstance(tensor, torch.Tensor)
            or (tensor.dtype, tensor.shape) != (torch.float32, shape)
            or (tensor.layout, tensor.device.type) != (torch.strided, "cpu")
        ):
            raise ModelError(f"its array {key!r} is not float32 of shape {tuple(shape)}; train the model again")
        if not torch.isfinite(tensor).all():
            raise ModelError(f"its array {key!r} holds numbers that are not finite; train the model again")
    module.load_state_dict(state)
