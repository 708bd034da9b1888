"""Tests of graphs from elsewhere: only those run that the exporter could have written, and whose work is bounded."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import ModelProto, NodeProto, TensorProto, ValueInfoProto, helper, load_from_string, numpy_helper
from onnx.reference import ReferenceEvaluator

from vibrocast import models
from vibrocast.codec import CodecError
from vibrocast.codec.eva_image import EvaImage
from vibrocast.codec.graphs import LATENTS, MAX_NODES, OPERATORS, OPSET, SIGNAL, End, Transform, check_graph, transform
from vibrocast.device_protocol.model_image import ModelImage

ONES = np.ones((1, 1, 16), dtype=np.float32)


def value(name: str, channels: int = 1, kind: int = TensorProto.FLOAT, axes: int = 3) -> ValueInfoProto:
    shape: list[str | int | None] = ["batch", channels, "time"]
    return helper.make_tensor_value_info(name, kind, shape[:axes])


def model_of(
    nodes: Sequence[NodeProto],
    weights: dict[str, Any],
    ends: tuple[ValueInfoProto, ValueInfoProto] | None = None,
    opset: int = OPSET,
) -> ModelProto:
    source, result = ends or (value(SIGNAL), value(LATENTS))
    tensors = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    made = helper.make_graph(nodes, "test", [source], [result], tensors)
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def convolution(source: str, result: str, weights: str = "ones", kind: str = "Conv", **attributes: Any) -> NodeProto:
    usual = {"dilations": [1], "group": 1, "kernel_shape": [16], "pads": [0, 0], "strides": [16]}
    return helper.make_node(kind, [source, weights], [result], **{**usual, **attributes})


def bytes_of(model: ModelProto) -> bytes:
    return bytes(model.SerializeToString())


def sums(
    source: str = SIGNAL,
    result: str = LATENTS,
    ends: tuple[ValueInfoProto, ValueInfoProto] | None = None,
    opset: int = OPSET,
    **attributes: Any,
) -> ModelProto:
    """Return a graph that adds up each 16 samples, or with these attributes."""
    ends = ends or (value(source), value(result))
    return model_of([convolution(source, result, **attributes)], {"ones": ONES}, ends, opset)


def check(model: ModelProto) -> None:
    check_graph(bytes_of(model), End(SIGNAL, 1600), End(LATENTS, 100))


def test_a_graph_runs_and_is_loaded_once() -> None:
    graph = bytes_of(sums())
    loaded = transform(graph, SIGNAL, LATENTS)
    assert transform(graph, SIGNAL, LATENTS) is loaded
    np.testing.assert_array_equal(loaded(np.ones((1, 1, 32), dtype=np.float32)), np.full((1, 1, 2), 16))
    assert (loaded.source_channels, loaded.result_channels) == (1, 1)


def test_every_graph_that_ships_is_allowed() -> None:
    graphs = [(model.analysis, SIGNAL, LATENTS) for model in models.shipped() if model.analysis]
    for path in Path(models.__file__).parent.glob("*/synthesis.onnx"):
        graphs.append((path.read_bytes(), LATENTS, SIGNAL))
    image = Path(__file__).with_name("tiny_eva.vcmi").read_bytes()
    graphs.append((EvaImage.unpack(ModelImage.unpack(image).payload).graph, LATENTS, SIGNAL))
    assert len(graphs) > 40
    found = set()
    for graph, source, result in graphs:
        Transform(graph, source, result)
        found |= {node.op_type for node in load_from_string(graph).graph.node}
    assert found | {"Identity"} == OPERATORS, "the exporter writes Identity for weights that are equal"


def test_a_graph_of_many_products_is_rejected_at_once() -> None:
    nodes = [
        helper.make_node("MatMul", [f"x{number}" if number else SIGNAL, SIGNAL], [f"x{number + 1}"])
        for number in range(4000)
    ]
    graph = bytes_of(model_of([*nodes, convolution("x4000", LATENTS)], {"ones": ONES}))
    assert len(graph) > 100_000
    began_s = time.process_time()
    with pytest.raises(CodecError, match=f"has 4001 operators.*{MAX_NODES}.*give a graph that `vibrocast export`"):
        Transform(graph, SIGNAL, LATENTS)
    assert time.process_time() - began_s < 1


FOREIGN = {
    "nothing": b"",
    "text": b"no graph",
    "other names": bytes_of(sums("input", "output")),
    "the other way round": bytes_of(sums(LATENTS, SIGNAL)),
    "double": bytes_of(sums(ends=(value(SIGNAL, kind=TensorProto.DOUBLE), value(LATENTS)))),
    "two axes": bytes_of(sums(ends=(value(SIGNAL, axes=2), value(LATENTS)))),
    "other operators": bytes_of(sums(opset=18)),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_graphs_are_rejected(name: str) -> None:
    with pytest.raises(CodecError, match=r"this ONNX graph .*give a graph that `vibrocast export` wrote"):
        Transform(FOREIGN[name], SIGNAL, LATENTS)


def with_(change: Callable[[ModelProto], object]) -> ModelProto:
    """Return the graph that adds up, changed so."""
    model = sums()
    change(model)
    return model


def move_weights_to_a_file(model: ModelProto) -> None:
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="weights")


BODY = helper.make_graph([convolution(SIGNAL, "y")], "body", [], [value("y")])
FUNCTION = helper.make_function("own", "F", ["x"], ["y"], [], [helper.make_opsetid("", 17)])
WIDE = np.ones((1024, 1, 1), dtype=np.float32)
CASES = {
    "a subgraph": (
        with_(lambda model: model.graph.node[0].attribute.append(helper.make_attribute("body", BODY))),
        "parts that",
    ),
    "a function": (with_(lambda model: model.functions.append(FUNCTION)), "parts that"),
    "a domain": (with_(lambda model: setattr(model.graph.node[0], "domain", "com.microsoft")), "parts that"),
    "a second domain": (
        with_(lambda model: model.opset_import.append(helper.make_opsetid("com.microsoft", 1))),
        "a part twice",
    ),
    "weights in a file": (with_(move_weights_to_a_file), "parts that"),
    "weights of another length": (
        with_(lambda model: setattr(model.graph.initializer[0], "raw_data", ONES.tobytes() + bytes(4))),
        "has weights that",
    ),
    "a loop": (
        model_of([helper.make_node("Loop", ["turns", "yes", SIGNAL], [LATENTS])], {"turns": np.array(2**62)}),
        "has weights that are not 32-bit floats",
    ),
    "an operator": (model_of([helper.make_node("Neg", [SIGNAL], [LATENTS])], {}), "has the operator 'Neg', and only"),
    "arrays too large": (
        model_of(
            [convolution(SIGNAL, "x", "wide", strides=[1], kernel_shape=[1])],
            {"wide": np.ones((16384, 1, 1), dtype=np.float32)},
        ),
        "takes too much work",
    ),
    "too much work": (
        model_of(
            [
                convolution(SIGNAL, "x", "wide", strides=[1], kernel_shape=[1]),
                convolution("x", "y", "square", strides=[1], kernel_shape=[2]),
            ],
            {"wide": WIDE, "square": np.ones((1024, 1024, 2), dtype=np.float32)},
        ),
        "takes too much work",
    ),
    "too many samples": (
        model_of([convolution(SIGNAL, "x", strides=[1], pads=[2**30, 2**30])], {"ones": ONES}),
        "takes too much work",
    ),
    "samples below none": (
        model_of(
            [convolution(SIGNAL, "x", kind="ConvTranspose", pads=[2**30, 2**30], output_padding=[0])], {"ones": ONES}
        ),
        "without samples",
    ),
    "a negative number": (sums(pads=[-1, 1]), "negative"),
    "no stride": (sums(strides=[0]), "other attributes"),
    "groups": (sums(group=2), "other attributes"),
    "dilation": (sums(dilations=[2]), "other attributes"),
    "automatic padding": (sums(auto_pad="SAME_UPPER"), "parts that"),
    "weights that are computed": (sums(weights=SIGNAL), "other inputs than an array, weights"),
    "an array of weights alone": (
        model_of([helper.make_node("Sqrt", ["ones"], ["x"]), convolution(SIGNAL, LATENTS, "x")], {"ones": ONES}),
        "other inputs than arrays of one shape",
    ),
    "shapes that do not match": (
        model_of([convolution(SIGNAL, "x"), helper.make_node("Mul", [SIGNAL, "x"], [LATENTS])], {"ones": ONES}),
        "other inputs than arrays of one shape",
    ),
    "channels that do not match": (
        model_of([convolution(SIGNAL, LATENTS)], {"ones": np.ones((1, 2, 16), dtype=np.float32)}),
        "2 channels for an array of 1",
    ),
    "another hop": (sums(strides=[8]), "does not turn signal into"),
    "a name twice": (
        model_of([convolution(SIGNAL, LATENTS), convolution(SIGNAL, LATENTS)], {"ones": ONES}),
        "two arrays one name",
    ),
    "weights of the input's name": (model_of([convolution(SIGNAL, LATENTS)], {"ones": ONES, SIGNAL: ONES}), "one name"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_graph_with_anything_else_is_rejected(name: str) -> None:
    model, flaw = CASES[name]
    with pytest.raises(CodecError, match=flaw):
        check(model)


def test_a_graph_that_is_split_in_two_is_rejected() -> None:
    # Protocol Buffers merge two parts of one name, so a check of one part alone would miss the other.
    hidden = ModelProto()
    hidden.graph.node.append(helper.make_node("Neg", [SIGNAL], ["x"]))
    graph = bytes_of(sums()) + bytes_of(hidden)
    assert len(load_from_string(graph).graph.node) == 2
    with pytest.raises(CodecError, match="a part twice"):
        Transform(graph, SIGNAL, LATENTS)


def test_a_graph_reads_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").write_bytes(bytes(64))
    with pytest.raises(CodecError, match="parts that `vibrocast export` does not write"):
        Transform(bytes_of(with_(move_weights_to_a_file)), SIGNAL, LATENTS)


def test_a_graph_that_fails_on_what_it_is_given_says_so() -> None:
    with pytest.raises(CodecError, match="fails on an array of shape"):
        Transform(bytes_of(sums()), SIGNAL, LATENTS)(np.ones((1, 2), dtype=np.float32))


@given(
    st.sampled_from(["Conv", "ConvTranspose"]),
    st.integers(1, 6),
    st.integers(1, 4),
    st.tuples(st.integers(0, 3), st.integers(0, 3)),
    st.integers(0, 3),
    st.integers(1, 12),
)
def test_lengths_are_those_that_onnx_computes(
    kind: str, kernel: int, stride: int, pads: tuple[int, int], surplus: int, samples: int
) -> None:
    attributes: dict[str, Any] = {"kernel_shape": [kernel], "strides": [stride], "pads": list(pads)}
    if kind == "ConvTranspose":
        attributes["output_padding"] = [min(surplus, stride - 1)]
    node = convolution(SIGNAL, LATENTS, "weights", kind, **attributes)
    model = model_of([node], {"weights": np.ones((1, 1, kernel), dtype=np.float32)})
    try:
        (result,) = ReferenceEvaluator(model).run(None, {SIGNAL: np.ones((1, 1, samples), dtype=np.float32)})
        length = np.asarray(result).shape[2]
    except Exception:
        length = 0  # nothing is left of so short an input
    if length < 1:
        with pytest.raises(CodecError):
            check_graph(bytes_of(model), End(SIGNAL, samples), End(LATENTS, 1))
        return
    check_graph(bytes_of(model), End(SIGNAL, samples), End(LATENTS, length))
    with pytest.raises(CodecError, match="does not turn"):
        check_graph(bytes_of(model), End(SIGNAL, samples), End(LATENTS, length + 1))


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_graphs_never_raise_anything_else(data: st.DataObject) -> None:
    whole = bytearray(bytes_of(sums()))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    try:
        result = Transform(bytes(whole), SIGNAL, LATENTS)(np.ones((1, 1, 32), dtype=np.float32))
    except CodecError:
        return
    assert result.dtype == np.float32 and result.shape == (1, 1, 2)


@given(st.binary(max_size=200))
def test_any_bytes_are_checked(data: bytes) -> None:
    with pytest.raises(CodecError):
        check_graph(data, End(SIGNAL, 16), End(LATENTS, 1))
