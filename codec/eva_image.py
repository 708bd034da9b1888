"""The payload of EVA's model images: prior, integer synthesis network, ONNX graph; see docs/reference/bitstream.md."""

import struct
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import RUNTIMES, CodecError, LearnedTransform
from vibrocast.device_protocol.layout import Reader

LAYOUT_VERSION = 2
MAX_CHANNELS = 128
"""Most channels of the hidden layers, and of the latents."""
MAX_FRACTION_BITS = 14
UNARY_LIMIT = 15
"""Decisions on a magnitude before its escape code."""
DECISIONS = UNARY_LIMIT + 1
"""Decisions of a level: those on its magnitude, and its sign."""
MAX_SHIFT = 30

PriorKind: TypeAlias = Literal["adaptive", "static"]
"""Whether the prior's probabilities adapt to the stream's latents, as in the EVA paper, or stay."""
PRIOR_KINDS: tuple[PriorKind, ...] = get_args(PriorKind)

# Layout version, flags, width, latents, bytes of the graph.
_FIXED = struct.Struct("<BBBBI")
_STATIC_FLAG, _NETWORK_FLAG, _RUNTIME_FLAG = 1, 2, 4
_KERNELS = (5, 5, 9)
# Taps of each phase of a transposed convolution (stride 2 or 4), in the order of the input columns that they weight.
# The last tap weights the newest column, which all phases take.
_PHASES = {5: ((4, 2, 0), (3, 1)), 9: ((8, 4, 0), (5, 1), (6, 2), (7, 3))}


@dataclass(frozen=True, eq=False)
class Normalisation:
    """An inverse GDN in integers.

    `weights`: int8 (channels, channels), 0 to 127, of each square (second axis) in each norm. `multipliers`,
    `constants`: uint32 (channels,). `shift`: 0 to 30. docs/reference/bitstream.md states their use.
    """

    weights: NDArray[np.int8]
    multipliers: NDArray[np.uint32]
    constants: NDArray[np.uint32]
    shift: int

    def pack(self) -> bytes:
        """Return the bytes in the payload."""
        numbers = b"".join(array.astype("<u4").tobytes() for array in (self.multipliers, self.constants))
        return self.weights.tobytes() + numbers + bytes((self.shift,))


@dataclass(frozen=True, eq=False)
class Convolution:
    """A transposed convolution in integers.

    `weights`: int8 (kernel, outputs, inputs). `multipliers`: uint32 (outputs,), in 1/2^32.
    """

    weights: NDArray[np.int8]
    multipliers: NDArray[np.uint32]

    def pack(self) -> bytes:
        """Return the bytes in the payload: the weights phase by phase, each as (outputs, taps, inputs)."""
        phases = [self.weights[list(taps)].transpose(1, 0, 2) for taps in _PHASES[len(self.weights)]]
        return b"".join(phase.tobytes() for phase in phases) + self.multipliers.astype("<u4").tobytes()


@dataclass(frozen=True, eq=False)
class IntegerNetwork:
    """The synthesis in integers: three times a normalisation, then a convolution."""

    normalisations: tuple[Normalisation, Normalisation, Normalisation]
    convolutions: tuple[Convolution, Convolution, Convolution]

    def pack(self) -> bytes:
        """Return the bytes in the payload."""
        stages = zip(self.normalisations, self.convolutions, strict=True)
        return b"".join(part.pack() for stage in stages for part in stage)


