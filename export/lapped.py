"""The transforms of `lapped` in torch: for each hop, the window of an extended lapped transform, and a prior."""

import math

import numpy as np
import torch
from torch import Tensor, nn

from vibrocast.codec.interface import Signal
from vibrocast.codec.mdct import HOPS, modulated

REACH_SAMPLES = 3 * max(HOPS)
"""Samples at each end of a signal that lack blocks which a stream has."""
TERMS = 6
"""Terms of the cosine series of each angle over half a hop: windows are smooth, and alike at all hops."""


class Window(nn.Module):
    """The transform of one hop N, always orthogonal: (batch, 1, n) to (batch, N, blocks), and back.

    Two angles for each i < N/2 make the values a, b, c, d of the window at i, N - 1 - i, N + i and 2N - 1 - i. So a^2 +
    b^2 + c^2 + d^2 = 1 and a d + b c = 0. With a symmetric window, this gives perfect reconstruction: Malvar, "Extended
    lapped transforms: properties, applications, and fast algorithms", 1992, overlap 4. The angles start from his window
    in closed form, 1/2 (1/sqrt(2) + cos(pi (n + 1/2 - 2N) / 2N)).
    """

    def __init__(self, hop: int) -> None:
        super().__init__()
        self.hop = hop
        first = torch.arange(hop // 2) + 0.5
        start = 0.5 * (0.5**0.5 + torch.cos(torch.pi * (torch.arange(2 * hop) + 0.5 - 2 * hop) / (2 * hop)))
        b, c, d = start[:hop].flip(0), start[hop:], start[hop:].flip(0)
        angles = torch.stack([torch.atan2(c, d), torch.atan2(b, d)])[:, : hop // 2]
        self.register_buffer("angles", angles, persistent=False)
        series = torch.cos(math.pi * torch.arange(TERMS)[:, None] * first / (hop // 2))
        self.register_buffer("series", series, persistent=False)
        basis = torch.from_numpy(modulated(np.ones(4 * hop), hop).T).float()
        self.register_buffer("basis", basis, persistent=False)
        self.terms = nn.Parameter(torch.zeros(2, TERMS))

    def first_half(self) -> Tensor:
        """Return the first half of the window, (2 N,); the second mirrors it."""
        angles = self.get_buffer("angles") + self.terms @ self.get_buffer("series")
        cosine, sine = torch.cos(angles), torch.sin(angles)
        a, b, c, d = -sine[0] * sine[1], cosine[0] * sine[1], sine[0] * cosine[1], cosine[0] * cosine[1]
        return torch.cat([a, b.flip(0), c, d.flip(0)])

    def matrix(self) -> Tensor:
        """Return the basis functions (N, 1, 4 N)."""
        half = self.first_half()
        return (self.get_buffer("basis") * torch.cat([half, half.flip(0)]))[:, None]


def analysed(signals: Tensor, matrix: Tensor) -> Tensor:
    """Return the coefficients (batch, N, blocks) of signals (batch, 1, n) by basis functions (N, 1, samples)."""
    return nn.functional.conv1d(signals, matrix, stride=len(matrix))


def synthesised(coefficients: Tensor, matrix: Tensor) -> Tensor:
    """Return the signals (batch, 1, n) of coefficients: the inverse of `analysed` where all blocks exist."""
    return nn.functional.conv_transpose1d(coefficients, matrix, stride=len(matrix))


class Lapped(nn.Module):
    """The transforms of every hop in HOPS."""

    def __init__(self) -> None:
        super().__init__()
        self.windows = nn.ModuleList(map(Window, HOPS))

    def halves(self) -> list[Signal]:
        """Return the first half of each window, float64 (2 N,), as a model image has them."""
        with torch.no_grad():
            return [window.first_half().double().numpy() for window in self.windows if isinstance(window, Window)]
