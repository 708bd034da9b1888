"""Frames on a link: a payload and its CRC-16, COBS-encoded, closed by a zero byte."""

import struct
from collections.abc import Iterator

from cobs import cobs

from vibrocast.device_protocol.layout import crc16
from vibrocast.errors import InputError

MAX_PAYLOAD_BYTES = 4096
DELIMITER = b"\x00"

_CRC = struct.Struct("<H")
# COBS adds one byte, and one more for every 254 bytes (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999).
_MAX_ENCODED_BYTES = MAX_PAYLOAD_BYTES + _CRC.size + 1 + (MAX_PAYLOAD_BYTES + _CRC.size) // 254


def write_frame(payload: bytes) -> bytes:
    """Return the frame of a payload: COBS(payload, CRC-16 little-endian), then the delimiter.

    Raises InputError for a payload that is empty or longer than MAX_PAYLOAD_BYTES.
    """
    if not 1 <= len(payload) <= MAX_PAYLOAD_BYTES:
        raise InputError(f"a frame carries 1 to {MAX_PAYLOAD_BYTES} bytes, not {len(payload)}; send less at a time")
    encoded: bytes = cobs.encode(payload + _CRC.pack(crc16(payload)))
    return encoded + DELIMITER


class FrameReader:
    """Finds frames in a byte stream; drops and counts bad ones, and recovers at the next delimiter.

    Holds at most one frame of the longest size, whatever arrives.
    """

    def __init__(self) -> None:
        self.bad_frames = 0
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take the bytes that arrived; return the payloads of the frames that they complete. Raises nothing."""
        payloads = []
        *closed, rest = data.split(DELIMITER)
        if closed and self._pending:
            self._keep(closed[0])
            closed[0] = bytes(self._pending)
            self._pending.clear()
        for encoded in closed:
            # Delimiters with nothing between them are allowed: a sender may begin with one, to end earlier noise.
            if not encoded:
                continue
            payload = payload_of(encoded)
            if payload:
                payloads.append(payload)
            else:
                self.bad_frames += 1
        if rest:
            self._keep(rest)
        return payloads

    def _keep(self, piece: bytes) -> None:
        # Keep one byte more than the longest frame, as a mark that the frame is too long.
        self._pending += piece[: _MAX_ENCODED_BYTES + 1 - len(self._pending)]


class FrameSplitter:
    """Splits the bytes of one direction into frames; what is longer than any frame is split at `MAX_BYTES`."""

    MAX_BYTES = 65_536

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield the frames that these bytes complete, without delimiters; empty ones are left out."""
        *closed, self._pending = (self._pending + data).split(DELIMITER)
        yield from filter(None, closed)
        if len(self._pending) > self.MAX_BYTES:
            pending, self._pending = self._pending, b""
            yield pending


def payload_of(encoded: bytes) -> bytes:
    """Return the payload between two delimiters, or nothing if it is damaged, empty or too long."""
    if len(encoded) > _MAX_ENCODED_BYTES:
        return b""
    try:
        decoded: bytes = cobs.decode(encoded)
    except cobs.DecodeError:
        return b""
    payload = decoded[: -_CRC.size]
    # An empty payload is no frame, nor is a long one in another COBS encoding.
    if len(payload) > MAX_PAYLOAD_BYTES or not decoded.endswith(_CRC.pack(crc16(payload))):
        return b""
    return payload
