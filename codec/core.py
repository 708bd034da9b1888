"""Shared parts of codecs: an encoder that gathers packets; the states of encoders and decoders in the integer core."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from vibrocast.codec.interface import (
    CodecError,
    Decoded,
    Framing,
    RateControl,
    Signal,
    Trial,
    check_channels,
    checked_parts,
)
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES
from vibrocast.firmware.native_core import Structure, ffi, library

UNIT = 32_768 * 256
"""Full scale in the core's unit, 1/256 of a sample's least significant bit."""
HOPS = (16, 32, 64, 128)
STEP_CODES = 21 * 64
RATE_CONTROLLED = b"\x01"
"""Features of a stream whose packets state their quantiser offsets; it ends the configuration of `slp` and `eva`."""
_CHUNK_SAMPLES = 1 << 16


def step_code(step: float) -> int:
    """Return the code of the quantiser step nearest `step` (relative to full scale): 64 codes an octave."""
    unit_step = min(max(step * UNIT, 64.0), 127.0 * 2**20)
    exponent = math.floor(math.log2(unit_step / 64))
    return min(max(64 * exponent + round(math.ldexp(unit_step, -exponent)) - 64, 0), STEP_CODES - 1)


def step_of(code: int) -> float:
    """Return the quantiser step of a code, in 1/256 of a sample's least significant bit."""
    return math.ldexp(64 + code % 64, code // 64)


class PacketwiseEncoder(ABC):
    """Base class of encoders: gathers input into packets, and clips samples to full scale."""

    delay_samples = 0
    _history = 0
    """Samples before a packet on which it also depends; zeros before the first."""
    _chunk_samples = _CHUNK_SAMPLES
    _rate_control: RateControl | None = None
    """Chooses the quantiser offset of each packet, one of `_quantiser_offsets`; None = always 0."""
    _quantiser_offsets = range(1)
    _quantiser_offset = 0
    """The last packet's."""

    def __init__(self, channels: int, framing: Framing, block: int, max_blocks: int) -> None:
        """Gather into packets of whole blocks of `block` samples, at most `max_blocks` of them.

        Raises CodecError for a channel count or packet length that the codec cannot have.
        """
        check_channels(channels)
        self._packet_blocks = -(-framing.packet_samples // block)
        if not 1 <= self._packet_blocks <= max_blocks:
            raise CodecError(
                f"packets of {framing.packet_samples} samples are not possible; give 1 to {max_blocks * block}"
            )
        self.packet_samples = self._packet_blocks * block
        self._channels = channels
        self._pending: Signal = np.zeros((self._history, channels))
        self._begun = False

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), return packets completed. Raises CodecError on NaN, infinity or a wrong shape."""
        packets: list[bytes] = []
        for part in checked_parts(samples, self._channels, self._chunk_samples):
            self._begun = True
            packets += self._complete(part)
        return packets

    def finish(self) -> list[bytes]:
        """Pad with zeros and return the remaining packets, so that every input sample can be decoded."""
        if not self._begun:
            return []
        self._begun = False
        left = len(self._pending) - self._history
        packets = -(-(left + self.delay_samples) // self.packet_samples)
        return self._complete(np.zeros((packets * self.packet_samples - left, self._channels)))

    def _complete(self, samples: Signal) -> list[bytes]:
        gathered = np.concatenate([self._pending, samples])
        taken = (len(gathered) - self._history) // self.packet_samples * self.packet_samples
        self._pending = gathered[taken:]
        return self._code_packets(gathered[: self._history + taken]) if taken else []

    def _chosen(
        self, samples: Signal, code: Callable[[int], bytes], attempt: Callable[[int], bytes] | None = None
    ) -> bytes:
        """Return the packet from `code` at the quantiser offset that the rate control chooses, padded as it chooses.

        `samples`: the input that the packet stands for. `attempt`: like `code`, but leaves the encoder's state as it
        is; None = `code` does so too. Raises CodecError for a choice that no packet can have.
        """
        if self._rate_control is None:
            return code(0)
        offsets = self._quantiser_offsets
        choice = self._rate_control(Trial(samples, offsets, self._quantiser_offset, attempt or code))
        if choice.quantiser_offset not in offsets or choice.min_bytes > MAX_PACKET_BYTES:
            raise CodecError(
                f"the rate control chose a quantiser offset of {choice.quantiser_offset} in {choice.min_bytes} bytes; "
                f"it must choose {offsets[0]} to {offsets[-1]}, in at most {MAX_PACKET_BYTES} bytes"
            )
        self._quantiser_offset = choice.quantiser_offset
        return code(choice.quantiser_offset).ljust(choice.min_bytes, b"\0")

    @abstractmethod
    def _code_packets(self, samples: Signal) -> list[bytes]:
        """Return the packets of samples (n, channels), which begin with the history and fill the last packet."""


def faded_backwards(last: Decoded, fade_samples: int) -> Decoded:
    """Return a substitute for a missing packet: the last one, backwards and faded out, then silence."""
    samples = np.zeros_like(last)
    fade = np.linspace(1, 0, min(fade_samples, len(last)))[:, None]
    samples[: len(fade)] = np.rint(last[::-1][: len(fade)] * fade)
    return samples


def does_not_fit(packet_samples: int) -> CodecError:
    """Return the error of a packet that would be longer than MAX_PACKET_BYTES."""
    return CodecError(
        f"a packet of {packet_samples} samples does not fit {MAX_PACKET_BYTES} bytes; "
        "ask for shorter packets or a coarser quality"
    )


def damaged_packet() -> CodecError:
    """Return the error of a malformed packet."""
    return CodecError("a packet is damaged, or another codec made it; copy or encode the stream again")


class CoreState:
    """The state of a codec's encoder or decoder in the core; copy.copy copies it. Core functions take `pointer`."""

    def __init__(self, name: str, kind: str, configuration: bytes, channels: int, *parameters: Any) -> None:
        """Make it from the codec's bytes in the stream header. `kind`: "encoder" or "decoder".

        `parameters`: further arguments of the core's init function. Raises CodecError where the core rejects them.
        """
        size, init = (getattr(library(), f"vc_{name}_{kind}_{function}") for function in ("size", "init"))
        self._state = Structure(size(), f"vc_{name}_{kind} *")
        if init(self.pointer, configuration, len(configuration), channels, *parameters) != library().VC_OK:
            raise CodecError("the codec configuration is damaged or of another version; encode the recording again")

    @property
    def pointer(self) -> Any:
        """The state."""
        return self._state.pointer

    def __copy__(self) -> Self:
        """Return an independent encoder or decoder in the same state."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__, _state=self._state.copy())
        return twin


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


class CoreEncoder(CoreState):
    """Encoder of a codec in the core: integers in, packets out."""

    def __init__(self, name: str, configuration: bytes, channels: int, *parameters: Any) -> None:
        """Make it from the codec's bytes in the stream header; `parameters`: further arguments of its init function.

        Raises CodecError when they are not valid.
        """
        self._encode = getattr(library(), f"vc_{name}_encode")
        super().__init__(name, "encoder", configuration, channels, *parameters)
        self._packet = ffi.new("uint8_t[]", MAX_PACKET_BYTES)

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
        length = self._encode(self.pointer, *given, self._packet, MAX_PACKET_BYTES)
        if length < 0:
            raise does_not_fit(packet_samples)
        return bytes(ffi.buffer(self._packet, length))


class CoreDecoder(CoreState):
    """Decoder of a codec of the core, which calls its functions vc_NAME_...; see codec.interface.Decoder."""

    hosts_only = False

    def __init__(self, name: str, configuration: bytes, channels: int, *tables: Any) -> None:
        """Make a decoder from the codec's bytes in the stream header; `tables`: further arguments of its init function.

        Raises CodecError when they are not valid.
        """
        check_channels(channels)
        self.channels = channels
        super().__init__(name, "decoder", configuration, channels, *tables)
        core, pointer = library(), self.pointer
        self._decode = getattr(core, f"vc_{name}_decode")
        self.packet_samples: int = getattr(core, f"vc_{name}_decoder_packet_samples")(pointer)
        # Codecs without a delay have no such function.
        self.delay_samples: int = getattr(core, f"vc_{name}_decoder_delay_samples", lambda state: 0)(pointer)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError when it is malformed."""
        samples, pointer = self._output()
        if self._decode(self.pointer, packet, len(packet), pointer) < 0:
            raise damaged_packet()
        return samples

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last sound faded out, then silence."""
        samples, pointer = self._output()
        self._decode(self.pointer, ffi.NULL, 0, pointer)
        return samples

    def _output(self) -> tuple[Decoded, Any]:
        samples = np.empty((self.packet_samples, self.channels), dtype=np.int16)
        return samples, ffi.cast("int16_t *", samples.ctypes.data)
