"""Keys and signatures of Ed25519 (RFC 8032) by the package cryptography, and key files in PEM (RFC 8410)."""

import base64
import re
import secrets
from pathlib import Path
from typing import TYPE_CHECKING

from vibrocast import extras
from vibrocast.errors import InputError
from vibrocast.files import atomic_write, read_input

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

KEY_BYTES = 32
SIGNATURE_BYTES = 64

_MAX_FILE_BYTES = 1000
# DER before the key itself: RFC 8410, sections 4 and 7.
_DER = {
    "PRIVATE": bytes.fromhex("302e020100300506032b657004220420"),
    "PUBLIC": bytes.fromhex("302a300506032b6570032100"),
}
_PEM = re.compile(r"-----BEGIN (PRIVATE|PUBLIC) KEY-----\s([A-Za-z0-9+/=\s]+)-----END \1 KEY-----\s*", re.ASCII)
_PRIME = 2**255 - 19
# y of the points of small order (RFC 8032, section 5.1): for such a key, anyone finds a signature of any message.
_ORDER_8_Y = 0x05FC536D880238B13933C6D305ACDFD5F098EFF289F4C345B027B2C28F95E826
_SMALL_ORDER_Y = {0, 1, _PRIME - 1, _ORDER_8_Y, _PRIME - _ORDER_8_Y}


def new_private_key() -> bytes:
    """Return a private key, 32 random bytes."""
    return secrets.token_bytes(KEY_BYTES)


def public_key(private_key: bytes) -> bytes:
    """Return the public key of a private one, 32 bytes. Raises MissingExtraError."""
    return _loaded(private_key).public_key().public_bytes_raw()


def sign(private_key: bytes, message: bytes) -> bytes:
    """Return the signature of a message, 64 bytes. Raises MissingExtraError."""
    return _loaded(private_key).sign(message)


def _loaded(private_key: bytes) -> "Ed25519PrivateKey":
    """Return a private key as the package has it, which loads slowly and which few commands need."""
    extras.require("keys", "cryptography")
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    return Ed25519PrivateKey.from_private_bytes(private_key)


def is_signed(signature: bytes, public_key: bytes, message: bytes) -> bool:
    """Return whether the owner of a public key has signed a message so. Keys have 32 bytes, signatures 64.

    Raises MissingExtraError.
    """
    extras.require("keys", "cryptography")
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, message)
    except InvalidSignature:
        return False
    return True


def write_private_key(path: Path, private_key: bytes) -> None:
    """Write a private key to a file that only its owner can read. Raises OSError."""
    with atomic_write(path) as partial:
        partial.chmod(0o600)  # before it holds the key
        partial.write_text(_pem("PRIVATE", private_key), encoding="ascii")


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

    Rejects the few keys for which anyone can sign, such as zeros. Raises MissingExtraError for a private key.
    """
    kind, key = _read(path)
    found = public_key(key) if kind == "PRIVATE" else key
    if int.from_bytes(found, "little") % 2**255 % _PRIME in _SMALL_ORDER_Y:
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
