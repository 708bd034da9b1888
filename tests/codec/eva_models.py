"""Models of EVA for tests: the tiny one that tests.codec.make_eva_model wrote, and ones of random integers."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from vibrocast import models
from vibrocast.codec.eva import IDENTIFIER
from vibrocast.codec.eva_image import DECISIONS, Convolution, EvaImage, IntegerNetwork, Normalisation, PriorKind
from vibrocast.device_protocol.model_image import ModelImage

FOLDER = Path(__file__).parent


def tiny_model() -> models.Model:
    """Return the tiny model: 16 channels, integers and graph."""
    analysis = (FOLDER / "tiny_eva_analysis.onnx").read_bytes()
    path = FOLDER / "tiny_eva.vcmi"
    return models.Model("tiny", path, path.read_bytes(), analysis)


def model_with(tables: bytes, analysis: bytes = b"", codec_identifier: int = IDENTIFIER) -> models.Model:
    """Return a model with these tables."""
    image = ModelImage(codec_identifier, "model", "1", "", tables).pack()
    return models.Model("model", Path("model.vcmi"), image, analysis)


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


def random_image(seed: int, width: int = 4, latents: int = 3, prior: PriorKind = "adaptive") -> EvaImage:
    """Return an image with a random integer network and no graph."""
    generator = np.random.default_rng(seed)
    probabilities = generator.integers(0, 65536, (latents, DECISIONS)).astype(np.uint16)
    fraction_bits = generator.integers(0, 15, latents).astype(np.uint8)
    return EvaImage(width, fraction_bits, probabilities, prior, random_network(generator, width, latents), b"", "core")


def with_extreme_weights(image: EvaImage, seed: int) -> EvaImage:
    """Return the image with the largest weights, multipliers and constants there are, but for their signs."""
    assert image.network is not None
    generator = np.random.default_rng(seed)
    normalisations = [
        replace(
            part,
            weights=np.full_like(part.weights, 127),
            multipliers=generator.choice([0, 1, 2**31, 2**32 - 1], part.multipliers.shape).astype(np.uint32),
            constants=generator.choice([0, 1, 2**30, 2**32 - 1], part.constants.shape).astype(np.uint32),
            shift=int(generator.choice([0, 15, 30])),
        )
        for part in image.network.normalisations
    ]
    convolutions = [
        replace(
            part,
            weights=generator.choice([-128, 127], part.weights.shape).astype(np.int8),
            multipliers=generator.choice([0, 2**16, 2**32 - 1], part.multipliers.shape).astype(np.uint32),
        )
        for part in image.network.convolutions
    ]
    network = IntegerNetwork(
        (normalisations[0], normalisations[1], normalisations[2]), (convolutions[0], convolutions[1], convolutions[2])
    )
    return replace(image, network=network)
