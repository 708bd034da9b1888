"""The codec `eva`: the EVA paper's autoencoder and adaptive arithmetic coding; layout: docs/reference/bitstream.md."""

from collections.abc import Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.core import RATE_CONTROLLED, UNIT, CoreDecoder, CoreEncoder, PacketwiseEncoder, step_code, step_of
from vibrocast.codec.eva_image import EvaImage, learned_transform, with_runtime
from vibrocast.codec.graphs import (
    CONTEXT_COLUMNS,
    HOP,
    LATENTS,
    MAX_PACKET_COLUMNS,
    SIGNAL,
    Transform,
    transform,
)
from vibrocast.codec.interface import (
    Codec,
    CodecError,
    Decoded,
    Decoder,
    Framing,
    Model,
    ModelTables,
    Parameter,
    RateControl,
    RatePoints,
    Setting,
    Signal,
    SignalFormat,
    Steps,
    numbers,
)
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.firmware.native_core import ffi, library

NAME = "eva"
IDENTIFIER = 4
MIN_LEVEL, MAX_LEVEL = 2.0**-10, 2.0**10
MIN_SEARCHED_LEVEL = 2.0**-1
"""The integers hold signals four times as loud as those of calibration (export/quantise.py), peaks included."""

_REACH = 28
"""Samples on each side that a column of latents depends on, and acts on (export/eva.py)."""
_LOOK_AHEAD = _REACH + 1 - HOP
"""Samples beyond its own hop that a column depends on."""
_COLUMNS_BEFORE, _COLUMNS_AFTER = 2, 1
"""Columns around a packet that the analysis also takes, so that edge effects stay out of the packet."""
_HISTORY = HOP * _COLUMNS_BEFORE + _LOOK_AHEAD
_MAX_LATENT = 32767
"""Largest magnitude of a latent, in the unit of the integers."""
_QUANTISER_OFFSETS_OF_OCTAVE = 16
_CODES_OF_QUANTISER_OFFSET = 4
"""Step codes, 64 to an octave, in one unit of the quantiser offset."""


