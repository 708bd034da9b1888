"""Core and controller in C, compiled while installing and loaded through cffi."""

import os
import struct
import sys
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

from cffi import FFI

from vibrocast.errors import BAD_INPUT, VibrocastError

ffi = FFI()
_LOCK = Lock()

CORE_VARIABLE = "VIBROCAST_CORE"
"""Environment variable that names the compiled core to load, for tests and debugging."""


class BuildError(VibrocastError):
    """A failed build, or no compiled core that this machine can run; the message says why, and what to do."""

    exit_code = BAD_INPUT


@cache
def library() -> Any:
    """Load core and controller, once for all threads. Headers of both folders declare the functions.

    A machine with an x86-64 processor has two cores, "baseline" and "x86_64_v3", which produce the same bits. The
    processor decides which is loaded. Raises BuildError if the core has not been compiled, or if the environment
    variable VIBROCAST_CORE names a core that this machine cannot run.
    """
    with _LOCK:  # the function's cache avoids the lock in later calls
        return _loaded()


@cache
def _loaded() -> Any:
    folder = Path(__file__).parent
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    baseline, faster = (folder / f"vibrocast_core.{name}{suffix}" for name in ("baseline", "x86_64_v3"))
    if not baseline.exists():
        raise BuildError("the C core is not compiled; install vibrocast with pip, or run `make install`")
    ffi.cdef((folder / "vibrocast_core.cdef").read_text(encoding="utf-8"), override=True)
    # Every processor can run the baseline core, so this one asks the processor.
    cores: dict[str, Any] = {"baseline": ffi.dlopen(str(baseline))}
    if cores["baseline"].vc_runs_x86_64_v3() and faster.exists():
        cores["x86_64_v3"] = ffi.dlopen(str(faster))
    name = os.environ.get(CORE_VARIABLE) or list(cores)[-1]
    if name not in cores:
        raise BuildError(f"{CORE_VARIABLE} is {name!r}, which this machine cannot run; set it to {' or '.join(cores)}")
    return cores[name]


def float_bits(value: float) -> int:
    """Return the bits of an IEEE 754 single, as which the core takes numbers."""
    bits: int = struct.unpack("<I", struct.pack("<f", value))[0]
    return bits


class Structure:
    """Memory for a structure of the core, alive as long as this object; the core's functions take its `pointer`."""

    def __init__(self, size: int, kind: str) -> None:
        self._size, self._kind = size, kind
        self._memory = ffi.new("int64_t[]", -(-size // 8))
        self.pointer = ffi.cast(kind, self._memory)

    def copy(self) -> "Structure":
        """Return a copy with the same content; no structure of the core points into itself."""
        twin = Structure(self._size, self._kind)
        ffi.memmove(twin._memory, self._memory, self._size)
        return twin
