"""Trains the network of `mdct`, which predicts decisions together with the adaptive contexts, and its tables."""

import math
from collections.abc import Callable
from itertools import cycle, pairwise
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vibrocast.codec import Framing, Signal
from vibrocast.codec.mdct import HOPS, MdctEncoder, analysis_matrix
from vibrocast.export.mdct_training import RATE_HZ, STEP, excerpts

EXAMPLES = 8_000_000
BATCH = 2048
STEPS = 24_000
LEARNING_RATE = 6e-3
HIDDEN = (32, 24)
_EXCERPT_S = 4.0
_EXCERPTS_AT_ONCE = 4
_PACKET_S = 1.5
_QUIET = 0.15  # bits per sample, so that excerpts of almost no bits do not outweigh all others
_WEIGHT_BYTES, _SILENCE_BYTES = 480, 16
_DECISIONS = 6
_UNARY_LIMIT = 15
_INPUT_UNIT, _WEIGHT_UNIT, _BIAS_UNIT = 16, 64, 256  # units of the integers, see docs/reference/bitstream.md

Analysis: TypeAlias = Callable[[int], Signal]
"""Returns the transform at a hop, (samples of a window, hop)."""


def trained(textures: list[Signal], seed: int, tables: bytes, analysis: Analysis = analysis_matrix) -> bytes:
    """Return the payload of a model image, tables and network, trained on textures, (n, 1) each.

    `tables`: to begin with. In the result the contexts have no weight at first, because they are inputs of the network.
    """
    torch.set_num_threads(1)  # gives the same sums in the same order
    tables = averaged_tables(textures, seed, tables, analysis)
    network = train(*examples(textures, seed + 1, tables, analysis), seed + 2)
    cells, _, silence = _parts(tables)
    return cells + bytes(_WEIGHT_BYTES) + silence + network.payload()


def averaged_tables(textures: list[Signal], seed: int, tables: bytes, analysis: Analysis = analysis_matrix) -> bytes:
    """Return the mean of the states that `tables` pass through while excerpts of the textures are coded at every hop.

    A cell depends on its last 32 decisions. So the state at the end of training would be a noisy beginning.
    """
    states = []
    encoder = None
    hops = cycle(HOPS)
    for number, excerpt in enumerate(excerpts(textures, seed)):
        if number % _EXCERPTS_AT_ONCE == 0:
            tables = encoder.adapted_tables() if encoder is not None else tables
            states.append(tables)
            hop = next(hops)
            encoder = MdctEncoder((STEP,), RATE_HZ, Framing(hop, 0), tables, hop=hop, analysis=analysis)
        assert encoder is not None
        encoder.encode(excerpt)
    parts = zip(*map(_parts, states), strict=True)
    return b"".join(
        np.rint(np.mean([np.frombuffer(part, kind) for part in parts_of_kind], axis=0)).astype(kind).tobytes()
        for parts_of_kind, kind in zip(parts, ("i1", "<i2", "u1"), strict=True)
    )


def _parts(tables: bytes) -> tuple[bytes, bytes, bytes]:
    """Return the cells, the weights and the probabilities of silence in tables; see docs/reference/bitstream.md."""
    weights_at = len(tables) - _SILENCE_BYTES - _WEIGHT_BYTES
    return tables[:weights_at], tables[weights_at:-_SILENCE_BYTES], tables[-_SILENCE_BYTES:]


