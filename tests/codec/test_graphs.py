"""Tests of graphs from elsewhere: what is no graph of a transform is refused, in words."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from codec import CodecError
from codec.graphs import LATENTS, SIGNAL, Transform, transform


def graph(source: str, result: str, operator: str = "Neg", kind: int = TensorProto.FLOAT, axes: int = 3) -> bytes:
    shape: list[str | int | None] = ["batch", 1, "time"]
    ends = [helper.make_tensor_value_info(name, kind, shape[:axes]) for name in (source, result)]
    made = helper.make_graph([helper.make_node(operator, [source], [result])], "test", ends[:1], ends[1:])
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def test_a_graph_runs_and_is_loaded_once() -> None:
    loaded = transform(graph(SIGNAL, LATENTS), SIGNAL, LATENTS)
    assert transform(graph(SIGNAL, LATENTS), SIGNAL, LATENTS) is loaded
    np.testing.assert_array_equal(loaded(np.ones((1, 1, 4), dtype=np.float32)), -np.ones((1, 1, 4)))
    assert (loaded.source_channels, loaded.result_channels) == (1, 1)


@pytest.mark.parametrize(
    "foreign",
    [
        b"",
        b"no graph",
        graph("input", "output"),
        graph(LATENTS, SIGNAL),
        graph(SIGNAL, LATENTS, kind=TensorProto.DOUBLE),
        graph(SIGNAL, LATENTS, axes=2),
        graph(SIGNAL, LATENTS, operator="NoSuchOperator"),
    ],
    ids=["nothing", "text", "other names", "the other way round", "double", "two axes", "unknown operator"],
)
def test_foreign_graphs_are_refused(foreign: bytes) -> None:
    with pytest.raises(CodecError, match="give a graph that `vibrocast export` wrote"):
        Transform(foreign, SIGNAL, LATENTS)


def test_a_graph_that_fails_on_what_it_is_given_says_so() -> None:
    with pytest.raises(CodecError, match="fails on an array of shape"):
        Transform(graph(SIGNAL, LATENTS), SIGNAL, LATENTS)(np.ones((1, 2), dtype=np.float32))


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_damaged_graphs_never_raise_anything_else(data: st.DataObject) -> None:
    whole = bytearray(graph(SIGNAL, LATENTS))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    try:
        result = Transform(bytes(whole), SIGNAL, LATENTS)(np.ones((1, 1, 4), dtype=np.float32))
    except CodecError:
        return
    assert result.dtype == np.float32
