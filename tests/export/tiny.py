"""A small model that codes passably without training, for tests of what is made of checkpoints, and of what uses it."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vibrocast import models, textures
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.configuration import parsed
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.lapped_start import start_lapped
from vibrocast.export.package import Contents, Package, make
from vibrocast.export.priors import PRIORS

LAMBDAS = (1.0, 10.0, 100.0)


def checkpoint(prior: str = "contexts", lambdas: tuple[float, ...] = LAMBDAS, **model: Any) -> Checkpoint:
    """Return a checkpoint of a width of 8, as if trained on generated textures, two kinds of three held back."""
    configuration = parsed(
        {
            "name": "tiny",
            "model": {"width": 8, "latents": 16, "lambdas": list(lambdas), "prior": prior, "start": "lapped", **model},
            "generator": {"kinds": ["rough", "wood", "grating"], "recordings": 2, "seconds": 1.0},
            "held_back": {"materials": ["generator/wood", "generator/grating"]},
        }
    )
    torch.manual_seed(1)
    choice = configuration.model
    eva = Eva(EvaShape(choice.width, choice.latents, len(lambdas)))
    start_lapped(eva, choice.lambdas)
    rates = [{"lambda": weight, "bits_per_sample": 1.0, "snr_db": 10.0} for weight in lambdas]
    record = {"step": 0, "seconds": 0.0, "training_loss": 2.0, "loss": 3.0, "rates": rates}
    return Checkpoint(
        eva,
        PRIORS[prior](choice.latents),
        configuration.as_dict(),
        {"step": 0, "seconds": 0.0, "best_loss": 3.0, "best_step": 0},
        [record],
    )


@cache
def package(
    contents: Contents = "both", name: str = "tiny", prior: str = "contexts", lambdas: tuple[float, ...] = LAMBDAS
) -> Package:
    """Return what is made of the checkpoint, its integers prepared on generated textures."""
    signals = [textures.GENERATORS["rough"](seed, 1.0).samples[:, 0].astype(np.float64) for seed in range(4)]
    return make(checkpoint(prior, lambdas), name, "1", contents, signals)


def model(contents: Contents = "both", **choices: Any) -> models.Model:
    """Return it as a model that could ship."""
    made = package(contents, **choices)
    return models.Model(made.name, Path("tiny.vcmi"), made.image, made.graphs.analysis, {"family": made.family})