def examples(
    textures: list[Signal], seed: int, tables: bytes, analysis: Analysis = analysis_matrix
) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """Return up to EXAMPLES rows of MdctEncoder.examples, from excerpts coded from a refresh on, and their weights.

    The weights make every excerpt's bits count alike, relative to their sum.
    """
    rows, weights, left = [], [], EXAMPLES
    for excerpt, hop in zip(excerpts(textures, seed, _EXCERPT_S), cycle(HOPS), strict=False):
        framing = Framing(int(_PACKET_S * RATE_HZ), 0)
        encoder = MdctEncoder((STEP,), RATE_HZ, framing, tables, hop=hop, analysis=analysis)
        encoder.record(min(left, len(excerpt)))
        coded_bytes = sum(map(len, encoder.encode(excerpt)))
        rows.append(encoder.examples())
        weights.append(np.full(len(rows[-1]), 1 / (8 * coded_bytes / len(excerpt) + _QUIET), np.float32))
        left -= len(rows[-1])
        if left == 0:
            break
    return np.concatenate(rows), np.concatenate(weights)


class Network(nn.Module):
    """The function vc_network_run in floating point, with weights and biases as the integers have them."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        sizes = (inputs, *HIDDEN, 2 * _DECISIONS)
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(sizes))

    def forward(self, inputs: Tensor) -> Tensor:
        """Take inputs (n, inputs); return ln(p / (1 - p)) of each quantiser's decisions (n, 2, 6)."""
        values = inputs
        for layer in self.layers:
            values = nn.functional.linear(
                torch.relu(values) if layer is not self.layers[0] else values, *_rounded(layer)
            )
        return values.view(-1, 2, _DECISIONS)

    def payload(self) -> bytes:
        """Return the network's bytes in a model image, after the tables."""
        layers = [[part.detach() for part in _rounded(layer)] for layer in self.layers]
        weights, biases = layers.pop()
        layers += [[part.detach() for part in pair] for pair in zip(weights.chunk(2), biases.chunk(2), strict=True)]
        return b"".join(
            (weights * _WEIGHT_UNIT).numpy().astype(np.int8).tobytes()
            + (biases * _BIAS_UNIT).numpy().astype("<i2").tobytes()
            for weights, biases in layers
        )


def _rounded(layer: nn.Module) -> tuple[Tensor, Tensor]:
    """Return weights and biases rounded as the integers are; gradients ignore the rounding."""
    assert isinstance(layer, nn.Linear)
    weights = layer.weight + (_on_grid(layer.weight, _WEIGHT_UNIT, 127) - layer.weight).detach()
    biases = layer.bias + (_on_grid(layer.bias, _BIAS_UNIT, 32767) - layer.bias).detach()
    return weights, biases


def _on_grid(values: Tensor, unit: int, limit: int) -> Tensor:
    return torch.round(values * unit).clamp(-limit, limit) / unit


def bits(logits: Tensor, quantisers: Tensor, indices: Tensor) -> Tensor:
    """Return the bits that the decisions of each index (n,) cost with the predictions (n, 2, 6), without the sign."""
    kinds = torch.arange(_DECISIONS)
    chosen = logits[torch.arange(len(logits)), quantisers]
    last = indices[:, None].clamp(max=_DECISIONS - 1)
    # How often each kind of decision was yes, and no; the last kind repeats.
    yes = (kinds < last).float()
    yes[:, -1] = (indices - _DECISIONS + 1).clamp(min=0).float()
    no = ((kinds == last) & (indices[:, None] < _UNARY_LIMIT)).float()
    softplus = nn.functional.softplus
    return (yes * softplus(-chosen) + no * softplus(chosen)).sum(1) / math.log(2)


def train(rows: NDArray[np.int16], weights: NDArray[np.float32], seed: int) -> Network:
    """Return a network trained on rows and weights from `examples`."""
    torch.manual_seed(seed)
    generator = np.random.default_rng(seed)
    network = Network(rows.shape[1] - 2)
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, STEPS, pct_start=0.05)
    for _ in range(STEPS):
        chosen = generator.integers(0, len(rows), BATCH)
        batch = torch.from_numpy(rows[chosen])
        cost = bits(network(batch[:, :-2].float() / _INPUT_UNIT), batch[:, -2].long(), batch[:, -1].long())
        loss = (cost * torch.from_numpy(weights[chosen])).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    return network
