"""A small model that codes passably without training, to test checkpoints, their packages and users."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vibrocast import models, textures
from vibrocast.codec.eva_image import PriorKind
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.configuration import parsed
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.lapped_start import start_lapped
from vibrocast.export.package import Contents, Package, make
from vibrocast.export.priors import FactorisedPrior

LAMBDA = 10.0


def checkpoint(lambda_: float = LAMBDA) -> Checkpoint:
    """Return a checkpoint of a width of 16, as if trained on generated textures, two kinds of three held back."""
    configuration = parsed(
        {
            "name": "tiny",
            "model": {"width": 16, "lambda": lambda_},
            "generator": {"kinds": ["rough", "wood", "grating"], "recordings": 2, "seconds": 1.0},
            "training": {"steps": 1},
            "held_back": {"materials": ["generator/wood", "generator/grating"]},
        }
    )
    torch.manual_seed(1)
    eva = Eva(EvaShape(16, 16))
    start_lapped(eva, lambda_)
    record = {"step": 1, "seconds": 0.0, "training_loss": 2.0, "loss": 3.0, "bits_per_sample": 1.0, "snr_db": 10.0}
    progress = {"step": 1, "seconds": 0.0}
    return Checkpoint(eva, FactorisedPrior(16), configuration.as_dict(), progress, [record])


@cache
def package(
    contents: Contents = "both", name: str = "tiny", lambda_: float = LAMBDA, prior: PriorKind = "adaptive"
) -> Package:
    """Return the checkpoint's package, with integers calibrated on generated textures."""
    signals = [textures.GENERATORS["rough"](seed, 1.0).samples[:, 0].astype(np.float64) for seed in range(4)]
    return make(checkpoint(lambda_), name, "1", contents, signals, prior)


def model(contents: Contents = "both", **choices: Any) -> models.Model:
    """Return it as a model that could ship."""
    made = package(contents, **choices)
    return models.Model(made.name, Path("tiny.vcmi"), made.image, made.graphs.analysis, {"family": made.family})
