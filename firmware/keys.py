"""Keys and signatures of Ed25519 (RFC 8032) by the package cryptography, and key files in PEM (RFC 8410)."""

import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING

from vibrocast import extras
from vibrocast.files import InputFileError, atomic_write, read_input

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

KEY_BYTES = 32
SIGNATURE_BYTES = 64

_MAX_FILE_BYTES = 1000
_PRIME = 2**255 - 19
# y of the points of small order (RFC 8032, section 5.1): for such a key, anyone finds a signature of any message.
_ORDER_8_Y = 0x05FC536D880238B13933C6D305ACDFD5F098EFF289F4C345B027B2C28F95E826
_SMALL_ORDER_Y = {0, 1, _PRIME - 1, _ORDER_8_Y, _PRIME - _ORDER_8_Y}


def new_private_key() -> bytes:
    """Return a private key, 32 random bytes."""
    return secrets.token_bytes(KEY_BYTES)


def public_key(private_key: bytes) -> bytes:
    """Return the public key of a private one, 32 bytes. Raises MissingExtraError."""
    private, _ = _kinds()
    return private.from_private_bytes(private_key).public_key().public_bytes_raw()


def sign(private_key: bytes, message: bytes) -> bytes:
    """Return the signature of a message, 64 bytes. Raises MissingExtraError."""
    private, _ = _kinds()
    return private.from_private_bytes(private_key).sign(message)


def is_signed(signature: bytes, public_key: bytes, message: bytes) -> bool:
    """Return whether the owner of a public key has signed a message so. Keys have 32 bytes, signatures 64.

    Raises MissingExtraError.
    """
    _, public = _kinds()
    from cryptography.exceptions import InvalidSignature

    try:
        public.from_public_bytes(public_key).verify(signature, message)
    except InvalidSignature:
        return False
    return True


def write_private_key(path: Path, private_key: bytes) -> None:
    """Write a private key to a new file that only its owner can read.

    Raises OSError, also where the file exists, and MissingExtraError.
    """
    private, _ = _kinds()
    content = _pem(private.from_private_bytes(private_key))
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:
        file.write(content)


def write_public_key(path: Path, public_key: bytes) -> None:
    """Write a public key. Raises OSError and MissingExtraError."""
    _, public = _kinds()
    content = _pem(public.from_public_bytes(public_key))
    with atomic_write(path) as partial:
        partial.write_bytes(content)


def read_private_key(path: Path) -> bytes:
    """Return the key in a file of a private key. Raises InputFileError for another file, OSError, MissingExtraError."""
    key = _read(path)
    private, _ = _kinds()
    if not isinstance(key, private):
        raise InputFileError(f"{path}: a public key, which signs nothing; give the private key")
    return key.private_bytes_raw()


def read_public_key(path: Path) -> bytes:
    """Return the public key in a file of a public or of a private key.

    Raises InputFileError for another file and for the few keys for which anyone can sign, such as zeros; OSError,
    MissingExtraError.
    """
    key = _read(path)
    _, public = _kinds()
    found = (key if isinstance(key, public) else key.public_key()).public_bytes_raw()
    if int.from_bytes(found, "little") % 2**255 % _PRIME in _SMALL_ORDER_Y:
        raise InputFileError(f"{path}: anyone can sign for this key; make another with `vibrocast keys new`")
    return found


def _kinds() -> "tuple[type[Ed25519PrivateKey], type[Ed25519PublicKey]]":
    """Return the classes of a private and of a public key; their package loads slowly, and few commands need it."""
    extras.require("keys", "cryptography")
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

    return Ed25519PrivateKey, Ed25519PublicKey


def _pem(key: "Ed25519PrivateKey | Ed25519PublicKey") -> bytes:
    """Return the content of a key's file."""
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

    private, _ = _kinds()
    if isinstance(key, private):
        return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return key.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)


def _read(path: Path) -> "Ed25519PrivateKey | Ed25519PublicKey":
    """Return the key in a file that holds nothing else."""
    kinds = _kinds()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_pem_public_key

    data = read_input(path, "key in PEM", b"-----BEGIN ", _MAX_FILE_BYTES)
    try:
        key = load_pem_private_key(data, None) if b" PRIVATE " in data else load_pem_public_key(data)
    except (ValueError, TypeError, UnsupportedAlgorithm):  # TypeError: it has a password
        key = None
    if isinstance(key, kinds) and _pem(key).split() == data.split():
        return key
    raise InputFileError(f"{path}: no key of Ed25519 without a password; make one with `vibrocast keys new`")
