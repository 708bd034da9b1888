"""A start of EVA's training: a lapped transform of 16 bands in rising frequency, and its inverse."""

import torch
from torch import nn

from vibrocast.codec.parametric import analysis_matrix
from vibrocast.export.eva import HOP_SAMPLES, Eva, Gdn

_PASSED_ON = (4, 8, HOP_SAMPLES)
"""Channels of each layer that carry the signal: as many as the samples between two of its columns."""
_SPARE = 0.3
"""Of their usual size, the weights of all other channels."""
_OWN_GAMMA, _SHARED_GAMMA = 0.0001, 0.0001


def start_lapped(model: Eva, lambda_: float) -> None:
    """Set the transforms to an MDCT of 16 bands and its inverse, for the step that is best for white noise.

    The first layer's kernels delay by zero to three samples, the second's by zero and four, the third's are the basis;
    the synthesis mirrors them, and divisive normalisation is weak. A distortion of step^2 / 12 at a slope of 6 dB a
    bit has lambda = 12 / (2 ln 2 step^2): Gish and Pierce, "Asymptotically efficient quantizing", 1968. Each
    layer needs at least 16 channels.
    """
    down = [layer for layer in model.analysis if isinstance(layer, nn.Conv1d)]
    up = [layer for layer in reversed(model.synthesis) if isinstance(layer, nn.ConvTranspose1d)]
    with torch.no_grad():
        for layer, kernel in enumerate(_kernels()):
            after, before = kernel.shape[:2]
            for weight in (down[layer].weight, up[layer].weight):
                weight *= _SPARE
                weight[:after] = 0
                weight[:after, :before] = kernel
        for module in model.modules():
            if isinstance(module, Gdn):
                channels = len(module.root_beta)
                module.root_gamma.copy_(torch.sqrt(_OWN_GAMMA * torch.eye(channels) + _SHARED_GAMMA / channels))
        step = torch.exp2(-0.5 * torch.log2(2 * torch.log(torch.tensor(2.0)) * lambda_ / 12))
        down[-1].weight /= step
        up[-1].weight *= step


def _kernels() -> list[torch.Tensor]:
    """Return the kernels (channels, channels before, taps) of each layer, of the channels that carry the signal."""
    first = torch.zeros(_PASSED_ON[0], 1, 9)
    second = torch.zeros(_PASSED_ON[1], _PASSED_ON[0], 5)
    for channel in range(_PASSED_ON[0]):
        first[channel, 0, 4 + channel] = 1
        for later in range(2):
            second[later * _PASSED_ON[0] + channel, channel, 2 + later] = 1
    # Of the five columns of eight samples that the third layer sees, the transform takes the first four.
    basis = torch.from_numpy(analysis_matrix(HOP_SAMPLES)).float().T.reshape(HOP_SAMPLES, 4, _PASSED_ON[1])
    third = nn.functional.pad(basis.transpose(1, 2), (0, 1))
    return [first, second, third]
