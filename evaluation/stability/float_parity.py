"""The same ONNX graphs under other options, as on another machine, and how far the results lie apart."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.eva_image import EvaImage
from vibrocast.codec.graphs import HOP, LATENTS, SIGNAL
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.stability.maps import Map, Row, Scope, at_level
from vibrocast.evaluation.stability.signals import RATE_HZ, encoded, texture
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
from vibrocast.evaluation.trained import runtimes

Values = NDArray[np.float32]

HELD_MILLIONTHS, FAILED_MILLIONTHS = 10.0, 1000.0
"""Largest difference of two runs, relative to the peak: the limit for ONNX graphs against torch, and -60 dB."""
PIECE_COLUMNS, MARGIN_COLUMNS = 16, 4
_WAYS: dict[str, tuple[str, int, bool]] = {
    "no optimisation": ("ORT_DISABLE_ALL", 1, False),
    "basic optimisation": ("ORT_ENABLE_BASIC", 1, False),
    "extended optimisation": ("ORT_ENABLE_EXTENDED", 1, False),
    "2 threads": ("ORT_ENABLE_ALL", 2, False),
    "in pieces": ("ORT_ENABLE_ALL", 1, True),
}
"""Level of optimisation in ONNX Runtime, threads, whether the signal is cut into overlapping pieces."""


def run(
    graph: bytes, source: str, result: str, values: Values, level: str = "ORT_ENABLE_ALL", threads: int = 1
) -> Values:
    """Return a graph's result for values (1, channels, time), by ONNX Runtime with these options."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = getattr(onnxruntime.GraphOptimizationLevel, level)
    options.intra_op_num_threads = threads
    session: Any = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([result], {source: values})[0])


def _in_pieces(transform: Callable[[Values], Values], values: Values, hop_in: int, hop_out: int) -> Values:
    """Return the transforms of pieces of PIECE_COLUMNS columns, each computed with MARGIN_COLUMNS around it."""
    columns = values.shape[2] // hop_in
    parts = []
    for start in range(0, columns, PIECE_COLUMNS):
        end = min(start + PIECE_COLUMNS, columns)
        first, last = max(0, start - MARGIN_COLUMNS), min(end + MARGIN_COLUMNS, columns)
        made = transform(values[:, :, first * hop_in : last * hop_in])
        parts.append(made[:, :, (start - first) * hop_out : (end - first) * hop_out])
    return np.concatenate(parts, axis=2)


def _latents(rate_point: RatePoint) -> tuple[Values, Values]:
    """Return a texture (1, 1, time) as the network gets it, and its latents (1, latents, columns)."""
    samples = texture()
    samples = samples[: len(samples) // HOP * HOP] / np.sqrt(np.mean(samples**2))
    signal = samples.T[None].astype(np.float32)
    return signal, run(rate_point.trained.analysis, SIGNAL, LATENTS, signal)


def measure_analysis(trial: Trial) -> Measured:
    """Run the analysis in another way; count the latents that are rounded to other integers."""
    rate_point, way = trial.rate_point, trial.case.removeprefix("analysis, ")
    signal, latents = _latents(rate_point)
    other = _otherwise(way, partial(run, rate_point.trained.analysis, SIGNAL, LATENTS), signal, HOP, 1)
    rounded = float(np.mean(np.rint(latents) != np.rint(other)))
    return _judged(latents, other, {"rounded_otherwise_per_million": 1e6 * rounded})


def measure_synthesis(trial: Trial) -> Measured:
    """Run the synthesis in another way on the same integers."""
    rate_point, way = trial.rate_point, trial.case.removeprefix("synthesis, ")
    _, latents = _latents(rate_point)
    synthesis = partial(run, EvaImage.unpack(rate_point.trained.tables).graph, LATENTS, SIGNAL)
    values = np.rint(latents)
    return _judged(synthesis(values), _otherwise(way, synthesis, values, 1, HOP), {})


def _otherwise(way: str, graph: Callable[..., Values], values: Values, hop_in: int, hop_out: int) -> Values:
    """Return a graph's result in one of _WAYS."""
    level, threads, pieces = _WAYS[way]
    transform = partial(graph, level=level, threads=threads)
    return _in_pieces(transform, values, hop_in, hop_out) if pieces else transform(values)


def _judged(values: Values, other: Values, figures: dict[str, float | None]) -> Measured:
    difference = float(np.max(np.abs(values - other)) / np.max(np.abs(values)))
    effect = f"{difference:.1e} of the peak"
    if "rounded_otherwise_per_million" in figures:
        effect += f", {figures['rounded_otherwise_per_million']:.0f} of a million latents rounded otherwise"
    return graded(
        1e6 * difference,
        HELD_MILLIONTHS,
        FAILED_MILLIONTHS,
        {"difference_millionths": 1e6 * difference, **figures},
        effect,
    )


def measure_core(trial: Trial) -> Measured:
    """Decode with the integer core while ONNX Runtime cannot be imported; the samples must not differ.

    Raises CodecError.
    """
    stream = replace(encoded(texture(), RATE_HZ, trial.rate_point), runtime="core")
    wanted = stream.decode_integers()
    with patch.dict(sys.modules, {"onnxruntime": None}):
        decoded = stream.decode_integers()
    off = int(np.max(np.abs(wanted.astype(int) - decoded)))
    return Measured(Outcome.HOLDS if off == 0 else Outcome.FAILS, {"difference_millionths": 1e6 * off / 32768})


def _with_analysis(scope: Scope, runtime: str | None = None) -> Iterator[Trial]:
    """Yield the beginnings of trials of models with an analysis, of those that a runtime decodes if one is given."""
    for begun in at_level("middle", scope.learned):
        trained = begun.rate_point.trained
        if trained.analysis and (runtime is None or runtime in runtimes(trained)):
            yield begun


PARITY = Map(
    "float_parity",
    globals(),
    [
        Row(measure_analysis, _with_analysis, [f"analysis, {way}" for way in _WAYS], case_step=4),
        Row(
            measure_synthesis,
            lambda scope: _with_analysis(scope, "onnx"),
            [f"synthesis, {way}" for way in _WAYS],
            case_step=4,
        ),
        Row(measure_core, lambda scope: _with_analysis(scope, "core"), ["integer core, without ONNX Runtime"]),
    ],
)
