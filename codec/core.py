"""What the codecs of the integer core share: their decoder, and the errors of their encoders."""

import copy
from typing import Any, Self

import numpy as np

from vibrocast.codec.interface import CodecError, Decoded, check_channels
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES
from vibrocast.firmware.native_core import Structure, ffi, library

UNIT = 32_768 * 256
"""Full scale in the core's unit, 1/256 of a sample's least significant bit."""


def check_made(status: int) -> None:
    """Raise CodecError where the core did not take a configuration."""
    if status != library().VC_OK:
        raise CodecError("the codec configuration is damaged or of another version")


def does_not_fit(packet_samples: int) -> CodecError:
    """Return the error of a packet that would be longer than MAX_PACKET_BYTES."""
    return CodecError(
        f"a packet of {packet_samples} samples does not fit {MAX_PACKET_BYTES} bytes; "
        "ask for shorter packets or a coarser quality"
    )


class CoreDecoder:
    """Decoder of a codec of the core, by its functions vc_NAME_...; see codec.interface.Decoder."""

    delay_samples = 0

    def __init__(self, name: str, configuration: bytes, channels: int, *tables: Any) -> None:
        """Make a decoder from the codec's bytes in the stream header; `tables`: what its init function takes besides.

        Raises CodecError when they are not valid.
        """
        check_channels(channels)
        self.channels = channels
        size, init, packet_samples, self._decode, self._conceal = (
            getattr(library(), f"vc_{name}_{function}")
            for function in ("decoder_size", "decoder_init", "decoder_packet_samples", "decode", "conceal")
        )
        self._state = Structure(size(), f"vc_{name}_decoder *")
        check_made(init(self._state.pointer, configuration, len(configuration), channels, *tables))
        self.packet_samples: int = packet_samples(self._state.pointer)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError when it is malformed."""
        samples, pointer = self._output()
        if self._decode(self._state.pointer, packet, len(packet), pointer) < 0:
            raise CodecError("a packet that is damaged, or was not made by this codec")
        return samples

    def conceal(self) -> Decoded:
        """Stand in for one missing packet: the last sound faded out, then silence."""
        samples, pointer = self._output()
        self._conceal(self._state.pointer, pointer)
        return samples

    def copy(self) -> Self:
        """Return an independent decoder in the same state: what it is given, this one never sees."""
        twin = copy.copy(self)
        twin._state = self._state.copy()
        return twin

    def _output(self) -> tuple[Decoded, Any]:
        samples = np.empty((self.packet_samples, self.channels), dtype=np.int16)
        return samples, ffi.cast("int16_t *", samples.ctypes.data)
