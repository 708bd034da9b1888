"""Converts a trained EVA into the payload of a model image: integer network, and probabilities of its prior."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from vibrocast.codec.eva_image import (
    MAX_FRACTION_BITS,
    MAX_SHIFT,
    UNARY_LIMIT,
    Convolution,
    EvaImage,
    IntegerNetwork,
    Normalisation,
    PriorKind,
)
from vibrocast.codec.interface import Signal
from vibrocast.export.eva import Eva, Gdn
from vibrocast.export.priors import FactorisedPrior, probabilities
from vibrocast.models import ModelError

HOTTEST = 4.0
"""Level of the calibration signals relative to an RMS value of 1, which leaves headroom for louder passages."""
EXCERPT_SAMPLES = 4096
CALIBRATION_EXCERPTS = 64
TONES = 64

_LARGEST = 32767.0
_MAX_WORD = 2**32 - 1
# The values of firmware/src/core/vc_eva_kernels.h and eva_synthesis.c.
_ENERGY_SHIFT, _SQUARE_SHIFT, _SCALE_SHIFT, _SAMPLE_UNIT = 24, 15, 32, 1024.0

Values = NDArray[np.float64]


def quantise(
    model: Eva, prior: FactorisedPrior, signals: Sequence[Signal], kind: PriorKind = "adaptive", seed: int = 1
) -> EvaImage:
    """Return the image of a model without a graph, for the integer core.

    `signals`: float64 (n,), those of the model's training, at any level; they set the ranges of the integers. `kind`:
    whether the prior's probabilities adapt to a stream. Raises ModelError if the signals are silent, or if the model
    does not fit the integers.
    """
    calibration = excerpts(signals)
    generator = np.random.default_rng(seed)
    ranges = _ranges(model, calibration[generator.permutation(len(calibration))[:CALIBRATION_EXCERPTS]])
    if not all(np.all(np.isfinite(values) & (values > 0)) for values in ranges):
        raise ModelError(
            "it gives NaN or infinity on the signals of its training; take an earlier one or train it again"
        )
    fraction_bits = np.clip(np.floor(np.log2(_LARGEST / ranges[0])), 0, MAX_FRACTION_BITS)
    return EvaImage(
        width=model.shape.width,
        fraction_bits=fraction_bits.astype(np.uint8),
        probabilities=_decisions(prior),
        prior=kind,
        network=_network(model, ranges, np.exp2(fraction_bits)),
        graph=b"",
        runtime="core",
    )


def excerpts(signals: Sequence[Signal]) -> NDArray[np.float32]:
    """Return excerpts (count, EXCERPT_SAMPLES) of RMS value 1; zeros pad short signals, silent ones are dropped.

    Raises ModelError if none is left.
    """
    parts = []
    for signal in signals:
        for start in range(0, max(1, len(signal) - EXCERPT_SAMPLES // 2), EXCERPT_SAMPLES):
            part = np.asarray(signal[start : start + EXCERPT_SAMPLES], dtype=np.float64)
            if np.any(part):
                part = part / np.sqrt(np.mean(np.square(part)))
                parts.append(np.pad(part, (0, EXCERPT_SAMPLES - len(part))))
    if not parts:
        raise ModelError("there is no signal to calibrate the integers with; give the recordings of the training")
    return np.array(parts, dtype=np.float32)


def _ranges(model: Eva, signals: NDArray[np.float32]) -> list[Values]:
    """Return the greatest magnitudes at HOTTEST times the level, for each channel.

    First those of the latents, then of each layer of the synthesis; each inverse GDN's norm comes before its result.
    Latents have room for tones of every frequency too, because all of a tone's power may lie in one of them.
    """
    ranges: list[Values] = []

    def record(values: torch.Tensor) -> None:
        greatest = torch.amax(torch.abs(values), dim=(0, 2)).double().numpy()
        # A channel that is silent in calibration is scaled like the quietest other channel.
        ranges.append(np.maximum(greatest, np.min(greatest[greatest > 0], initial=1.0)))

    with torch.no_grad():
        latents, of_tones = (model.analysis(HOTTEST * torch.from_numpy(each)[:, None]) for each in (signals, tones()))
        record(torch.cat([latents, of_tones]))
        values = torch.round(latents)
        for layer in model.synthesis:
            if isinstance(layer, Gdn):
                energy = torch.nn.functional.conv1d(values * values, layer.gamma[:, :, None], layer.beta)
                record(torch.sqrt(energy))
            values = layer(values)
            record(values)
    return ranges


def tones() -> NDArray[np.float32]:
    """Return tones (TONES, EXCERPT_SAMPLES) of RMS value 1 from 1 / (2 TONES) of the Nyquist frequency up."""
    radians = np.pi * (np.arange(TONES) + 0.5) / TONES
    return np.asarray(np.sqrt(2) * np.sin(radians[:, None] * np.arange(EXCERPT_SAMPLES)), dtype=np.float32)


def _network(model: Eva, ranges: Sequence[Values], input_units: Values) -> IntegerNetwork:
    """Return the synthesis in integers. A channel's unit is the integer that stands for 1."""
    normalisations, convolutions = [], []
    for stage, (norms, normalised, convolved) in enumerate(zip(ranges[1::3], ranges[2::3], ranges[3::3], strict=True)):
        gdn, convolution = model.synthesis[2 * stage], model.synthesis[2 * stage + 1]
        assert isinstance(gdn, Gdn) and isinstance(convolution.weight, torch.Tensor)
        part, units = _normalisation(gdn, input_units, norms, normalised)
        normalisations.append(part)
        last = stage == len(model.synthesis) // 2 - 1
        wanted = np.array([_SAMPLE_UNIT]) if last else _LARGEST / convolved
        weights = convolution.weight.detach().double().numpy().transpose(2, 1, 0)
        quantised, input_units = _convolution(weights, units, wanted)
        if last and not np.array_equal(input_units, wanted):
            raise ModelError(
                "its synthesis does not fit the integers: weights are far out of proportion; train it again"
            )
        convolutions.append(quantised)
    first, second, third = normalisations
    return IntegerNetwork((first, second, third), (convolutions[0], convolutions[1], convolutions[2]))


