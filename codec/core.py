"""The integer core (firmware/core), compiled while installing and loaded through cffi."""

import sys
from functools import cache
from pathlib import Path
from typing import Any

from cffi import FFI

ffi = FFI()


@cache
def library() -> Any:
    """Load the compiled core; its functions are those of firmware/core/vibrocast_core.h.

    Raises RuntimeError when the core has not been compiled.
    """
    folder = Path(__file__).parent
    compiled = folder / {"darwin": "vibrocast_core.dylib", "win32": "vibrocast_core.dll"}.get(
        sys.platform, "vibrocast_core.so"
    )
    if not compiled.exists():
        raise RuntimeError("the C core is not compiled; install vibrocast with pip, or run `make install`")
    ffi.cdef((folder / "vibrocast_core.cdef").read_text(), override=True)
    return ffi.dlopen(str(compiled))


class Structure:
    """Memory for a structure of the core, alive as long as this object; `pointer` is what the core's functions take."""

    def __init__(self, size: int, kind: str) -> None:
        self._memory = ffi.new("int64_t[]", -(-size // 8))
        self.pointer = ffi.cast(kind, self._memory)
