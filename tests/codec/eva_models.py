"""Models of EVA for tests: the tiny one that tests.codec.make_eva_model trained, and ones of random integers."""

from pathlib import Path

import numpy as np

import models
from codec.eva_image import Convolution, EvaImage, IntegerNetwork, Normalisation, PriorKind
from codec.mdct import built_in_tables

FOLDER = Path(__file__).parent


def tiny_model() -> models.Model:
    """Return the tiny model: 16 channels, 4 rates, contexts, integers and graph."""
    analysis = (FOLDER / "tiny_eva_analysis.onnx").read_bytes()
    path = FOLDER / "tiny_eva.vcmi"
    return models.Model("tiny", path, path.read_bytes(), analysis)


def random_network(generator: np.random.Generator, width: int, latents: int) -> IntegerNetwork:
    """Return a network whose activations are neither all zero nor all saturated."""
    normalisations, convolutions = [], []
    for kernel, inputs, outputs in ((5, latents, width), (5, width, width), (9, width, 1)):
        weights = generator.integers(0, 128, (inputs, inputs), dtype=np.int8)
        multipliers = generator.integers(1, 2**28 // inputs, inputs, dtype=np.uint32)
        constants = generator.integers(2**16, 2**26, inputs, dtype=np.uint32)
        normalisations.append(Normalisation(weights, multipliers, constants, 13))
        taps = generator.integers(-127, 128, (kernel, outputs, inputs), dtype=np.int8)
        scales = generator.integers(2**23 // inputs, 2**24 // inputs, outputs, dtype=np.uint32)
        convolutions.append(Convolution(taps, scales))
    first, second, third = normalisations
    return IntegerNetwork((first, second, third), (convolutions[0], convolutions[1], convolutions[2]))


def random_image(
    seed: int, width: int = 4, latents: int = 3, rates: int = 2, prior: PriorKind = "contexts"
) -> EvaImage:
    """Return an image with a random integer network and no graph."""
    generator = np.random.default_rng(seed)
    falling = 64 * (15 - np.arange(rates))[:, None] + generator.integers(0, 64, (rates, latents))
    probabilities = generator.integers(0, 65536, (rates, latents, 16)).astype(np.uint16)
    return EvaImage(
        width,
        falling.astype(np.uint16),
        10,
        built_in_tables() if prior == "contexts" else probabilities,
        random_network(generator, width, latents),
        b"",
        "core",
    )
