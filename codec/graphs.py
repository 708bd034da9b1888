"""Runs transforms of learned codecs in ONNX Runtime, on one thread, after a check of graphs from elsewhere.

The check allows known operators, known shapes and bounded work. Field numbers and wire types: onnx/onnx.proto of ONNX
1.17, and the encoding of Protocol Buffers.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import CodecError
from vibrocast.device_protocol.layout import Reader

SIGNAL = "signal"
"""Name of a graph's samples, float32 (batch, 1, 16 n)."""
LATENTS = "latents"
"""Name of a graph's latents, float32 (batch, latents, n)."""
MAX_MEMORY_BYTES = 2**30
"""Memory limit of all graphs together."""
HOP = 16
"""Samples of each column of latents."""
MAX_PACKET_COLUMNS = 4095
"""Columns of the longest packet."""
CONTEXT_COLUMNS = 4
"""Columns before a packet that ONNX Runtime synthesises again: the first sample depends on three of them."""
_MAX_COLUMNS = CONTEXT_COLUMNS + MAX_PACKET_COLUMNS
_MAX_SAMPLES = {SIGNAL: HOP * _MAX_COLUMNS, LATENTS: _MAX_COLUMNS}

OPSET = 17
"""Version of ONNX's operators that graphs are written in."""
MAX_NODES = 64
"""Most operators in a graph; an EVA's has 13."""
MAX_MULTIPLY_ADDS = 2**31
"""Most multiply-adds of the longest call. The widest EVA, of 128 channels throughout, needs 1.5e9."""
MAX_ELEMENTS = 2**24
"""Most numbers in one array of the longest call. The widest EVA has 2.1e6."""
ADVICE = "give a graph that `vibrocast export` wrote"

_CONVOLUTIONS = ("Conv", "ConvTranspose")
_INPUTS_OF = {"Mul": 2, "Div": 2, "Sqrt": 1}
_COPY = "Identity"  # weights that two operators share
OPERATORS = frozenset({*_CONVOLUTIONS, *_INPUTS_OF, _COPY})
"""The operators that `vibrocast export` writes."""

_FLOAT = 1  # of TensorProto.DataType
_MAX_NUMBER = 2**31 - 1
_VARINT, _BYTES = 0, 2
_Fields = Mapping[str, list[int | bytes]]

# The fields that a message may have, by number. A name with a star may come several times.
_MODEL = {
    1: "ir_version",
    2: "producer",
    3: "producer_version",
    6: "description",
    7: "graph",
    8: "opset",
    14: "metadata*",
}
_OPSET = {1: "domain", 2: "version"}
_GRAPH = {1: "node*", 2: "name", 5: "initializer*", 10: "description", 11: "input", 12: "output"}
_NODE = {1: "input*", 2: "output", 3: "name", 4: "operator", 5: "attribute*"}
_ATTRIBUTE = {1: "name", 3: "number", 8: "numbers*", 20: "kind"}
_TENSOR = {1: "sizes*", 2: "kind", 8: "name", 9: "data"}
_VALUE = {1: "name", 2: "type"}
_TYPE = {1: "tensor"}
_TENSOR_TYPE = {1: "kind", 2: "shape"}
_SHAPE = {1: "axis*"}
_AXIS = {1: "size", 2: "name"}