class LatentEncoder(CoreEncoder):
    """Encoder of latents into packets: all of `eva` except its analysis."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes, refresh_packets: int) -> None:
        """Make an encoder from the codec's bytes in the stream header and a model image's payload.

        Raises CodecError when they are not valid.
        """
        self._model = ffi.new("uint8_t[]", payload)
        super().__init__(NAME, configuration, channels, self._model, len(payload), refresh_packets)

    def encode(self, levels: Sequence[NDArray[np.int32]], quantiser_offset: int = 0) -> bytes:
        """Return the next packet of levels, int32 (latents, columns) for each channel, in the packet's quantiser steps.

        `quantiser_offset`: of a rate-controlled stream. Raises CodecError if the packet is too long.
        """
        stacked = np.stack(levels)
        return self.packet(stacked.shape[2] * HOP, stacked.transpose(0, 2, 1), quantiser_offset)


class EvaEncoder(PacketwiseEncoder):
    """Encoder of `eva`; see codec.interface.Encoder. Samples beyond full scale are clipped to it.

    The analysis runs once for each packet, on exactly the samples that the packet depends on. So packets do not depend
    on how the samples arrive.
    """

    delay_samples = _REACH + _LOOK_AHEAD
    _history = _HISTORY

    def __init__(
        self,
        levels: Sequence[float],
        framing: Framing,
        model: Model,
        rate_control: RateControl | None = None,
    ) -> None:
        """Make an encoder of len(levels) channels.

        `levels`: for each channel, the level relative to full scale by which the network's input is divided.
        `rate_control`: chooses the quantiser offset of each packet, in 1/16 octave of the step; None = all have a step
        of 1. Raises CodecError for a channel count, packet length or model that the codec cannot have, and if the model
        brings no analysis that fits.
        """
        super().__init__(len(levels), framing, HOP, MAX_PACKET_COLUMNS)
        self._image = image = EvaImage.unpack(model.tables)
        if not model.analysis:
            raise CodecError(
                "the model brings no analysis, which encoding needs; give the folder with its analysis.onnx"
            )
        self._analysis = transform(model.analysis, SIGNAL, LATENTS)
        level_codes = [step_code(level) for level in levels]
        self.configuration = configuration(self._packet_blocks, level_codes, rate_control is not None)
        self._rate_control = rate_control
        # From the coarsest unit of the integers to a step more than twice the largest latent: silence, which fits any
        # rate.
        finest = -_QUANTISER_OFFSETS_OF_OCTAVE * int(np.min(image.fraction_bits))
        self._quantiser_offsets = range(finest, finest + _QUANTISER_OFFSETS_OF_OCTAVE * 16 + 1)
        self._levels = [step_of(code) / UNIT for code in level_codes]
        self._encoder = LatentEncoder(self.configuration, self._channels, model.tables, framing.refresh_packets)

    def _code_packets(self, samples: Signal) -> list[bytes]:
        starts = range(0, len(samples) - _HISTORY, self.packet_samples)
        return [self._code(samples[start : start + _HISTORY + self.packet_samples]) for start in starts]

    def _code(self, samples: Signal) -> bytes:
        latents = [self._analyse(channel, level) for channel, level in zip(samples.T, self._levels, strict=True)]

        def code(encoder: LatentEncoder, quantiser_offset: int) -> bytes:
            step = offset_step(quantiser_offset)
            return encoder.encode([np.rint(part / step).astype(np.int32) for part in latents], quantiser_offset)

        late = samples[_HISTORY - self.delay_samples :][: self.packet_samples]
        return self._chosen(late, partial(code, self._encoder), lambda offset: code(copy(self._encoder), offset))

    def _analyse(self, samples: Signal, level: float) -> Signal:
        """Return the latents (latents, columns) of one channel's samples for a packet."""
        columns = _COLUMNS_BEFORE + self._packet_blocks + _COLUMNS_AFTER
        signal = np.zeros((1, 1, columns * HOP), dtype=np.float32)
        signal[0, 0, : len(samples)] = samples / level
        latents = run(self._analysis, signal, (1, self._image.latents, columns))[0]
        most = _MAX_LATENT / np.exp2(self._image.fraction_bits)[:, None]  # the decoders' limit
        own = latents[:, _COLUMNS_BEFORE : _COLUMNS_BEFORE + self._packet_blocks]
        return np.asarray(np.clip(own.astype(np.float64), -most, most))


class EvaDecoder(CoreDecoder):
    """Decoder of `eva` by the integer core; see codec.interface.Decoder."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes) -> None:
        """Make a decoder from the codec's bytes in the stream header and a model image's payload.

        Raises CodecError when they are not valid.
        """
        self._model = ffi.new("uint8_t[]", payload)
        super().__init__(NAME, configuration, channels, self._model, len(payload))


class OnnxDecoder(EvaDecoder):
    """Decoder of `eva`: the integer core decodes the latents, and ONNX Runtime synthesises the samples."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes) -> None:
        """Make a decoder as `EvaDecoder`. Raises CodecError also if the model's graph cannot run."""
        super().__init__(configuration, channels, payload)
        image = EvaImage.unpack(payload)
        self._synthesis = transform(image.graph, LATENTS, SIGNAL)
        self._units = np.exp2(-image.fraction_bits.astype(np.float32))[:, None]
        head_bytes = 1 + (configuration[0] >> 7)
        level_codes = np.frombuffer(configuration, "<u2", channels, head_bytes)
        self._levels = [step_of(int(code)) / 256 for code in level_codes]
        # For each channel the latents of the last columns, then those of the packet.
        columns = CONTEXT_COLUMNS + self.packet_samples // HOP
        self._latents = np.zeros((channels, columns, image.latents), dtype=np.int16)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet. Raises CodecError when it is malformed, or the model's graph fails."""
        fresh = np.empty_like(self._latents[:, CONTEXT_COLUMNS:])
        pointer = ffi.cast("int16_t *", fresh.ctypes.data)
        if library().vc_eva_decode_latents(self.pointer, packet, len(packet), pointer) < 0:
            raise CodecError("a packet is damaged, or another codec made it; copy or encode the stream again")
        return self._synthesise(fresh)

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last latents faded out, then silence."""
        fresh = np.empty_like(self._latents[:, CONTEXT_COLUMNS:])
        library().vc_eva_decode_latents(self.pointer, ffi.NULL, 0, ffi.cast("int16_t *", fresh.ctypes.data))
        return self._synthesise(fresh)

    def _synthesise(self, fresh: NDArray[np.int16]) -> Decoded:
        self._latents = np.concatenate([self._latents[:, -CONTEXT_COLUMNS:], fresh], axis=1)
        samples = np.empty((self.packet_samples, self.channels), dtype=np.int16)
        start = CONTEXT_COLUMNS * HOP - _REACH
        for channel, (latents, level) in enumerate(zip(self._latents, self._levels, strict=True)):
            values = latents.T[None].astype(np.float32) * self._units
            signal = run(self._synthesis, values, (1, 1, len(latents) * HOP))[0, 0, start : start + len(samples)]
            samples[:, channel] = np.clip(np.rint(signal.astype(np.float64) * level), -32768, 32767)
        return samples


def configuration(columns: int, level_codes: Sequence[int], rate_controlled: bool = False) -> bytes:
    """Return the codec's bytes in the stream header."""
    return pack_varint(columns) + np.array(level_codes, "<u2").tobytes() + RATE_CONTROLLED * rate_controlled


