"""The integer core (firmware/core), compiled while installing and loaded through cffi."""

import copy
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from cffi import FFI

from vibrocast.codec.interface import CodecError, Decoded, check_channels

UNIT = 32_768 * 256
"""Full scale in the core's unit, 1/256 of a sample's least significant bit."""
MAX_PACKET_BYTES = 65_535

ffi = FFI()


CORE_VARIABLE = "VIBROCAST_CORE"
"""Environment variable that names the compiled core to load, for tests and to look for faults."""


@cache
def library() -> Any:
    """Load the compiled core; its functions are those of firmware/core/vibrocast_core.h.

    A machine with an x86-64 processor has two cores, "baseline" and "x86_64_v3", which produce the same bits. The
    processor tells which is loaded. Raises RuntimeError if the core has not been compiled, and CodecError if the
    environment variable VIBROCAST_CORE names a core that this machine cannot run.
    """
    folder = Path(__file__).parent
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    baseline, faster = (folder / f"vibrocast_core.{name}{suffix}" for name in ("baseline", "x86_64_v3"))
    if not baseline.exists():
        raise RuntimeError("the C core is not compiled; install vibrocast with pip, or run `make install`")
    ffi.cdef((folder / "vibrocast_core.cdef").read_text(encoding="utf-8"), override=True)
    # Every processor can run the baseline core, so this one asks the processor.
    cores: dict[str, Any] = {"baseline": ffi.dlopen(str(baseline))}
    if cores["baseline"].vc_runs_x86_64_v3() and faster.exists():
        cores["x86_64_v3"] = ffi.dlopen(str(faster))
    name = os.environ.get(CORE_VARIABLE) or list(cores)[-1]
    if name not in cores:
        raise CodecError(f"{CORE_VARIABLE} is {name!r}, which this machine cannot run; set it to {' or '.join(cores)}")
    return cores[name]


class Structure:
    """Memory for a structure of the core, alive as long as this object; `pointer` is what the core's functions take."""

    def __init__(self, size: int, kind: str) -> None:
        self._size, self._kind = size, kind
        self._memory = ffi.new("int64_t[]", -(-size // 8))
        self.pointer = ffi.cast(kind, self._memory)

    def copy(self) -> "Structure":
        """Return another one of the same content; no structure of the core points into itself."""
        twin = Structure(self._size, self._kind)
        ffi.memmove(twin._memory, self._memory, self._size)
        return twin


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
