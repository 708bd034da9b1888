"""Priors: the statistics of latents that an entropy coder expects, as bits that training can lower."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

_MIN_PROBABILITY = 2.0**-16
MIN_SCALE = 0.02


class FactorisedPrior(nn.Module):
    """A learned cumulative density for each channel; the probability of a latent is its bin's, of width 1.

    Ballé, Minnen, Singh, Hwang and Johnston, "Variational image compression with a scale hyperprior", 2018, appendix
    6.1, with layers of three.
    """

    _LAYERS = (1, 3, 3, 3, 1)
    _INITIAL_SCALE = 10.0

    def __init__(self, latents: int) -> None:
        super().__init__()
        scale = self._INITIAL_SCALE ** (1 / (len(self._LAYERS) - 1))
        sizes = list(zip(self._LAYERS[:-1], self._LAYERS[1:], strict=True))
        initial = [float(np.log(np.expm1(1 / scale / after))) for _, after in sizes]
        self.matrices = nn.ParameterList(
            torch.full((latents, after, before), value) for (before, after), value in zip(sizes, initial, strict=True)
        )
        self.biases = nn.ParameterList(torch.rand(latents, after, 1) - 0.5 for _, after in sizes)
        self.factors = nn.ParameterList(torch.zeros(latents, after, 1) for _, after in sizes[:-1])

    def logits(self, latents: Tensor) -> Tensor:
        """Return the logit of the cumulative density at values (channels, n) of each channel."""
        hidden = latents[:, None]
        for layer, (matrix, bias) in enumerate(zip(self.matrices, self.biases, strict=True)):
            hidden = nn.functional.softplus(matrix) @ hidden + bias
            if layer < len(self.factors):
                hidden = hidden + torch.tanh(self.factors[layer]) * torch.tanh(hidden)
        return hidden[:, 0]

    def bits(self, values: Tensor) -> Tensor:
        """Return the bits of each of `values` (batch, latents, columns); in training they hold noise, not rounding."""
        channels_first = (values.shape[1], values.shape[0], values.shape[2])
        channels = values.transpose(0, 1).flatten(1)
        lower, upper = (self.logits(channels + offset) for offset in (-0.5, 0.5))
        # The difference of two values near one loses precision; mirrored, they are near zero.
        mirror = -torch.sign(lower + upper).detach()
        probability = torch.abs(torch.sigmoid(mirror * upper) - torch.sigmoid(mirror * lower))
        return -torch.log2(probability.clamp(min=_MIN_PROBABILITY)).reshape(channels_first).transpose(0, 1)


def laplace_bits(values: Tensor, scale: Tensor) -> Tensor:
    """Return the bits of each of `values`: those of its bin of width 1 under a Laplace density of a mean magnitude."""
    magnitude = torch.abs(values)
    # The density over a bin on one side of zero, and around it.
    beyond = (magnitude - 0.5).clamp(min=0) / scale + torch.log(-2 / torch.expm1(-1 / scale))
    inside = torch.exp((magnitude.clamp(max=0.5) - 0.5) / scale) + torch.exp(-(magnitude + 0.5) / scale)
    around = -torch.log1p(-0.5 * inside.clamp(max=2 - 1e-6))
    return torch.where(magnitude >= 0.5, beyond, around) / float(np.log(2))


def adaptive_bits(values: Tensor, rounded: Tensor) -> Tensor:
    """Return the bits of each of `values` (batch, latents, columns) by a coder that has adapted to each excerpt.

    It is a differentiable stand-in for adaptive arithmetic coding: each channel of an excerpt has a Laplace density
    with the mean magnitude of its `rounded` latents. In training `values` hold noise in place of rounding.
    """
    through = values + (rounded - values).detach()
    return laplace_bits(values, torch.abs(through).mean(dim=2, keepdim=True) + MIN_SCALE)


def probabilities(prior: FactorisedPrior, limit: int) -> NDArray[np.float64]:
    """Return the probability of each integer -limit .. limit of each channel: float64 (latents, 2 limit + 1).

    Integers beyond the limits are left out, so the sum of a row may be less than one.
    """
    with torch.no_grad():
        latents = len(prior.biases[0])
        double = FactorisedPrior(latents).double()
        double.load_state_dict(prior.state_dict())
        edges = torch.arange(-limit, limit + 2, dtype=torch.float64) - 0.5
        cumulative = torch.sigmoid(double.logits(edges.expand(latents, -1)))
        return torch.diff(cumulative, dim=1).numpy()
