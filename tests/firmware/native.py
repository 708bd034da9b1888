"""The firmware's C functions, built for this machine and called through cffi."""

from typing import Any

from cffi import FFI

from firmware.build import build

_library = build("native")
ffi: Any = FFI()
ffi.cdef(_library.with_suffix(".cdef").read_text(), override=True)
native: Any = ffi.dlopen(str(_library))


def piece_bytes(piece: Any) -> bytes:
    """Return the bytes of a vc_piece."""
    return bytes(ffi.buffer(piece.bytes, piece.length)) if piece.length else b""


def refusal_text(refusal: Any) -> str:
    """Return the text of a vc_refusal."""
    return bytes(ffi.buffer(refusal.text, refusal.length)).decode()
