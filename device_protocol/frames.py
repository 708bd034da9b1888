"""Frames on the wire: a payload and its CRC-16, COBS-encoded, closed by a zero byte."""

from cobs import cobs

from vibrocast.device_protocol.encoding import crc16

MAXIMUM_PAYLOAD_BYTES = 4096
DELIMITER = b"\x00"

_CRC_BYTES = 2
# COBS adds one byte, and one more for every 254 bytes (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999).
_OVERHEAD_BYTES = _CRC_BYTES + 1 + (MAXIMUM_PAYLOAD_BYTES + _CRC_BYTES) // 254


class FrameError(ValueError):
    """A payload that does not fit a frame."""


def write_frame(payload: bytes) -> bytes:
    """Return the frame of a payload: COBS(payload, CRC-16 little-endian), then the delimiter.

    Raises FrameError for a payload that is empty or longer than MAXIMUM_PAYLOAD_BYTES.
    """
    if not 1 <= len(payload) <= MAXIMUM_PAYLOAD_BYTES:
        raise FrameError(f"a frame carries 1 to {MAXIMUM_PAYLOAD_BYTES} bytes, not {len(payload)}: send less at a time")
    encoded: bytes = cobs.encode(payload + crc16(payload).to_bytes(_CRC_BYTES, "little"))
    return encoded + DELIMITER


class FrameReader:
    """Finds frames in a byte stream; drops and counts bad ones, and is in step again at the next delimiter.

    Holds at most one frame of the longest size, whatever it is fed.
    """

    def __init__(self) -> None:
        self.bad_frames = 0
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take the bytes that arrived; return the payloads of the frames that they complete. Raises nothing."""
        payloads = []
        *closed, rest = data.split(DELIMITER)
        for piece in closed:
            self._keep(piece)
            # Delimiters without anything between them are allowed: a sender may open with one to end earlier noise.
            if self._pending:
                payload = _payload(bytes(self._pending))
                if payload is None:
                    self.bad_frames += 1
                else:
                    payloads.append(payload)
                self._pending.clear()
        self._keep(rest)
        return payloads

    def _keep(self, piece: bytes) -> None:
        # One byte more than the longest frame is kept, and marks the frame as too long.
        room = MAXIMUM_PAYLOAD_BYTES + _OVERHEAD_BYTES + 1 - len(self._pending)
        self._pending += piece[:room]


def _payload(encoded: bytes) -> bytes | None:
    """Return the payload between two delimiters, or None if it is damaged, empty or too long."""
    if len(encoded) > MAXIMUM_PAYLOAD_BYTES + _OVERHEAD_BYTES:
        return None
    try:
        decoded: bytes = cobs.decode(encoded)
    except cobs.DecodeError:
        return None
    payload, crc = decoded[:-_CRC_BYTES], decoded[-_CRC_BYTES:]
    if not 1 <= len(payload) <= MAXIMUM_PAYLOAD_BYTES or crc16(payload) != int.from_bytes(crc, "little"):
        return None
    return payload
