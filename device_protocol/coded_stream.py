"""Byte layout of .vct files and of played streams: the header, and the packets after it."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from vibrocast.device_protocol.layout import Reader, crc16, pack_varint
from vibrocast.errors import InputError

STREAM_SUFFIX = ".vct"
FORMAT = 3
MAGIC = bytes((0xD0 | FORMAT,))
_OLD_MAGICS = {b"VCT": 1, b"\xd2": 2}
"""The first bytes of formats that nothing released has written; this program reads none."""
UNITS = ("full scale", "m/s^2", "um")
PROFILE_UNIT = "um over position"
"""Unit of a height profile, whose rate is in samples per metre."""
STREAM_UNITS = (*UNITS, PROFILE_UNIT)
MAX_CHANNELS = 16
MAX_CODEC_IDENTIFIER = 15
MAX_RATE_HZ = 200_000
ROUND_RATE_HZ = 100
"""The rates that are multiples of it take fewer bytes."""
RATE_BITS = 32
MAX_CONFIGURATION_BYTES = 255
LONG_CONFIGURATION = 15
"""A length in the header's second byte: a byte with the length follows the image hash."""
MAX_PACKET_BYTES = 65_535
IMAGE_HASH_BYTES = 4

UNIT_BITS = 0x03
HAS_IMAGE_HASH = 0x04
ONE_PACKET = 0x08
VARINT_BITS = 63
SEQUENCE_BITS = 32

_FLAGS_AT = 2
_CRC = struct.Struct("<H")


class StreamError(InputError):
    """A header, packet or .vct file that cannot be written or read; the message says why and what to do."""


@dataclass(frozen=True)
class StreamHeader:
    """The facts that a decoder needs before the first packet.

    `rate_hz`: per metre if `unit` is PROFILE_UNIT. `samples`: samples per channel, None if the stream is live and its
    length unknown. `unit`: one of STREAM_UNITS. `gains`: physical value of full scale for each channel, positive, exact
    in 8 significant bits (a float32 whose lower 16 bits are zero). `configuration`: the codec's own bytes.
    `image_hash`: empty if the tables built into the codec suffice, otherwise the first 4 bytes of the SHA-256 of the
    model image.

    Raises StreamError for a value that the layout cannot hold.
    """

    codec_identifier: int
    rate_hz: int
    samples: int | None
    unit: str
    gains: tuple[float, ...]
    configuration: bytes
    image_hash: bytes = b""

    def __post_init__(self) -> None:
        if not 1 <= self.codec_identifier <= MAX_CODEC_IDENTIFIER:
            raise StreamError(f"codec identifier {self.codec_identifier} is outside 1..{MAX_CODEC_IDENTIFIER}")
        if not 1 <= self.rate_hz <= MAX_RATE_HZ:
            raise StreamError(f"rate {self.rate_hz} Hz is outside 1..{MAX_RATE_HZ} Hz; resample the signal first")
        if self.samples is not None and not 0 <= self.samples < 2**VARINT_BITS - 1:
            raise StreamError(f"{self.samples} samples cannot be stored")
        if self.unit not in STREAM_UNITS:
            raise StreamError(f"unit {self.unit!r} is not one of {', '.join(STREAM_UNITS)}")
        if not 1 <= self.channels <= MAX_CHANNELS:
            raise StreamError(f"{self.channels} channels; a stream holds 1 to {MAX_CHANNELS}")
        for gain in self.gains:
            _pack_gain(gain)
        if len(self.configuration) > MAX_CONFIGURATION_BYTES:
            raise StreamError(f"codec configuration of {len(self.configuration)} bytes; at most 255 fit")
        if len(self.image_hash) not in (0, IMAGE_HASH_BYTES):
            raise StreamError(f"image hash of {len(self.image_hash)} bytes; 0 or {IMAGE_HASH_BYTES} are allowed")

    @property
    def spatial(self) -> bool:
        """Whether the stream is a height profile, rendered by position."""
        return self.unit == PROFILE_UNIT

    @property
    def channels(self) -> int:
        """Channels in the stream."""
        return len(self.gains)

    def pack(self, one_packet: bool = False) -> bytes:
        """Return the header's bytes. `one_packet`: of a file with a single packet, which takes the rest of the file."""
        flags = STREAM_UNITS.index(self.unit) | (self.channels - 1) << 4
        flags |= HAS_IMAGE_HASH if self.image_hash else 0
        flags |= ONE_PACKET if one_packet else 0
        hundreds, rest = divmod(self.rate_hz, ROUND_RATE_HZ)
        length = len(self.configuration)
        return b"".join(
            (
                MAGIC,
                bytes((self.codec_identifier << 4 | min(length, LONG_CONFIGURATION), flags)),
                pack_varint(2 * self.rate_hz + 1 if rest else 2 * hundreds),
                pack_varint(0 if self.samples is None else self.samples + 1),
                b"".join(map(_pack_gain, self.gains)),
                self.image_hash,
                bytes((length,)) if length >= LONG_CONFIGURATION else b"",
                self.configuration,
            )
        )

    @staticmethod
    def unpack(data: bytes) -> tuple["StreamHeader", int]:
        """Read the header at the start of `data`; return it and its length in bytes.

        Raises StreamError when the bytes are not a header of this format.
        """
        reader = Reader(data, _damaged)
        codec_identifier, length = _begin(reader, data)
        flags = reader.take(1)[0]
        channels = (flags >> 4) + 1
        rate, exact = divmod(reader.varint(RATE_BITS), 2)
        samples = reader.varint(VARINT_BITS) - 1
        gains = tuple(_unpack_gain(reader.take(2)) for _ in range(channels))
        image_hash = reader.take(IMAGE_HASH_BYTES) if flags & HAS_IMAGE_HASH else b""
        configuration = reader.take(reader.take(1)[0] if length == LONG_CONFIGURATION else length)
        unit = STREAM_UNITS[flags & UNIT_BITS]
        rate_hz = rate if exact else ROUND_RATE_HZ * rate
        known = None if samples < 0 else samples
        header = StreamHeader(codec_identifier, rate_hz, known, unit, gains, configuration, image_hash)
        return header, reader.position