class Transform:
    """A graph with one float32 input and one float32 output of three axes, ready to run on one thread."""

    def __init__(self, graph: bytes, source: str, result: str) -> None:
        """Load a graph from the input named `source` to the output named `result`.

        Raises CodecError when the bytes are no such graph.
        """
        ends = (End(name, _MAX_SAMPLES[name]) for name in (source, result))
        self.source_channels, self.result_channels = check_graph(graph, *ends)
        onnxruntime = _runtime()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # no log: errors are raised
        options.add_session_config_entry("session.use_env_allocators", "1")
        # ONNX Runtime looks for weights outside the graph in this folder, which holds none: no graph reads files of the
        # user.
        options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            # ONNX Runtime's exceptions have no common class of their own.
            raise CodecError(f"this is no ONNX graph that can be run; {ADVICE}") from error
        self._source, self._result = source, result

    def __call__(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run on (batch, channels, time). Raises CodecError when the graph fails."""
        try:
            (result,) = self._session.run([self._result], {self._source: values})
        except Exception as error:
            raise CodecError(f"the ONNX graph fails on an array of shape {values.shape}; {ADVICE}") from error
        return np.asarray(result)


@cache
def _runtime() -> Any:
    """Load ONNX Runtime and limit its memory: on first use, because it is slow and few streams need it."""
    import onnxruntime

    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    limit = onnxruntime.OrtArenaCfg({"max_mem": MAX_MEMORY_BYTES})
    onnxruntime.create_and_register_allocator(memory, limit)
    return onnxruntime


@lru_cache(maxsize=32)
def transform(graph: bytes, source: str, result: str) -> Transform:
    """Return a loaded graph, the same one for the same bytes. Raises as `Transform`."""
    return Transform(graph, source, result)


@dataclass(frozen=True)
class End:
    """The input or the output of a graph: its name, and the samples of a channel in the longest call."""

    name: str
    samples: int


@dataclass(frozen=True)
class _Array:
    """Channels of an array, and samples of each in the longest call."""

    channels: int
    samples: int


@dataclass(frozen=True)
class _Operator:
    """A node of a graph: its operator, the names of its inputs and its output, its attributes."""

    kind: str
    inputs: list[str]
    output: str
    attributes: Mapping[str, list[int]]


def check_graph(graph: bytes, source: End, result: End) -> tuple[int, int]:
    """Check that a graph has only OPERATORS, and that their work is bounded; return the channels of its two ends.

    All operators must be convolutions over time or work on each number alone. All weights must be in the graph, and all
    lengths must follow from that of the input. In the longest call the graph then stays within MAX_MULTIPLY_ADDS and
    MAX_ELEMENTS. A shorter input makes no array longer, so this holds for all calls.

    Raises CodecError for any other graph. Takes time in proportion to the bytes of the graph.
    """
    model = _message(graph, _MODEL)
    opset = _message(_bytes(model, "opset"), _OPSET)
    if opset.get("domain", [b""]) != [b""] or _number(opset, "version") != OPSET:
        raise _error(f"is not written in version {OPSET} of ONNX's operators")
    content = _message(_bytes(model, "graph"), _GRAPH)
    nodes, tensors = content.get("node", []), content.get("initializer", [])
    if max(len(nodes), len(tensors)) > MAX_NODES:
        raise _error(f"has {len(nodes)} operators and {len(tensors)} weights, and {MAX_NODES} of each are allowed")
    weights = dict(_weight(_message(each, _TENSOR)) for each in tensors)
    name, channels = _end(content, "input")
    if len({name, *weights}) != 1 + len(tensors):
        raise _error("gives two arrays one name")
    arrays = {name: _Array(channels, source.samples)}
    multiply_adds = 0
    for operator in map(_operator, nodes):
        if operator.output in arrays or operator.output in weights:
            raise _error("gives two arrays one name")
        if operator.kind == _COPY and len(operator.inputs) == 1 and operator.inputs[0] in weights:
            weights[operator.output] = weights[operator.inputs[0]]
            continue
        made, work = _applied(operator, arrays, weights)
        arrays[operator.output] = made
        multiply_adds += work
        if made.samples < 1:
            raise _error("has an array without samples")
        if multiply_adds > MAX_MULTIPLY_ADDS or made.channels * made.samples > MAX_ELEMENTS:
            raise _error(
                f"takes too much work: at most {MAX_MULTIPLY_ADDS:.2g} multiply-adds, and {MAX_ELEMENTS:.2g} numbers "
                f"in an array, are allowed for {source.samples} samples of {source.name}"
            )
    ends = (name, *_end(content, "output"))
    wanted = arrays.get(result.name)
    if wanted is None or (source.name, result.name, wanted.channels) != ends or wanted.samples != result.samples:
        raise _error(f"does not turn {source.name} into {result.name}")
    return channels, wanted.channels


def _operator(node: int | bytes) -> _Operator:
    fields = _message(node, _NODE)
    attributes = [_message(each, _ATTRIBUTE) for each in fields.get("attribute", [])]
    return _Operator(
        _text(fields, "operator"),
        [_decoded(each) for each in fields.get("input", [])],
        _text(fields, "output"),
        {_text(each, "name"): _numbers(each.get("number", []) + each.get("numbers", [])) for each in attributes},
    )


def _applied(
    operator: _Operator, arrays: Mapping[str, _Array], weights: Mapping[str, tuple[int, ...]]
) -> tuple[_Array, int]:
    """Return the array that an operator makes in the longest call, and its multiply-adds. Raises CodecError."""
    kind, names, values = operator.kind, operator.inputs, dict(operator.attributes)
    if kind in _INPUTS_OF:
        inputs = {arrays.get(name) for name in names}
        array = inputs.pop() if len(inputs) == 1 and len(names) == _INPUTS_OF[kind] else None
        if array is None or values:
            raise _error(f"has a {kind} of other inputs than arrays of one shape")
        return array, array.channels * array.samples
    if kind not in _CONVOLUTIONS:
        raise _error(f"has the operator {kind[:40]!r}, and only {', '.join(sorted(OPERATORS))} are allowed")
    array, shape = (arrays.get(names[0]), weights.get(names[1])) if len(names) in (2, 3) else (None, None)
    if array is None or shape is None or len(shape) != 3 or (len(names) == 3 and len(weights.get(names[2], ())) != 1):
        raise _error(f"has a {kind} of other inputs than an array, weights over time and a bias")
    transposed = kind == "ConvTranspose"
    kernel, inputs_of, outputs = shape[2], shape[not transposed], shape[transposed]
    strides, pads = values.get("strides", []), values.get("pads", [])
    surplus = values.pop("output_padding", [0]) if transposed else [0]
    expected = {"dilations": [1], "group": [1], "kernel_shape": [kernel], "strides": strides, "pads": pads}
    if values != expected or (len(strides), len(pads), len(surplus)) != (1, 2, 1) or strides == [0]:
        raise _error(f"has a {kind} with other attributes than `vibrocast export` writes")
    if inputs_of != array.channels:
        raise _error(f"has a {kind} of {inputs_of} channels for an array of {array.channels}")
    each = outputs * inputs_of * kernel
    if transposed:
        samples = (array.samples - 1) * strides[0] + kernel - sum(pads) + surplus[0]
        return _Array(outputs, samples), each * array.samples
    samples = (array.samples + sum(pads) - kernel) // strides[0] + 1
    return _Array(outputs, samples), each * samples


def _weight(tensor: _Fields) -> tuple[str, tuple[int, ...]]:
    """Return the name and shape of weights that lie in the graph. Raises CodecError for any others."""
    shape = tuple(_numbers(tensor.get("sizes", [])))
    if _number(tensor, "kind") != _FLOAT or not all(shape) or len(_bytes(tensor, "data")) != 4 * prod(shape):
        raise _error("has weights that are not 32-bit floats, or not in the graph itself")
    return _text(tensor, "name"), shape


def _end(graph: _Fields, which: str) -> tuple[str, int]:
    """Return name and channels of the input or output: float32 (batch, channels, time). Raises CodecError."""
    value = _message(_bytes(graph, which), _VALUE)
    tensor = _message(_bytes(_message(_bytes(value, "type"), _TYPE), "tensor"), _TENSOR_TYPE)
    axes = [_message(each, _AXIS) for each in _message(_bytes(tensor, "shape"), _SHAPE).get("axis", [])]
    if _number(tensor, "kind") != _FLOAT or ["size" in axis for axis in axes] != [False, True, False]:
        raise _error(f"has an {which} that is not of floats (batch, channels, time)")
    return _text(value, "name"), _number(axes[1], "size")


def _message(data: int | bytes, names: Mapping[int, str]) -> _Fields:
    """Return the fields of a message by name. Raises CodecError for a field that is not among `names`, or twice."""
    if isinstance(data, int):
        raise _error("is damaged")
    reader = Reader(data, lambda flaw: _error(f"is damaged: {flaw}"))
    fields: dict[str, list[int | bytes]] = {}
    while not reader.at_end:
        field, wire_type = divmod(reader.varint(32), 8)
        name = names.get(field)
        if name is None or wire_type not in (_VARINT, _BYTES):
            raise _error("has parts that `vibrocast export` does not write")
        values = fields.setdefault(name.removesuffix("*"), [])
        values.append(reader.varint(64) if wire_type == _VARINT else reader.take(reader.varint(32)))
        if len(values) > 1 and not name.endswith("*"):
            raise _error("has a part twice")
    return fields


def _bytes(fields: _Fields, name: str) -> bytes:
    (value,) = fields.get(name, [b""])
    if isinstance(value, int):
        raise _error("is damaged")
    return value


def _number(fields: _Fields, name: str) -> int:
    numbers = _numbers(fields.get(name, [0]))
    if len(numbers) != 1:
        raise _error("is damaged")
    return numbers[0]


def _numbers(values: list[int | bytes]) -> list[int]:
    """Return numbers that are stored one by one, or several together, each in the range of lengths."""
    numbers = []
    for value in values:
        if isinstance(value, int):
            numbers.append(value)
            continue
        reader = Reader(value, lambda flaw: _error(f"is damaged: {flaw}"))
        while not reader.at_end:
            numbers.append(reader.varint(64))
    if any(number > _MAX_NUMBER for number in numbers):
        raise _error("has a number that is negative or too large")
    return numbers


def _text(fields: _Fields, name: str) -> str:
    return _decoded(_bytes(fields, name))


def _decoded(value: int | bytes) -> str:
    try:
        return "" if isinstance(value, int) else value.decode("utf-8")
    except UnicodeDecodeError:
        raise _error("is damaged") from None


def _error(flaw: str) -> CodecError:
    return CodecError(f"this ONNX graph {flaw}; {ADVICE}")
