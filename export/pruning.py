"""Removes the latents of a model that no signal of its training makes non-zero."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from vibrocast.codec.interface import Signal
from vibrocast.export.eva import HOP_SAMPLES, DeadZone, Eva, EvaShape
from vibrocast.export.priors import FactorisedPrior
from vibrocast.export.quantise import HOTTEST, excerpts, tones
from vibrocast.models import ModelError
from vibrocast.textures import Recording


def living_latents(model: Eva, dead_zone: float, signals: Sequence[Signal]) -> NDArray[np.intp]:
    """Return the latents that some signal makes non-zero at up to HOTTEST times the level of the training.

    `dead_zone`, `signals`: those of the training, the signals float64 (n,). Tones of every frequency count too. Raises
    ModelError if none lives.
    """
    largest = np.zeros(model.shape.latents)
    with torch.no_grad():
        for batch in torch.split(torch.from_numpy(np.concatenate([excerpts(signals), tones()])), 64):
            latents = model.analysis(HOTTEST * batch[:, None])
            largest = np.maximum(largest, torch.amax(torch.abs(latents), dim=(0, 2)).double().numpy())
    living = np.flatnonzero(largest > 0.5 + dead_zone)
    if len(living) == 0:
        raise ModelError("its latents are zero for every signal of its training; train it again with a higher lambda")
    return living


def pruned(
    model: Eva, prior: FactorisedPrior, living: NDArray[np.intp], dead_zone: float
) -> tuple[Eva, FactorisedPrior]:
    """Return a model and a prior of the living latents alone, with the dead zone of the training in the analysis.

    The analysis computes all latents, because its last GDN divides by every one of them. A convolution then selects
    the living ones. The synthesis loses weights that only zeros meet. So both give what they gave before, up to the
    order of sums, wherever the other latents are zero.
    """
    smaller = Eva(EvaShape(model.shape.width, len(living)))
    smaller_prior = FactorisedPrior(len(living))
    index = torch.from_numpy(living)
    state = model.synthesis.state_dict()
    state["0.root_beta"], state["0.root_gamma"] = state["0.root_beta"][index], state["0.root_gamma"][index][:, index]
    state["1.weight"] = state["1.weight"][index]
    smaller.synthesis.load_state_dict(state)
    selection = nn.Conv1d(model.shape.latents, len(living), 1, bias=False)
    selection.weight = nn.Parameter(torch.eye(model.shape.latents)[index][:, :, None])
    smaller.analysis = nn.Sequential(*model.analysis, selection, *[DeadZone(len(living), dead_zone)] * (dead_zone > 0))
    smaller_prior.load_state_dict({name: values[index] for name, values in prior.state_dict().items()})
    return smaller.eval(), smaller_prior.eval()


def changed(model: Eva, living: NDArray[np.intp], dead_zone: float, recordings: Sequence[Recording]) -> int:
    """Return how many recordings of one channel had a latent, before the pruning, that is not zero and now is.

    Each recording has the level of the training, an RMS value of 1.
    """
    dead = np.setdiff1d(np.arange(model.shape.latents), living)
    count = 0
    for recording in recordings:
        signal = recording.samples[:, 0] / np.sqrt(np.mean(recording.samples**2))
        padded = np.pad(signal, (0, -len(signal) % HOP_SAMPLES)).astype(np.float32)
        with torch.no_grad():
            latents = model.analysis(torch.from_numpy(padded)[None, None])[0, dead]
        count += bool(torch.any(torch.abs(latents) > 0.5 + dead_zone))
    return count
