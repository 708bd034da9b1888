"""Priors: the statistics of latents that an entropy coder expects, as bits that training can lower."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

_MIN_PROBABILITY = 2.0**-16
_NEIGHBOURS = 2
_COLUMNS = 3
_AVERAGED_COLUMNS = 24
_AVERAGE_FORGETS = 1 / 8
_ESTIMATES = 4
_MIN_SCALE = 0.02


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


class ContextPrior(nn.Module):
    """A Laplace density whose scale follows earlier magnitudes: a differentiable stand-in for adaptive coding.

    Four weighted sums of neighbouring magnitudes - two lower channels of this column, five channels of the last three,
    and a running average - each plus a constant, are combined as powers, with weights for each channel. The sums start
    as the expected magnitude of firmware/src/core/vc_mdct_model.c.
    """

    def __init__(self, latents: int) -> None:
        super().__init__()
        # Channels k - 2 to k + 2 by columns t - 3 to t, of magnitudes and of their running average.
        expected = torch.zeros(2, 2 * _NEIGHBOURS + 1, _COLUMNS + 1)
        expected[0, :, 3] = torch.tensor([8.0, 28.0, 0.0, 0.0, 0.0])
        expected[0, :, 2] = torch.tensor([1.0, 6.0, 21.0, 18.0, 2.0])
        expected[0, :, 1] = torch.tensor([1.0, 1.0, 12.0, 3.0, 1.0])
        expected[0, :, 0] = torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0])
        expected[1, :, 3] = torch.tensor([1.0, 2.0, 26.0, 2.0, 1.0])
        spread = torch.tensor([0.25, 0.5, 1.0, 2.0])[:, None, None, None]
        known = (expected > 0).float()
        self.register_buffer("known", known, persistent=False)
        self.root_weight = nn.Parameter(torch.sqrt((expected / 128) ** spread * known))
        self.root_constant = nn.Parameter(torch.full((_ESTIMATES,), 0.4))
        self.power = nn.Parameter(torch.tensor([0.1, 0.2, 0.6, 0.1])[:, None].repeat(1, latents))
        self.offset = nn.Parameter(torch.zeros(latents))
        self.step_power = nn.Parameter(torch.zeros(latents))
        average = _AVERAGE_FORGETS * (1 - _AVERAGE_FORGETS) ** torch.arange(_AVERAGED_COLUMNS - 1, -1, -1)
        self.register_buffer("average", average[None, None], persistent=False)

    def scales(self, contexts: Tensor, steps: Tensor) -> Tensor:
        """Return the expected magnitudes, in steps, of latents (batch, channels, columns) before they are known."""
        columns = contexts.shape[2]
        magnitudes = torch.abs(contexts)
        earlier = nn.functional.pad(magnitudes.reshape(-1, 1, columns), (_AVERAGED_COLUMNS, -1))
        average = nn.functional.conv1d(earlier, self.get_buffer("average")).reshape(magnitudes.shape)
        both = nn.functional.pad(torch.stack([magnitudes, average], 1), (_COLUMNS, 0, _NEIGHBOURS, _NEIGHBOURS))
        weight = self.root_weight**2 * self.get_buffer("known")
        sums = torch.log(nn.functional.conv2d(both, weight, self.root_constant**2 + 1e-3))
        exponent = torch.einsum("bekt,ek->bkt", sums, self.power)
        exponent = exponent + (self.offset + self.step_power * torch.log(steps[:, :, 0]))[:, :, None]
        return torch.exp(exponent.clamp(max=20.0)) + _MIN_SCALE

    def bits(self, values: Tensor, contexts: Tensor, steps: Tensor) -> Tensor:
        """Return the bits of each of `values`, in steps, given the latents before it: all (batch, latents, columns).

        `contexts`: the rounded latents, in steps. When a latent is coded, those of its column's lower channels and of
        all earlier columns are known. `steps`: (batch, latents, 1). In training `values` hold noise in place of
        rounding.
        """
        return laplace_bits(values, self.scales(contexts, steps))


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
    return laplace_bits(values, torch.abs(through).mean(dim=2, keepdim=True) + _MIN_SCALE)


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