def _normalisation(gdn: Gdn, inputs: Values, norms: Values, normalised: Values) -> tuple[Normalisation, Values]:
    """Return an inverse GDN in integers, and the units of its results.

    Depends on the units of its inputs, and on the greatest norm and result of each channel.
    """
    with torch.no_grad():
        gamma, beta = gdn.gamma.double().numpy(), gdn.beta.double().numpy()
    weights = gamma / inputs[None, :] ** 2
    rows = np.max(weights, axis=1) / 127
    # Finer roots have a multiplier that does not fit, which would bend the norm.
    per_square = np.maximum(rows, np.finfo(np.float64).tiny) * 2.0 ** (_SQUARE_SHIFT + _ENERGY_SHIFT)
    finest = np.minimum(_LARGEST / norms, np.sqrt(_MAX_WORD / per_square))

    def roots_at(shift: int) -> Values:
        return np.asarray(np.minimum(finest, _LARGEST * 2.0**shift / (inputs * normalised)))

    def fewest_integers(shift: int) -> float:
        roots = roots_at(shift)
        return float(min(np.min(roots * norms), np.min(roots * inputs * normalised) / 2.0**shift))

    # One shift for all channels: a loss in the roots of some is a gain in the results of others.
    shift = max(range(MAX_SHIFT + 1), key=fewest_integers)
    roots = roots_at(shift)
    part = Normalisation(
        np.rint(weights / np.where(rows > 0, rows, 1.0)[:, None]).astype(np.int8),
        _words(rows * roots**2 * 2.0 ** (_SQUARE_SHIFT + _ENERGY_SHIFT)),
        _words(beta * roots**2),
        shift,
    )
    return part, inputs * roots / 2.0**shift


def _convolution(weights: Values, inputs: Values, wanted: Values) -> tuple[Convolution, Values]:
    """Return a transposed convolution (kernel, outputs, inputs) in integers, and its results' units, up to `wanted`."""
    per_integer = weights / inputs
    rows = np.max(np.abs(per_integer), axis=(0, 2)) / 127
    rows = np.where(rows > 0, rows, 1.0 / np.max(inputs))
    outputs = np.minimum(wanted, _MAX_WORD / 2.0**_SCALE_SHIFT / rows)
    quantised = np.rint(per_integer / rows[None, :, None]).astype(np.int8)
    return Convolution(quantised, _words(rows * outputs * 2.0**_SCALE_SHIFT)), outputs


def _words(values: Values) -> NDArray[np.uint32]:
    return np.minimum(np.rint(values), _MAX_WORD).astype(np.uint32)


def _decisions(prior: FactorisedPrior) -> NDArray[np.uint16]:
    """Return the probabilities of each decision, (latents, 16), as codec.eva_image has them."""
    each = probabilities(prior, UNARY_LIMIT)
    below, above = each[:, UNARY_LIMIT - 1 :: -1], each[:, UNARY_LIMIT + 1 :]
    magnitudes = np.hstack([each[:, UNARY_LIMIT, None], below + above])[:, :UNARY_LIMIT]
    beyond = np.maximum(1 - np.cumsum(magnitudes, axis=1), 0)
    negative = _odds(np.sum(below, axis=1), np.sum(above, axis=1))
    decisions = np.hstack([_odds(beyond, magnitudes), negative[:, None]])
    return np.asarray(np.clip(np.rint(65536 * decisions), 1, 65535), dtype=np.uint16)


def _odds(yes: Values, no: Values) -> Values:
    """Return yes / (yes + no), even if both are zero."""
    floor = 1e-12
    return np.asarray((yes + floor) / (yes + no + 2 * floor))
