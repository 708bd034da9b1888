"""The firmware's C functions, built for this machine and called through cffi."""

from typing import Any

from cffi import FFI

from vibrocast.firmware.build import build


def load(**sizes: int) -> tuple[Any, Any]:
    """Return a build with sizes of firmware/controller/sizes.h: its declarations (FFI), and its functions."""
    library = build("native", sizes)
    declarations = FFI()
    declarations.cdef(library.with_suffix(".cdef").read_text(), override=True)
    return declarations, declarations.dlopen(str(library))


ffi, native = load()


def piece_bytes(piece: Any) -> bytes:
    """Return the bytes of a vc_piece."""
    return bytes(ffi.buffer(piece.bytes, piece.length)) if piece.length else b""


def refusal_text(refusal: Any) -> str:
    """Return the text of a vc_refusal."""
    return bytes(ffi.buffer(refusal.text, refusal.length)).decode()
