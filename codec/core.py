"""The states of an encoder and of a decoder in the integer core, for all codecs that run there."""

import copy
from typing import Any, Self

import numpy as np

from vibrocast.codec.interface import CodecError, Decoded, check_channels
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES
from vibrocast.firmware.native_core import Structure, ffi, library

UNIT = 32_768 * 256
"""Full scale in the core's unit, 1/256 of a sample's least significant bit."""


def does_not_fit(packet_samples: int) -> CodecError:
    """Return the error of a packet that would be longer than MAX_PACKET_BYTES."""
    return CodecError(
        f"a packet of {packet_samples} samples does not fit {MAX_PACKET_BYTES} bytes; "
        "ask for shorter packets or a coarser quality"
    )


def damaged_packet() -> CodecError:
    """Return the error of a malformed packet."""
    return CodecError("a packet is damaged, or another codec made it; copy or encode the stream again")


def core_state(name: str, kind: str, configuration: bytes, channels: int, *parameters: Any) -> Structure:
    """Return the state of a codec's `kind`, "encoder" or "decoder". Raises CodecError where the core rejects it."""
    size, init = (getattr(library(), f"vc_{name}_{kind}_{function}") for function in ("size", "init"))
    state = Structure(size(), f"vc_{name}_{kind} *")
    if init(state.pointer, configuration, len(configuration), channels, *parameters) != library().VC_OK:
        raise CodecError("the codec configuration is damaged or of another version; encode the recording again")
    return state


def decoding_cycles(identifier: int, configuration: bytes, channels: int, tables: bytes | None) -> int:
    """Return the Cortex-M4 cycles that decoding a sample of all channels takes at 30 dB SNR; 0 = not known.

    The arguments are a stream's codec, the codec's bytes in the header, and the payload of its model image.
    """
    configuration_memory = ffi.new("uint8_t[]", configuration)
    tables_memory = ffi.NULL if tables is None else ffi.new("uint8_t[]", tables)
    coding: Any = ffi.new(
        "vc_coding *",
        {
            "codec": identifier,
            "channels": channels,
            "configuration": configuration_memory,
            "configuration_length": len(configuration),
            "tables": tables_memory,
            "tables_length": len(tables or b""),
        },
    )
    rejected = library().vc_coding_check(coding, ffi.NULL, ffi.new("vc_rejection *"))
    return 0 if rejected else int(coding.cycles_per_sample)


class CoreEncoder:
    """The state of a codec's encoder in the core: integers in, packets out. Core functions take its `pointer`."""

    def __init__(self, name: str, configuration: bytes, channels: int, *parameters: Any) -> None:
        """Make it from the codec's bytes in the stream header; `parameters`: further arguments of its init function.

        Raises CodecError when they are not valid.
        """
        self._encode = getattr(library(), f"vc_{name}_encode")
        self._state = core_state(name, "encoder", configuration, channels, *parameters)
        self._packet = ffi.new("uint8_t[]", MAX_PACKET_BYTES)

    @property
    def pointer(self) -> Any:
        """The state."""
        return self._state.pointer

    def copy(self) -> Self:
        """Return an independent encoder in the same state."""
        twin = copy.copy(self)
        twin._state = self._state.copy()
        return twin

    def packet(self, packet_samples: int, *inputs: Any) -> bytes:
        """Return the next packet; `inputs`: arrays and numbers for the core's function.

        Raises CodecError if the packet is too long.
        """
        given = [
            ffi.from_buffer(f"{each.dtype}_t[]", np.ascontiguousarray(each).data)
            if isinstance(each, np.ndarray)
            else each
            for each in inputs
        ]
        length = self._encode(self._state.pointer, *given, self._packet, MAX_PACKET_BYTES)
        if length < 0:
            raise does_not_fit(packet_samples)
        return bytes(ffi.buffer(self._packet, length))


class CoreDecoder:
    """Decoder of a codec of the core, which calls its functions vc_NAME_...; see codec.interface.Decoder."""

    def __init__(self, name: str, configuration: bytes, channels: int, *tables: Any) -> None:
        """Make a decoder from the codec's bytes in the stream header; `tables`: further arguments of its init function.

        Raises CodecError when they are not valid.
        """
        check_channels(channels)
        self.channels = channels
        self._state = core_state(name, "decoder", configuration, channels, *tables)
        core, pointer = library(), self._state.pointer
        self._decode = getattr(core, f"vc_{name}_decode")
        self.packet_samples: int = getattr(core, f"vc_{name}_decoder_packet_samples")(pointer)
        # Codecs without a delay have no such function.
        self.delay_samples: int = getattr(core, f"vc_{name}_decoder_delay_samples", lambda state: 0)(pointer)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError when it is malformed."""
        samples, pointer = self._output()
        if self._decode(self._state.pointer, packet, len(packet), pointer) < 0:
            raise damaged_packet()
        return samples

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last sound faded out, then silence."""
        samples, pointer = self._output()
        self._decode(self._state.pointer, ffi.NULL, 0, pointer)
        return samples

    def copy(self) -> Self:
        """Return an independent decoder in the same state."""
        twin = copy.copy(self)
        twin._state = self._state.copy()
        return twin

    def _output(self) -> tuple[Decoded, Any]:
        samples = np.empty((self.packet_samples, self.channels), dtype=np.int16)
        return samples, ffi.cast("int16_t *", samples.ctypes.data)
