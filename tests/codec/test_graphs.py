"""Tests of graphs from elsewhere: others than graphs of a transform are rejected, in words."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import NodeProto, TensorProto, ValueInfoProto, helper, numpy_helper

from vibrocast.codec import CodecError
from vibrocast.codec.graphs import LATENTS, MAX_MEMORY_BYTES, SIGNAL, Transform, transform


def bytes_of(nodes: list[NodeProto], ends: list[ValueInfoProto], weights: list[TensorProto]) -> bytes:
    made = helper.make_graph(nodes, "test", ends[:1], ends[1:], weights)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def graph(source: str, result: str, operator: str = "Neg", kind: int = TensorProto.FLOAT, axes: int = 3) -> bytes:
    shape: list[str | int | None] = ["batch", 1, "time"]
    ends = [helper.make_tensor_value_info(name, kind, shape[:axes]) for name in (source, result)]
    return bytes_of([helper.make_node(operator, [source], [result])], ends, [])


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
def test_foreign_graphs_are_rejected(foreign: bytes) -> None:
    with pytest.raises(CodecError, match="give a graph that `vibrocast export` wrote"):
        Transform(foreign, SIGNAL, LATENTS)


def signal_to_latents() -> list[ValueInfoProto]:
    return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 1, "time"]) for name in (SIGNAL, LATENTS)]


def test_a_graph_reads_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").write_bytes(bytes(4))
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    weight.external_data.add(key="location", value="weights")
    foreign = bytes_of([helper.make_node("Add", [SIGNAL, "w"], [LATENTS])], signal_to_latents(), [weight])
    with pytest.raises(CodecError, match="no ONNX graph that can be run"):
        Transform(foreign, SIGNAL, LATENTS)


def test_a_graph_that_may_run_for_ever_is_rejected() -> None:
    body = helper.make_graph(
        [helper.make_node("Identity", ["going_on"], ["go_on"]), helper.make_node("Neg", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("turn", TensorProto.INT64, []),
            helper.make_tensor_value_info("going_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
        ],
    )
    weights = [
        numpy_helper.from_array(np.array(2**62), "turns"),
        numpy_helper.from_array(np.array(True), "yes"),
    ]
    foreign = bytes_of(
        [helper.make_node("Loop", ["turns", "yes", SIGNAL], [LATENTS], body=body)], signal_to_latents(), weights
    )
    with pytest.raises(CodecError, match="has a loop"):
        Transform(foreign, SIGNAL, LATENTS)


def test_a_graph_that_takes_more_memory_than_it_may_fails() -> None:
    shape = numpy_helper.from_array(np.array([MAX_MEMORY_BYTES // 8, 1, 1]), "shape")
    nodes = [
        helper.make_node("Expand", [SIGNAL, "shape"], ["large"]),
        helper.make_node("ReduceMax", ["large"], [LATENTS], axes=[0]),
    ]
    foreign = Transform(bytes_of(nodes, signal_to_latents(), [shape]), SIGNAL, LATENTS)
    with pytest.raises(CodecError, match="fails on an array of shape"):
        foreign(np.ones((1, 1, 4), dtype=np.float32))


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
