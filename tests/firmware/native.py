"""The firmware's C functions, called through cffi: those that are installed, and builds with other sizes."""

from functools import cache
from typing import Any

from cffi import FFI

from vibrocast.firmware import native_core
from vibrocast.firmware.build import build


@cache
def load(**sizes: int) -> tuple[Any, Any]:
    """Return a build with sizes of firmware/include/vibrocast/sizes.h: its declarations (FFI), and its functions."""
    library = build("native", sizes)
    declarations = FFI()
    declarations.cdef(library.with_suffix(".cdef").read_text(), override=True)
    return declarations, declarations.dlopen(str(library))


native: Any = native_core.library()
ffi: Any = native_core.ffi


def piece_bytes(piece: Any) -> bytes:
    """Return the bytes of a vc_piece."""
    return bytes(ffi.buffer(piece.bytes, piece.length)) if piece.length else b""


def rejection_text(rejection: Any) -> str:
    """Return the text of a vc_rejection."""
    return bytes(ffi.buffer(rejection.text, rejection.length)).decode()