@dataclass(frozen=True, eq=False)
class EvaImage:
    """The content of a model image that a decoder of EVA needs.

    `width`: channels of the hidden layers. `fraction_bits`: uint8 (latents,). In integers, the unit of a latent is
    2^-fraction_bits of the graph's unit, in which the quantiser step is 1. `probabilities`: uint16 (latents, 16), in
    1/65536: that the magnitude of a level is above 0, 1, ... 14, then that it is negative. `prior`: whether they adapt.
    `network`, `graph` (ONNX, "latents" to "signal"): at least one of them is given. `runtime`: the one of RUNTIMES that
    a decoder prefers.
    """

    width: int
    fraction_bits: NDArray[np.uint8]
    probabilities: NDArray[np.uint16]
    prior: PriorKind
    network: IntegerNetwork | None
    graph: bytes
    runtime: str

    @property
    def latents(self) -> int:
        """Channels of the latents."""
        return len(self.probabilities)

    def pack(self) -> bytes:
        """Return the payload. Raises CodecError for values outside the layout."""
        flags = _STATIC_FLAG * (self.prior == "static")
        flags |= _NETWORK_FLAG * (self.network is not None) | _RUNTIME_FLAG * (self.runtime == "onnx")
        network = b"" if self.network is None else self.network.pack()
        fixed = _FIXED.pack(LAYOUT_VERSION, flags, self.width, self.latents, len(self.graph))
        payload = (
            fixed + self.fraction_bits.tobytes() + self.probabilities.astype("<u2").tobytes() + network + self.graph
        )
        EvaImage.unpack(payload)
        return payload

    @classmethod
    def unpack(cls, payload: bytes) -> "EvaImage":
        """Return the content of a payload. Raises CodecError unless the bytes are one whole, valid payload."""
        if payload and payload[0] != LAYOUT_VERSION:
            raise CodecError(
                f"the model image of EVA has layout {payload[0]}, and this version reads layout {LAYOUT_VERSION}; "
                "export the model again"
            )
        reader = _Reader(payload, _damaged)
        _, flags, width, latents, graph_bytes = _FIXED.unpack(reader.take(_FIXED.size))
        _check(flags < 8 and 1 <= width <= MAX_CHANNELS and 1 <= latents <= MAX_CHANNELS)
        fraction_bits = reader.array("u1", latents)
        _check(bool(np.all(fraction_bits <= MAX_FRACTION_BITS)))
        probabilities = reader.array("<u2", latents, DECISIONS).astype(np.uint16)
        network = _network(reader, width, latents) if flags & _NETWORK_FLAG else None
        graph = reader.take(graph_bytes)
        runtime = RUNTIMES[bool(flags & _RUNTIME_FLAG)]
        _check(reader.at_end and (bool(graph) if runtime == "onnx" else network is not None))
        return cls(width, fraction_bits, probabilities, PRIOR_KINDS[flags & _STATIC_FLAG], network, graph, runtime)


def with_runtime(payload: bytes, runtime: str) -> bytes:
    """Return a payload that prefers one of RUNTIMES.

    Raises CodecError if the model lacks the network or graph for that runtime.
    """
    image = EvaImage.unpack(payload)
    if runtime not in RUNTIMES:
        raise CodecError(f"there is no runtime {runtime!r}; choose one of {', '.join(RUNTIMES)}")
    if runtime == "core" and image.network is None:
        raise CodecError("the model has no integer network; decode it by ONNX Runtime (runtime onnx)")
    if runtime == "onnx" and not image.graph:
        raise CodecError("the model has no ONNX graph; decode it by the integer core (runtime core)")
    return replace(image, runtime=runtime).pack()


def learned_transform(payload: bytes) -> LearnedTransform:
    """Return the sizes of the network in a payload. Raises CodecError where it is damaged."""
    image = EvaImage.unpack(payload)
    return LearnedTransform(image.width, len(image.graph))


def _network(reader: "_Reader", width: int, latents: int) -> IntegerNetwork:
    inputs, outputs = (latents, width, width), (width, width, 1)
    normalisations, convolutions = [], []
    for kernel, channels, results in zip(_KERNELS, inputs, outputs, strict=True):
        gamma = reader.array("i1", channels, channels)
        multipliers, constants = (reader.array("<u4", channels).astype(np.uint32) for _ in range(2))
        (shift,) = reader.take(1)
        _check(bool(np.all(gamma >= 0)) and shift <= MAX_SHIFT)
        normalisations.append(Normalisation(gamma, multipliers, constants, shift))
        weights = np.empty((kernel, results, channels), dtype=np.int8)
        for taps in _PHASES[kernel]:
            weights[list(taps)] = reader.array("i1", results, len(taps), channels).transpose(1, 0, 2)
        multipliers = reader.array("<u4", results).astype(np.uint32)
        convolutions.append(Convolution(weights, multipliers))
    first, second, third = normalisations
    return IntegerNetwork((first, second, third), (convolutions[0], convolutions[1], convolutions[2]))


def _damaged(flaw: str) -> CodecError:
    return CodecError(f"the model image of EVA is damaged: {flaw}; export it again")


def _check(valid: bool) -> None:
    if not valid:
        raise _damaged("a value or its length is wrong")


class _Reader(Reader):
    """A Reader that takes arrays too."""

    def array(self, kind: str, *shape: int) -> NDArray[Any]:
        count = int(np.prod(shape))
        return np.frombuffer(self.take(count * np.dtype(kind).itemsize), dtype=kind).reshape(shape)
