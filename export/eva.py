"""EVA in torch: analysis and synthesis transforms with divisive normalisation, as in the paper."""

from typing import Annotated

import torch
from torch import Tensor, nn

from vibrocast.toml_tables import Table, within

HOP_SAMPLES = 16
"""Samples of each column of latents: the product of the down-sampling factors 4, 2 and 2."""
REACH_SAMPLES = 28
"""Samples on each side that affect one column of latents, and that it affects: 4 + 4 * 2 + 8 * 2."""
_MIN_BETA = 1e-6
_PEDESTAL = 2.0**-36


class EvaShape(Table, frozen=True):
    """The sizes of a model's arrays: filters of the hidden layers, and latent channels; the paper has 128 of each."""

    width: Annotated[int, within(1, 128)] = 128
    latents: Annotated[int, within(1, 128)] = 128


class Gdn(nn.Module):
    """Generalised divisive normalisation over channels, x_i / sqrt(beta_i + sum_j gamma_ij x_j^2), or its inverse.

    Takes and returns (batch, channels, time). Ballé, Laparra and Simoncelli, "Density modeling of images using a
    generalized normalization transformation", 2016. As there, squaring keeps the parameters positive.
    """

    def __init__(self, channels: int, inverse: bool) -> None:
        super().__init__()
        self.inverse = inverse
        self.root_beta = nn.Parameter(torch.sqrt(torch.ones(channels) + _PEDESTAL))
        self.root_gamma = nn.Parameter(torch.sqrt(0.1 * torch.eye(channels) + _PEDESTAL))

    @property
    def beta(self) -> Tensor:
        """The constant part of each channel's norm, (channels,)."""
        return torch.clamp(self.root_beta**2 - _PEDESTAL, min=_MIN_BETA)

    @property
    def gamma(self) -> Tensor:
        """The weight of each channel's square in each norm, (channels, channels)."""
        return torch.clamp(self.root_gamma**2 - _PEDESTAL, min=0.0)

    def forward(self, x: Tensor) -> Tensor:
        """Return the normalised signal; x and the result are (batch, channels, n)."""
        norm = torch.sqrt(nn.functional.conv1d(x * x, self.gamma[:, :, None], self.beta))
        return x * norm if self.inverse else x / norm


class DeadZone(nn.Module):
    """Makes the bin of zero wider: y^3 / (y^2 + c), which rounds to zero up to a magnitude of 0.5 + `width`.

    Takes and returns (batch, channels, time). Great magnitudes hardly change.
    """

    def __init__(self, channels: int, width: float) -> None:
        super().__init__()
        edge = 0.5 + width
        self.channels, self.constant = channels, 2 * edge**3 - edge**2

    def forward(self, x: Tensor) -> Tensor:
        """Return the narrowed values."""
        square = x * x
        return x if self.constant == 0 else x * square / (square + self.constant)


def analysis_transform(shape: EvaShape) -> nn.Sequential:
    """Return the analysis transform, (batch, 1, 16 n) to (batch, latents, n): kernels 9, 5, 5, down 4, 2, 2, GDN each.

    No layer has a bias, so silence gives silence, and an inverted signal gives inverted latents.
    """
    return nn.Sequential(
        nn.Conv1d(1, shape.width, 9, stride=4, padding=4, bias=False),
        Gdn(shape.width, inverse=False),
        nn.Conv1d(shape.width, shape.width, 5, stride=2, padding=2, bias=False),
        Gdn(shape.width, inverse=False),
        nn.Conv1d(shape.width, shape.latents, 5, stride=2, padding=2, bias=False),
        Gdn(shape.latents, inverse=False),
    )


def synthesis_transform(shape: EvaShape) -> nn.Sequential:
    """Return the synthesis transform, (batch, latents, n) to (batch, 1, 16 n): the analysis mirrored, inverse GDN."""
    return nn.Sequential(
        Gdn(shape.latents, inverse=True),
        nn.ConvTranspose1d(shape.latents, shape.width, 5, stride=2, padding=2, output_padding=1, bias=False),
        Gdn(shape.width, inverse=True),
        nn.ConvTranspose1d(shape.width, shape.width, 5, stride=2, padding=2, output_padding=1, bias=False),
        Gdn(shape.width, inverse=True),
        nn.ConvTranspose1d(shape.width, 1, 9, stride=4, padding=4, output_padding=3, bias=False),
    )


class Eva(nn.Module):
    """The two transforms.

    Signals are (batch, 1, 16 n), scaled to an RMS value of 1; latents (batch, latents, n), for a quantiser of step 1.
    """

    def __init__(self, shape: EvaShape) -> None:
        super().__init__()
        self.shape = shape
        self.analysis = analysis_transform(shape)
        self.synthesis = synthesis_transform(shape)
