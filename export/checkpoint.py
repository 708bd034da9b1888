"""Checkpoints: a trained model with its prior, its training, and the state from which a training resumes."""

import io
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import torch
from torch import nn

from vibrocast.errors import InputError, located
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.priors import FactorisedPrior
from vibrocast.files import atomic_write
from vibrocast.models import ModelError
from vibrocast.toml_tables import Table, convert, within

FORMAT, VERSION = "vibrocast-eva", 2
MAX_BYTES = 256 * 2**20

_Finite = Annotated[float, within(-1e300, 1e300)]


class _Reached(Table, frozen=True):
    """How far a training has come."""

    step: int
    seconds: _Finite


class _Measured(_Reached, frozen=True):
    """The curves at a validation."""

    training_loss: _Finite
    loss: _Finite
    bits_per_sample: _Finite
    snr_db: _Finite


class _Content(Table, frozen=True):
    """The content of the file."""

    format: str
    version: Literal[2]
    shape: EvaShape
    model: dict[str, Any]
    prior: dict[str, Any]
    training: dict[str, Any]
    progress: _Reached
    curves: tuple[_Measured, ...]
    optimiser: dict[str, Any] | None


@dataclass
class Checkpoint:
    """A model with its prior and its history.

    `training`: the configuration, as plain tables. `progress`: `step` and `seconds` so far. `curves`: a record for each
    validation, see export.training. `optimiser`: the state of Adam, from which a training resumes.
    """

    model: Eva
    prior: FactorisedPrior
    training: dict[str, Any]
    progress: dict[str, Any] = field(default_factory=lambda: {"step": 0, "seconds": 0.0})
    curves: list[dict[str, Any]] = field(default_factory=list)
    optimiser: dict[str, Any] | None = None

    def save(self, path: Path) -> None:
        """Write the checkpoint, completely or not at all. Raises OSError."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "shape": msgspec.structs.asdict(self.model.shape),
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
    try:
        stored = convert(content, _Content)
    except InputError as error:
        raise ModelError(f"{error}; train the model again") from error
    model, prior = Eva(stored.shape), FactorisedPrior(stored.shape.latents)
    _fill(model, stored.model, "model")
    _fill(prior, stored.prior, "prior")
    curves, progress = content["curves"], content["progress"]
    return Checkpoint(model.eval(), prior.eval(), stored.training, progress, curves, stored.optimiser)


def _fill(module: nn.Module, state: dict[str, Any], name: str) -> None:
    try:
        module.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise ModelError(f"the arrays of its {name} do not fit its shape; train the model again") from error
    if not all(torch.isfinite(array).all() for array in module.state_dict().values()):
        raise ModelError(f"its {name} holds numbers that are not finite; train the model again")
