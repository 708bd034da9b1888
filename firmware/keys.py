"""Keys and signatures of Ed25519 (RFC 8032) by vc_ed25519.h, and key files in PEM (RFC 8410)."""

import base64
import os
import re
import secrets
from pathlib import Path

from vibrocast.errors import InputError
from vibrocast.files import atomic_write, read_input
from vibrocast.firmware.native_core import ffi, library

KEY_BYTES = 32
SIGNATURE_BYTES = 64

_MAX_FILE_BYTES = 1000
# DER before the key itself: RFC 8410, sections 4 and 7.
_DER = {
    "PRIVATE": bytes.fromhex("302e020100300506032b657004220420"),
    "PUBLIC": bytes.fromhex("302a300506032b6570032100"),
}
_PEM = re.compile(r"-----BEGIN (PRIVATE|PUBLIC) KEY-----\s([A-Za-z0-9+/=\s]+)-----END \1 KEY-----\s*", re.ASCII)
# The neutral element, encoded (RFC 8032, section 5.1.2), and 0: with a public key of small order, this signature is
# right for every message.
_FORGERY = (1).to_bytes(KEY_BYTES, "little") + bytes(KEY_BYTES)


def new_private_key() -> bytes:
    """Return a private key, 32 random bytes."""
    return secrets.token_bytes(KEY_BYTES)


def public_key(private_key: bytes) -> bytes:
    """Return the public key of a private one, 32 bytes."""
    key = ffi.new("uint8_t[]", KEY_BYTES)
    library().vc_ed25519_public_key(private_key, key)
    return bytes(key)


def sign(private_key: bytes, message: bytes) -> bytes:
    """Return the signature of a message, 64 bytes."""
    signature = ffi.new("uint8_t[]", SIGNATURE_BYTES)
    library().vc_ed25519_sign(private_key, message, len(message), signature)
    return bytes(signature)


def is_signed(signature: bytes, public_key: bytes, message: bytes) -> bool:
    """Return whether the owner of a public key has signed a message so. Keys have 32 bytes, signatures 64."""
    return bool(library().vc_ed25519_check(signature, public_key, message, len(message)))


def write_private_key(path: Path, private_key: bytes) -> None:
    """Write a private key to a new file that only its owner can read. Raises OSError, also where the file exists."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "w", encoding="ascii") as file:
        file.write(_pem("PRIVATE", private_key))


def write_public_key(path: Path, public_key: bytes) -> None:
    """Write a public key. Raises OSError."""
    with atomic_write(path) as partial:
        partial.write_text(_pem("PUBLIC", public_key), encoding="ascii")


def read_private_key(path: Path) -> bytes:
    """Return the key in a file of a private key. Raises InputError for another file, OSError."""
    kind, key = _read(path)
    if kind != "PRIVATE":
        raise InputError(f"{path}: a public key, which signs nothing; give the private key")
    return key


def read_public_key(path: Path) -> bytes:
    """Return the public key in a file of a public or of a private key. Raises InputError for another file, OSError.

    Rejects the few keys for which anyone can sign, such as zeros.
    """
    kind, key = _read(path)
    found = public_key(key) if kind == "PRIVATE" else key
    if is_signed(_FORGERY, found, b""):
        raise InputError(f"{path}: anyone can sign for this key; make another with `vibrocast keys new`")
    return found


def _pem(kind: str, key: bytes) -> str:
    return f"-----BEGIN {kind} KEY-----\n{base64.b64encode(_DER[kind] + key).decode()}\n-----END {kind} KEY-----\n"


def _read(path: Path) -> tuple[str, bytes]:
    """Return "PRIVATE" or "PUBLIC", and the key."""
    data = read_input(path, "key in PEM", b"-----BEGIN ", _MAX_FILE_BYTES)
    match = _PEM.fullmatch(data.decode("latin-1"))
    if match is not None:
        kind = match[1]
        try:
            der = base64.b64decode("".join(match[2].split()), validate=True)
        except ValueError:
            der = b""
        if der.startswith(_DER[kind]) and len(der) == len(_DER[kind]) + KEY_BYTES:
            return kind, der[-KEY_BYTES:]
    raise InputError(f"{path}: no key of Ed25519 without a password; make one with `vibrocast keys new`")
