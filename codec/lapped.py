"""The codec `lapped`: `mdct` with learned windows of four hops; layout in docs/reference/bitstream.md."""

from collections.abc import Sequence
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec import mdct
from vibrocast.codec.core import UNIT, CoreDecoder
from vibrocast.codec.interface import (
    Codec,
    CodecError,
    Estimate,
    Framing,
    Model,
    RateControl,
    Setting,
    Signal,
    SignalFormat,
)
from vibrocast.codec.mdct import HOPS, MdctEncoder
from vibrocast.firmware.native_core import ffi

NAME = "lapped"
IDENTIFIER = 12
WINDOWS_BYTES = 4 * sum(HOPS)
_WINDOW_UNIT = 2**15


def pack_windows(windows: list[Signal]) -> bytes:
    """Return the windows that begin a model image: for each of HOPS the first half, 2 hop values within +-1."""
    return b"".join(np.clip(np.rint(half * _WINDOW_UNIT), -32767, 32767).astype("<i2").tobytes() for half in windows)


@cache
def analysis_matrix(windows: bytes, hop: int) -> Signal:
    """Return the extended lapped transform (4 hop, hop) with a window of a model image; its transpose synthesises.

    Malvar, "Extended lapped transforms: properties, applications, and fast algorithms", 1992, overlap 4.
    """
    half = np.frombuffer(windows, "<i2", 2 * hop, 4 * (hop - HOPS[0])) / _WINDOW_UNIT
    return mdct.modulated(np.concatenate([half, half[::-1]]), hop)


def parts(payload: bytes | None) -> tuple[bytes, bytes]:
    """Return the windows in a model image's payload, and the rest: tables of `mdct`. Raises CodecError."""
    if payload is None:
        raise CodecError("the codec lapped needs a model; give one of its model images")
    if len(payload) < WINDOWS_BYTES:
        raise CodecError(
            f"the model image has {len(payload)} bytes, and the windows of lapped take {WINDOWS_BYTES}; give another"
        )
    windows, tables = payload[:WINDOWS_BYTES], payload[WINDOWS_BYTES:]
    mdct.check_tables(tables)
    return windows, tables


class LappedDecoder(CoreDecoder):
    """Decoder of `lapped`; see codec.interface.Decoder."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes | None = None) -> None:
        """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
        windows, tables = parts(payload)
        self._model = ffi.new("uint8_t[]", windows + tables)
        super().__init__(NAME, configuration, channels, self._model, len(windows + tables))


def check_tables(payload: bytes) -> None:
    """Raise CodecError for the payload of a model image that does not belong to this codec."""
    parts(payload)


def resolve(samples: Signal, signal_format: SignalFormat, model: Model | None, words: Setting) -> Setting:
    """Choose the hop and the rotation of a file with the model's windows; see codec.interface.Codec."""
    payload = parts(model.tables if model else None)[0] + mdct.built_in_tables()
    return mdct.best_choice(samples, signal_format, words, _transform(model), partial(LappedDecoder, payload=payload))


def estimate(samples: Signal, signal_format: SignalFormat, setting: Setting, model: Model | None) -> Estimate:
    """Estimate bits and error of coding a signal, by the step; see codec.interface.Codec."""
    return mdct.estimate(samples, signal_format, setting, model, _transform(model))


def transform(windows: bytes) -> mdct.Transform:
    """Return the transform with the windows of a model image."""

    def spectra(samples: Signal, hop: int) -> NDArray[np.int32]:
        every = np.lib.stride_tricks.sliding_window_view(samples, 4 * hop, axis=0)[::hop]
        return mdct.limited(every @ analysis_matrix(windows, hop) * UNIT)

    return mdct.Transform(4, spectra)


def _transform(model: Model | None) -> mdct.Transform:
    """Return the transform of a model. Raises CodecError without one."""
    return transform(parts(model.tables if model else None)[0])


def make_encoder(
    setting: Setting,
    signal_format: SignalFormat,
    framing: Framing,
    model: Model | None,
    rate_control: RateControl | None = None,
) -> MdctEncoder:
    """Make an encoder: that of `mdct` with the model's windows. Raises CodecError like it, and without a model."""
    windows, tables = parts(model.tables if model else None)
    return mdct.make_encoder(setting, signal_format, framing, Model(tables), rate_control, transform(windows))


def repack(
    configuration: bytes, channels: int, tables: bytes | None, packets: Sequence[bytes], packet_samples: int
) -> tuple[bytes, list[bytes]]:
    """Code the levels of packets again as `mdct` does; see codec.interface.Codec."""
    return mdct.repack(configuration, channels, parts(tables)[1], packets, packet_samples)


CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="learned lapped transform over four hops, quantised and coded as in mdct",
    parameters=mdct.CODEC.parameters,
    rate_point_sets={NAME: mdct.CODEC.rate_point_sets[mdct.NAME]},
    make_encoder=make_encoder,
    make_decoder=LappedDecoder,
    resolve=resolve,
    check_tables=check_tables,
    repack=repack,
    needs_model=True,
    controls_rate=True,
    step_parameter=mdct.CODEC.step_parameter,
    step_range=mdct.CODEC.step_range,
    estimate=estimate,
    block_parameter=mdct.CODEC.block_parameter,
    shape_parameter=mdct.CODEC.shape_parameter,
    live_setting=mdct.CODEC.live_setting,
)