def _begin(reader: Reader, data: bytes) -> tuple[int, int]:
    """Take the first two bytes of a header; return the codec's identifier and the length of its configuration."""
    for magic, old in _OLD_MAGICS.items():
        if data.startswith(magic):
            raise StreamError(_other_format(old) + "; encode the recording again")
    family, number = divmod(reader.take(1)[0], 16)
    if family != MAGIC[0] >> 4:
        raise StreamError("not a coded stream: it does not start as one; give a .vct file")
    if number != FORMAT:
        raise StreamError(_other_format(number) + "; use the version of vibrocast that wrote it")
    return divmod(reader.take(1)[0], 16)


def _other_format(number: int) -> str:
    return f"coded stream of format {number}, and this program reads format {FORMAT}"


def packet_sequence(packet: bytes) -> tuple[int, bool]:
    """Return a packet's sequence number and whether decoding can begin there. Raises StreamError on a malformed one."""
    sequence, random_access = divmod(Reader(packet, _damaged).varint(SEQUENCE_BITS + 1), 2)
    return sequence, bool(random_access)


def renumbered(packet: bytes, packets_before: int) -> bytes:
    """Return a packet with its sequence number raised by `packets_before`. Raises StreamError on a malformed packet."""
    sequence, refresh = packet_sequence(packet)
    return pack_varint(2 * (sequence + packets_before) + refresh) + packet[_head_bytes(packet) :]


def _head_bytes(packet: bytes) -> int:
    """Return the length of a packet's head."""
    return next(index for index, byte in enumerate(packet) if byte < 0x80) + 1


def pack_file(header: StreamHeader, packets: Sequence[bytes]) -> bytes:
    """Return the bytes of a .vct file: the header, then the packets, each without its number and before a CRC-16.

    The CRC-16 (polynomial 0x1021, initial value 0xFFFF) covers all before it but other CRCs. So it finds damage, a
    packet of another stream and one that misses. Raises StreamError for packets that are too long, or not numbered from
    0.
    """
    one_packet = len(packets) == 1
    parts = [header.pack(one_packet)]
    crc = crc16(parts[0])
    for number, packet in enumerate(packets):
        if not 1 <= len(packet) <= MAX_PACKET_BYTES:
            raise StreamError(f"packet of {len(packet)} bytes; 1 to {MAX_PACKET_BYTES} are allowed")
        (sequence, refresh), payload = packet_sequence(packet), packet[_head_bytes(packet) :]
        if sequence != number:
            raise StreamError(f"packet {sequence} follows {number} packets; number all of them, from 0")
        if number == 0 and not refresh:
            raise StreamError("its first packet is no refresh; encode the recording again")
        kept = payload if one_packet else pack_varint(2 * len(payload) + refresh) + payload
        crc = crc16(kept, crc)
        parts += [kept, _CRC.pack(crc)]
    return b"".join(parts)


def unpack_file(data: bytes) -> tuple[StreamHeader, list[bytes]]:
    """Read the bytes of a .vct file. Raises StreamError when they are damaged or end in the middle of a packet.

    Only the codec can tell whether all packets are there, because it knows how many samples a packet covers.
    """
    header, position = StreamHeader.unpack(data)
    crc = crc16(data[:position])
    reader = Reader(data, _damaged, position)
    one_packet = bool(data[_FLAGS_AT] & ONE_PACKET)
    packets: list[bytes] = []
    while not reader.at_end or (one_packet and not packets):
        start = reader.position
        length, refresh = (reader.left - _CRC.size, 1) if one_packet else divmod(reader.varint(VARINT_BITS), 2)
        payload = reader.take(max(0, length))
        crc = crc16(data[start : reader.position], crc)
        if _CRC.unpack(reader.take(_CRC.size))[0] != crc:
            raise StreamError(
                f"damaged coded stream: packet {len(packets)} fails its checksum, or one before it is missing; copy "
                "the file again"
            )
        if not packets and not refresh:
            raise StreamError("damaged coded stream: its first packet is no refresh; encode the recording again")
        packets.append(pack_varint(2 * len(packets) + refresh) + payload)
        if len(packets[-1]) > MAX_PACKET_BYTES:
            raise StreamError(f"damaged coded stream: packet {len(packets) - 1} is too long; copy the file again")
    return header, packets


def _damaged(flaw: str) -> StreamError:
    return StreamError(f"truncated or damaged coded stream: {flaw}; copy the file again")


def _pack_gain(gain: float) -> bytes:
    """Return the upper half of the gain's IEEE 754 single-precision bytes, little endian."""
    try:
        encoded = struct.pack("<f", gain)
    except OverflowError:
        encoded = b"\xff\xff\xff\xff"
    if encoded[:2] != b"\0\0" or not 0.0 < gain < float("inf") or struct.unpack("<f", encoded)[0] != gain:
        raise StreamError(f"gain {gain} is not a positive number of at most 8 significant bits")
    return encoded[2:]


def _unpack_gain(encoded: bytes) -> float:
    gain: float = struct.unpack("<f", b"\0\0" + encoded)[0]
    return gain
