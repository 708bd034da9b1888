"""Tests of the ONNX graphs: the same numbers as torch, the same bytes again, nothing that the checker minds."""

import numpy as np
import pytest
import torch

from vibrocast.codec.graphs import LATENTS, SIGNAL, Transform
from vibrocast.export import graphs
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.models import ModelError

SHAPE = EvaShape(width=6, latents=5)


def model(seed: int = 1) -> Eva:
    torch.manual_seed(seed)
    return Eva(SHAPE)


@pytest.mark.slow
def test_graphs_equal_torch_at_every_length() -> None:
    made = graphs.graphs_of(model(), (*range(1, 70), 10_000))
    assert max(made.analysis_difference, made.synthesis_difference) <= graphs.PARITY


def test_graphs_take_any_batch_and_any_time() -> None:
    eva = model()
    made = graphs.graphs_of(eva)
    signal = np.random.default_rng(3).standard_normal((3, 1, 160)).astype(np.float32)
    latents = Transform(made.analysis, SIGNAL, LATENTS)(signal)
    assert latents.shape == (3, SHAPE.latents, 10)
    with torch.no_grad():
        np.testing.assert_allclose(latents, eva.analysis(torch.from_numpy(signal)).numpy(), atol=1e-5)
    assert Transform(made.synthesis, LATENTS, SIGNAL)(latents).shape == signal.shape


def test_graphs_that_differ_from_the_model_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "PARITY", 0.0)
    with pytest.raises(ModelError, match="train it again"):
        graphs.graphs_of(model())
