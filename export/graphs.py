"""EVA's transforms as ONNX graphs, checked, and compared with torch."""

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vibrocast.codec.graphs import LATENTS, OPSET, SIGNAL, Transform
from vibrocast.export.eva import HOP_SAMPLES, DeadZone, Eva, Gdn
from vibrocast.models import ModelError

PARITY = 1e-5
"""Largest difference between torch and ONNX Runtime, relative to the full scale of the compared values."""
PARITY_LENGTHS = (1, 7, 15, 16, 17, 31, 100, 333, 1000, 2801, 4096, 9999, 10_000)
"""Lengths of the compared signals, in samples."""


@dataclass(frozen=True)
class Graphs:
    """A model's two graphs, as bytes of ONNX.

    `analysis`: "signal" (batch, 1, 16 n) to "latents" (batch, latents, n); `synthesis` the reverse. Opset 17, float32.
    `analysis_difference`, `synthesis_difference`: the largest between torch and ONNX Runtime, as in PARITY.
    """

    analysis: bytes
    synthesis: bytes
    analysis_difference: float
    synthesis_difference: float


def graphs_of(model: Eva, lengths: Sequence[int] = PARITY_LENGTHS) -> Graphs:
    """Return a model's graphs, compared with torch for signals of these lengths, in samples.

    The same model gives the same bytes. Raises ModelError if they differ by more than PARITY.
    """
    analysis = _exported(model.analysis, torch.zeros(1, 1, HOP_SAMPLES), SIGNAL, LATENTS)
    synthesis = _exported(model.synthesis, torch.zeros(1, model.shape.latents, 1), LATENTS, SIGNAL)
    runs_analysis = Transform(analysis, SIGNAL, LATENTS)
    runs_synthesis = Transform(synthesis, LATENTS, SIGNAL)
    differences = []
    for samples in lengths:
        signal = padded_noise(samples)
        with torch.no_grad():
            latents = model.analysis(torch.from_numpy(signal))
            decoded = model.synthesis(latents)
        differences.append(
            (
                _difference(runs_analysis(signal), latents.numpy()),
                _difference(runs_synthesis(latents.numpy()), decoded.numpy()),
            )
        )
    largest = np.max(differences, axis=0)
    if not np.all(largest <= PARITY):
        raise ModelError(
            f"ONNX Runtime and torch differ by {largest[0]:.1e} (analysis) and {largest[1]:.1e} (synthesis) of full "
            f"scale, {PARITY:g} is allowed: the model holds weights far out of proportion; train it again"
        )
    return Graphs(analysis, synthesis, *map(float, largest))


def described(graph: bytes, rate_hz: float) -> bytes:
    """Return a graph whose metadata state what another program needs to run it; examples/onnx_runtime.py does.

    `rate_hz`: of the signals. `samples_per_column`: of latents. `scaling`: what a signal is divided by before the
    analysis, and multiplied by after the synthesis. `latent_step`: the distance of the quantised latents.
    """
    model = onnx.load_from_string(graph)
    stated = {"rate_hz": f"{rate_hz:g}", "samples_per_column": f"{HOP_SAMPLES}", "scaling": "rms", "latent_step": "1"}
    onnx.helper.set_model_props(model, stated)
    return bytes(model.SerializeToString(deterministic=True))


def padded_noise(samples: int) -> NDArray[np.float32]:
    """Return white noise of RMS value 1 as a signal (1, 1, 16 n): `samples` of noise, then zeros."""
    noise = np.random.default_rng(samples).standard_normal(samples)
    return np.pad(noise, (0, -samples % HOP_SAMPLES)).astype(np.float32)[None, None]


def _exported(transform: nn.Sequential, example: Tensor, source: str, result: str) -> bytes:
    """Return a transform as a checked graph from the input named `source` to the output named `result`."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter that torch prefers needs onnxscript, and writes the same operators.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            nn.Sequential(*map(_fixed, transform)).eval(),
            (example,),
            buffer,  # type: ignore[arg-type]  # it also takes a buffer
            dynamo=False,
            opset_version=OPSET,
            input_names=[source],
            output_names=[result],
            dynamic_axes={name: {0: "batch", 2: f"{name}_time"} for name in (source, result)},
        )
    graph = onnx.load_from_string(buffer.getvalue())
    graph.doc_string = f"EVA, {source} to {result}; exported by vibrocast"
    onnx.checker.check_model(graph, full_check=True)
    return bytes(graph.SerializeToString(deterministic=True))


class _FixedGdn(nn.Module):
    """A trained GDN whose norm is a plain convolution with bias; its parameters are made positive beforehand."""

    def __init__(self, trained: Gdn) -> None:
        super().__init__()
        self.inverse = trained.inverse
        channels = len(trained.beta)
        self.energy = nn.Conv1d(channels, channels, 1)
        with torch.no_grad():
            self.energy.weight.copy_(trained.gamma[:, :, None])
            assert self.energy.bias is not None
            self.energy.bias.copy_(trained.beta)

    def forward(self, x: Tensor) -> Tensor:
        norm = torch.sqrt(self.energy(x * x))
        return x * norm if self.inverse else x / norm


class _FixedDeadZone(nn.Module):
    """A dead zone whose constant is the bias of a convolution, so that no other operator is needed."""

    def __init__(self, given: DeadZone) -> None:
        super().__init__()
        self.raised = nn.Conv1d(given.channels, given.channels, 1)
        with torch.no_grad():
            self.raised.weight.copy_(torch.eye(given.channels)[:, :, None])
            assert self.raised.bias is not None
            self.raised.bias.fill_(given.constant)

    def forward(self, x: Tensor) -> Tensor:
        square = x * x
        raised: Tensor = self.raised(square)
        return x * square / raised


def _fixed(layer: nn.Module) -> nn.Module:
    if isinstance(layer, DeadZone):
        return _FixedDeadZone(layer)
    return _FixedGdn(layer) if isinstance(layer, Gdn) else layer


def _difference(values: NDArray[np.float32], expected: NDArray[np.float32]) -> float:
    """Return the largest difference relative to the peak of the expected values; infinity if those are silent."""
    peak = np.max(np.abs(expected))
    return float(np.max(np.abs(values - expected)) / peak) if peak > 0 else np.inf
