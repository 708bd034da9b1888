"""The payload of EVA's model images: steps, prior, integer synthesis network, ONNX graph; see docs/bitstream.md."""

import struct
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import RUNTIMES, CodecError, LearnedTransform
from vibrocast.device_protocol.encoding import Reader
from vibrocast.firmware.native_core import library

LAYOUT_VERSION = 1
MAX_CHANNELS = 128
"""Channels of the hidden layers, and of the latents."""
MAX_RATES = 16
STEP_CODES = 21 * 64
STEPS_PER_UNIT = 4096
"""Quantiser steps are in 1/4096 of the latents' unit."""
UNARY_LIMIT = 15
"""Decisions on a magnitude before its escape code."""
QUALITY_PARTS = 16
"""Qualities in a stream from one rate to the next."""
MAX_SHIFT = 30

PriorKind: TypeAlias = Literal["factorised", "contexts"]
PRIOR_KINDS: tuple[PriorKind, ...] = get_args(PriorKind)

# Layout version, flags, width, latents, rates, fraction bits of the latents, bytes of the graph.
_FIXED = struct.Struct("<BBBBBBI")
_PRIOR_FLAG, _NETWORK_FLAG, _RUNTIME_FLAG = 1, 2, 4
_KERNELS = (5, 5, 9)
# Taps of each phase of a transposed convolution (stride 2 or 4), in the order of the input columns that they weigh, up
# to the newest one, which all phases take.
_PHASES = {5: ((4, 2, 0), (3, 1)), 9: ((8, 4, 0), (5, 1), (6, 2), (7, 3))}


@dataclass(frozen=True, eq=False)
class Normalisation:
    """An inverse GDN in integers.

    `weights`: int8 (channels, channels), 0 to 127, of each square (second axis) in each norm. `multipliers`,
    `constants`: uint32 (channels,). `shift`: 0 to 30. docs/bitstream.md says what they do.
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
    """All that a decoder of EVA needs.

    `width`: channels of the hidden layers. `step_codes`: uint16 (rates, latents), steps as `mdct` codes them, in 1/4096
    of the latents' unit. `fraction_bits`: that unit is 2^-fraction_bits of the graph's. `prior`: either of kind
    factorised, uint16 (rates, latents, 16): probabilities in 1/65536 that the magnitude is above 0, 1, ... 14, then
    that it is negative; or of kind contexts: initial tables of the adaptive model, as those of `mdct`. `network`,
    `graph` (ONNX, "latents" to "signal"): at least one of them is there. `runtime`: which of
    RUNTIMES a decoder prefers.
    """

    width: int
    step_codes: NDArray[np.uint16]
    fraction_bits: int
    prior: NDArray[np.uint16] | bytes
    network: IntegerNetwork | None
    graph: bytes
    runtime: str

    @property
    def rates(self) -> int:
        """Rates that have steps of their own."""
        return int(self.step_codes.shape[0])

    @property
    def finest_quality_code(self) -> int:
        """The quality of the finest rate, in sixteenths of one."""
        return QUALITY_PARTS * (self.rates - 1)

    @property
    def latents(self) -> int:
        """Channels of the latents."""
        return int(self.step_codes.shape[1])

    @property
    def prior_kind(self) -> PriorKind:
        """What the entropy coder goes by."""
        return "contexts" if isinstance(self.prior, bytes) else "factorised"

    def steps(self, quality_code: int) -> NDArray[np.int64]:
        """Return the quantiser steps (latents,) at a quality in sixteenths, in 1/4096 of the latents' unit.

        Between two rates the codes are interpolated.
        """
        below = min(quality_code // QUALITY_PARTS, self.rates - 1)
        above = min(below + 1, self.rates - 1)
        part = quality_code % QUALITY_PARTS
        codes = self.step_codes.astype(np.int64)
        code = (codes[below] * (QUALITY_PARTS - part) + codes[above] * part + QUALITY_PARTS // 2) // QUALITY_PARTS
        return np.asarray((64 + code % 64) << code // 64)

    def relative_steps(self, quality_code: int) -> NDArray[np.float64]:
        """Return the quantiser steps (latents,) at a quality in sixteenths, in the graphs' unit."""
        return np.asarray(self.steps(quality_code) / (STEPS_PER_UNIT * 2.0**self.fraction_bits))

    def pack(self) -> bytes:
        """Return the payload. Raises CodecError for values outside the layout."""
        flags = _PRIOR_FLAG * (self.prior_kind == "contexts")
        flags |= _NETWORK_FLAG * (self.network is not None) | _RUNTIME_FLAG * (self.runtime == "onnx")
        prior = self.prior if isinstance(self.prior, bytes) else self.prior.astype("<u2").tobytes()
        network = b"" if self.network is None else self.network.pack()
        fixed = _FIXED.pack(
            LAYOUT_VERSION, flags, self.width, self.latents, self.rates, self.fraction_bits, len(self.graph)
        )
        payload = fixed + self.step_codes.astype("<u2").tobytes() + prior + network + self.graph
        EvaImage.unpack(payload)
        return payload

    @classmethod
    def unpack(cls, payload: bytes) -> "EvaImage":
        """Return what a payload holds. Raises CodecError unless all of it is one whole, valid payload."""
        reader = _Reader(payload, _damaged)
        version, flags, width, latents, rates, fraction_bits, graph_bytes = _FIXED.unpack(reader.take(_FIXED.size))
        if version != LAYOUT_VERSION:
            raise CodecError(f"a model image of EVA with layout {version}; this version reads layout {LAYOUT_VERSION}")
        _check(flags < 8 and fraction_bits <= 15 and 1 <= rates <= MAX_RATES)
        _check(1 <= width <= MAX_CHANNELS and 1 <= latents <= MAX_CHANNELS)
        step_codes = reader.array("<u2", rates, latents).astype(np.uint16)
        _check(bool(np.all(step_codes < STEP_CODES)))
        prior: NDArray[np.uint16] | bytes
        if flags & _PRIOR_FLAG:
            prior = reader.take(library().vc_mdct_tables_size())
        else:
            prior = reader.array("<u2", rates, latents, UNARY_LIMIT + 1).astype(np.uint16)
        network = _network(reader, width, latents) if flags & _NETWORK_FLAG else None
        graph = reader.take(graph_bytes)
        runtime = RUNTIMES[bool(flags & _RUNTIME_FLAG)]
        _check(reader.at_end and (bool(graph) if runtime == "onnx" else network is not None))
        return cls(width, step_codes, fraction_bits, prior, network, graph, runtime)


def with_runtime(payload: bytes, runtime: str) -> bytes:
    """Return a payload that prefers one of RUNTIMES.

    Raises CodecError where the model does not have what that runtime needs.
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
    """Takes arrays too."""

    def array(self, kind: str, *shape: int) -> NDArray[Any]:
        count = int(np.prod(shape))
        return np.frombuffer(self.take(count * np.dtype(kind).itemsize), dtype=kind).reshape(shape)
