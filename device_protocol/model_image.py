"""Model image: a codec's configuration for upload to a controller, with its identity, checks and signature."""

import hashlib
import struct
import zlib
from dataclasses import dataclass
from typing import Self

from vibrocast.errors import InputError

MAGIC = b"VCMI"
LAYOUT_VERSION = 1
MAX_IMAGE_BYTES = 16 * 1024 * 1024

ACTUATOR_IDENTIFIER = 0xFE
"""In place of a codec's: the image holds an actuator."""

# Magic, layout version, codec identifier, lengths of name, version and hardware, length of the payload.
_FIXED = struct.Struct("<4sBBBBBI")
_CRC_BYTES = 4
# Number of the release, signature.
_SIGNED = struct.Struct("<I64s")
SIGNED_BYTES = _SIGNED.size
"""Bytes behind the CRC-32 of a signed image."""
SIGNED_MESSAGE_BYTES = 36
"""Bytes that a signature covers."""
MAX_NUMBER = 0xFFFFFFFF
_MAX_TEXT_BYTES = 255


class ModelError(InputError):
    """Values that no model image can hold, or bytes that are no model image; the message says why."""


@dataclass(frozen=True)
class ModelImage:
    """A model image.

    `hardware`: the only hardware id on which it may run, empty = any. `payload`: the tables of the codec's decoder; for
    `mdct` these are the initial states of its contexts. `number`: of the release, from 1 on; 0 = an unsigned image.
    `signature`: by Ed25519 of `signed_message`, 64 bytes; nobody has checked it here.
    """

    codec_identifier: int
    name: str
    version: str
    hardware: str
    payload: bytes
    number: int = 0
    signature: bytes = b""

    def pack(self) -> bytes:
        """Return the image's bytes: CRC-32 (as in zlib) last, then the number and signature of a signed image.

        Raises ModelError for a value out of range.
        """
        texts = [text.encode() for text in (self.name, self.version, self.hardware)]
        if max(map(len, texts)) > _MAX_TEXT_BYTES:
            raise ModelError(f"name, version and hardware have at most {_MAX_TEXT_BYTES} bytes each; shorten them")
        if not 0 <= self.codec_identifier <= 0xFF:
            raise ModelError(f"codec identifier {self.codec_identifier} is not in 0 to 255")
        fixed = _FIXED.pack(MAGIC, LAYOUT_VERSION, self.codec_identifier, *map(len, texts), len(self.payload))
        checked = fixed + b"".join(texts) + self.payload
        signed = _SIGNED.pack(self.number, self.signature) if self.signature else b""
        packed = checked + zlib.crc32(checked).to_bytes(_CRC_BYTES, "little") + signed
        if len(packed) > MAX_IMAGE_BYTES:
            raise ModelError(f"an image has at most {MAX_IMAGE_BYTES} bytes")
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Return the image in `data`. Raises ModelError unless all of it is one whole image."""
        trailer = data[len(unsigned(data)) :]
        signed = _SIGNED.unpack(trailer) if trailer else ()
        data = unsigned(data)
        if len(data) < _FIXED.size + _CRC_BYTES or data[: len(MAGIC)] != MAGIC:
            raise ModelError("not a model image; give one that `vibrocast export` wrote")
        _, layout, codec_identifier, *text_bytes, payload_bytes = _FIXED.unpack_from(data)
        if layout != LAYOUT_VERSION:
            raise ModelError(
                f"model image of layout {layout}, and this version reads {LAYOUT_VERSION}; export the model again"
            )
        expected = _FIXED.size + sum(text_bytes) + payload_bytes + _CRC_BYTES
        if len(data) != expected:
            raise ModelError(f"the model image has {len(data)} bytes instead of {expected}; get the file again")
        if zlib.crc32(data[:-_CRC_BYTES]) != int.from_bytes(data[-_CRC_BYTES:], "little"):
            raise ModelError("the model image is damaged (CRC-32 differs); get the file again")
        position = _FIXED.size
        texts = []
        for length in text_bytes:
            texts.append(data[position : position + length])
            position += length
        try:
            name, version, hardware = (text.decode() for text in texts)
        except UnicodeDecodeError as error:
            raise ModelError("the model image's texts are not UTF-8; get the file again") from error
        return cls(codec_identifier, name, version, hardware, data[position:-_CRC_BYTES], *signed)


def unsigned(image: bytes) -> bytes:
    """Return a packed image without its number and signature; other bytes as they are."""
    if len(image) < _FIXED.size + _CRC_BYTES + SIGNED_BYTES:
        return image
    *_, name_bytes, version_bytes, hardware_bytes, payload_bytes = _FIXED.unpack_from(image)
    stated = _FIXED.size + name_bytes + version_bytes + hardware_bytes + payload_bytes + _CRC_BYTES
    return image[:stated] if stated + SIGNED_BYTES == len(image) else image


def sha256(image: bytes) -> bytes:
    """Return the identity of a packed image: SHA-256 of the unsigned image. Streams name it by its first bytes."""
    return hashlib.sha256(unsigned(image)).digest()


def signed_message(image: bytes, number: int) -> bytes:
    """Return the bytes that a signature covers: a packed image's identity, then the number of the release."""
    return sha256(image) + number.to_bytes(4, "little")


def with_signature(image: bytes, number: int, signature: bytes) -> bytes:
    """Return a packed image with this number and signature of 64 bytes, in place of others."""
    return unsigned(image) + _SIGNED.pack(number, signature)