def offset_step(quantiser_offset: int) -> float:
    """Return the quantiser step of a packet in the graphs' unit: about 2^(quantiser_offset / 16)."""
    octaves, part = divmod(_CODES_OF_QUANTISER_OFFSET * quantiser_offset, 64)
    return (1 + part / 64) * 2.0**octaves


def run(graph: Transform, values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Run a graph; check that its result is finite and has this shape. Raises CodecError if not."""
    result = graph(values)
    if result.shape != shape or not np.all(np.isfinite(result)):
        flaw = f"gives an array of shape {result.shape}" if result.shape != shape else "gives NaN or infinity"
        raise CodecError(
            f"the ONNX graph {flaw} where {shape} is needed, so it belongs to another model; export it again"
        )
    return result


def make_encoder(
    setting: Setting,
    signal_format: SignalFormat,
    framing: Framing,
    model: Model | None,
    rate_control: RateControl | None = None,
) -> EvaEncoder:
    """Make an encoder whose levels are relative to the RMS values. Raises CodecError as `EvaEncoder`."""
    if model is None:
        raise CodecError("the codec eva needs a model; give one of its model images")
    relative_levels = numbers(setting, "level", signal_format.channels)
    levels = [level * rms for level, rms in zip(relative_levels, signal_format.rms, strict=True)]
    return EvaEncoder(levels, framing, model, rate_control)


def make_decoder(configuration: bytes, channels: int, tables: bytes | None = None) -> Decoder:
    """Make a decoder for the runtime that the model prefers. Raises CodecError as `EvaDecoder`, and without a model."""
    if tables is None:
        raise CodecError("the codec eva needs a model; give the model image that the stream was coded for")
    onnx = EvaImage.unpack(tables).runtime == "onnx"
    return (OnnxDecoder if onnx else EvaDecoder)(configuration, channels, tables)


def check_tables(tables: bytes) -> None:
    """Raise CodecError for a payload that decoders reject, or whose graph cannot synthesise its latents."""
    image, one_column = EvaImage.unpack(tables), configuration(1, [0])
    EvaDecoder(one_column, 1, tables)
    if image.graph:
        OnnxDecoder(one_column, 1, tables).conceal()


CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="the EVA paper's autoencoder, one model for each rate; adaptive binary arithmetic coding",
    parameters={
        "level": Parameter(
            "divisor of the network's input, relative to the RMS value; a higher one is coarser",
            1.0,
            low=MIN_LEVEL,
            high=MAX_LEVEL,
            per_channel=True,
        ),
    },
    rate_point_sets={NAME: RatePoints(({"level": 1.0},))},
    make_encoder=make_encoder,
    make_decoder=make_decoder,
    tables=ModelTables(
        check_tables,
        with_runtime=with_runtime,
        runtime_of=lambda payload: EvaImage.unpack(payload).runtime,
        learned_transform=learned_transform,
    ),
    steps=Steps("level", lambda signal_format: (MIN_SEARCHED_LEVEL, MAX_LEVEL)),
    controls_rate=True,
)
