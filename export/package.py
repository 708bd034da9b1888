"""Makes the files of a model for use from a checkpoint: ONNX graphs and model image."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec import eva
from vibrocast.codec.eva_image import EvaImage, PriorKind
from vibrocast.codec.interface import Signal
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.configuration import parsed
from vibrocast.export.graphs import Graphs, described, graphs_of
from vibrocast.export.pruning import living_latents, pruned
from vibrocast.export.quantise import quantise

Contents: TypeAlias = Literal["core", "onnx", "both"]
"""The parts of an image for the decoder: the integer network, the ONNX graph, or both, with the network preferred."""


@dataclass(frozen=True)
class Package:
    """A model for use.

    `living`: the latents of the trained model that are left. `image`: the packed model image. `full`: an image with
    both integer network and graph, to compare them.
    """

    name: str
    version: str
    family: str
    contents: Contents
    prior: PriorKind
    living: NDArray[np.intp]
    graphs: Graphs
    rate_hz: int
    image: bytes
    full: bytes

    @property
    def files(self) -> dict[str, bytes]:
        """The files of the model's folder, except its card, by name."""
        return {
            f"{self.name}.vcmi": self.image,
            "analysis.onnx": described(self.graphs.analysis, self.rate_hz),
            "synthesis.onnx": described(self.graphs.synthesis, self.rate_hz),
        }


def make(
    checkpoint: Checkpoint,
    name: str,
    version: str,
    contents: Contents,
    signals: Sequence[Signal],
    prior: PriorKind = "adaptive",
) -> Package:
    """Return the package of a checkpoint, of its living latents alone.

    `signals`: float64 (n,) of its training, as for `quantise`. `prior`: whether its probabilities adapt to a
    stream. Raises ModelError for a model that cannot be used.
    """
    dead_zone = parsed(checkpoint.training).training.dead_zone
    living = living_latents(checkpoint.model, dead_zone, signals)
    model, model_prior = pruned(checkpoint.model, checkpoint.prior, living, dead_zone)
    graphs = graphs_of(model)
    full = replace(quantise(model, model_prior, signals, prior), graph=graphs.synthesis)
    payload = {
        "core": replace(full, graph=b""),
        "onnx": replace(full, network=None, runtime="onnx"),
        "both": full,
    }[contents]

    def packed(payload: EvaImage) -> bytes:
        return ModelImage(eva.IDENTIFIER, name, version, "", payload.pack()).pack()

    # NAME-1, NAME-2, ... are a family: they have one lambda each, and make a curve together.
    family = re.sub(r"-\d+$", "", name)
    rate_hz = checkpoint.training["training"]["rate_hz"]
    return Package(name, version, family, contents, prior, living, graphs, rate_hz, packed(payload), packed(full))
