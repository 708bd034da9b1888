"""Byte layout of .vct files and of played streams: the header, and the packets after it."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from vibrocast.device_protocol.encoding import Reader, crc16, pack_varint

MAGIC = b"VCT"
VERSION = 1
UNITS = ("full scale", "m/s^2", "um")
PROFILE_UNIT = "um over position"
"""Unit of a height profile, whose rate is in samples per metre."""
STREAM_UNITS = (*UNITS, PROFILE_UNIT)
MAX_CHANNELS = 16
MAX_CODEC_IDENTIFIER = 15
MAX_RATE_HZ = 200_000
MAX_CONFIGURATION_BYTES = 255
MAX_PACKET_BYTES = 65_535
IMAGE_HASH_BYTES = 4

UNIT_BITS = 0x03
HAS_IMAGE_HASH = 0x04
LENGTH_UNKNOWN = 0x08
VARINT_BITS = 63
SEQUENCE_BITS = 32


class StreamError(ValueError):
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
        if self.samples is not None and not 0 <= self.samples < 2**63:
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

    def pack(self) -> bytes:
        """Return the header's bytes."""
        flags = STREAM_UNITS.index(self.unit) | (self.channels - 1) << 4
        flags |= HAS_IMAGE_HASH if self.image_hash else 0
        flags |= LENGTH_UNKNOWN if self.samples is None else 0
        return b"".join(
            (
                MAGIC,
                bytes((VERSION << 4 | self.codec_identifier, flags)),
                pack_varint(self.rate_hz),
                b"" if self.samples is None else pack_varint(self.samples),
                b"".join(map(_pack_gain, self.gains)),
                self.image_hash,
                bytes((len(self.configuration),)),
                self.configuration,
            )
        )

    @staticmethod
    def unpack(data: bytes) -> tuple["StreamHeader", int]:
        """Read the header at the start of `data`; return it and its length in bytes.

        Raises StreamError when the bytes are not a header of this version.
        """
        reader = Reader(data, _damaged)
        if reader.take(3) != MAGIC:
            raise StreamError("not a coded stream: it does not start with 'VCT'; give a .vct file")
        version, codec_identifier = divmod(reader.take(1)[0], 16)
        if version != VERSION:
            raise StreamError(
                f"coded stream of version {version}, and this program reads {VERSION}; encode the recording again"
            )
        flags = reader.take(1)[0]
        channels = (flags >> 4) + 1
        rate_hz = reader.varint(VARINT_BITS)
        samples = None if flags & LENGTH_UNKNOWN else reader.varint(VARINT_BITS)
        gains = tuple(_unpack_gain(reader.take(2)) for _ in range(channels))
        image_hash = reader.take(IMAGE_HASH_BYTES) if flags & HAS_IMAGE_HASH else b""
        configuration = reader.take(reader.take(1)[0])
        unit = STREAM_UNITS[flags & UNIT_BITS]
        header = StreamHeader(codec_identifier, rate_hz, samples, unit, gains, configuration, image_hash)
        return header, reader.position


def packet_sequence(packet: bytes) -> tuple[int, bool]:
    """Return a packet's sequence number and whether decoding can begin there. Raises StreamError on a malformed one."""
    sequence, random_access = divmod(Reader(packet, _damaged).varint(SEQUENCE_BITS + 1), 2)
    return sequence, bool(random_access)


def renumbered(packet: bytes, packets_before: int) -> bytes:
    """Return a packet with its sequence number raised by `packets_before`. Raises StreamError on a malformed packet."""
    reader = Reader(packet, _damaged)
    head = reader.varint(SEQUENCE_BITS + 1)
    return pack_varint(head + 2 * packets_before) + packet[reader.position :]


def pack_file(header: StreamHeader, packets: Iterable[bytes]) -> bytes:
    """Return the bytes of a .vct file: the header, then each packet between its length and a CRC-16.

    The CRC-16 (polynomial 0x1021, initial value 0xFFFF) of each packet covers the header and that packet. So it finds
    damage to either, and a packet of another stream.
    """
    head = header.pack()
    parts = [head]
    head_crc = crc16(head)
    for packet in packets:
        if not 1 <= len(packet) <= MAX_PACKET_BYTES:
            raise StreamError(f"packet of {len(packet)} bytes; 1 to {MAX_PACKET_BYTES} are allowed")
        parts += [pack_varint(len(packet)), packet, struct.pack("<H", crc16(packet, head_crc))]
    return b"".join(parts)


def unpack_file(data: bytes) -> tuple[StreamHeader, list[bytes]]:
    """Read the bytes of a .vct file. Raises StreamError when they are damaged or end in the middle of a packet.

    Only the codec can tell whether all packets are there, because it knows how many samples a packet covers.
    """
    header, position = StreamHeader.unpack(data)
    head_crc = crc16(data[:position])
    reader = Reader(data, _damaged, position)
    packets: list[bytes] = []
    while not reader.at_end:
        packet = reader.take(reader.varint(VARINT_BITS))
        (crc,) = struct.unpack("<H", reader.take(2))
        if crc != crc16(packet, head_crc):
            raise StreamError(f"damaged coded stream: packet {len(packets)} fails its checksum; copy the file again")
        sequence, random_access = packet_sequence(packet)
        if sequence != len(packets):
            raise StreamError(f"damaged coded stream: packet {len(packets)} is missing; copy the file again")
        if sequence == 0 and not random_access:
            raise StreamError(
                "damaged coded stream: its first packet is no random-access packet; encode the recording again"
            )
        packets.append(packet)
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
