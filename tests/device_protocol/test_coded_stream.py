"""Stream headers and .vct files: every value survives, every damage is found."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.coded_stream import (
    MAGIC,
    STREAM_UNITS,
    StreamError,
    StreamHeader,
    pack_file,
    packet_sequence,
    unpack_file,
)
from vibrocast.device_protocol.layout import crc16, pack_varint

gains = st.integers(1, 0x7F7F).map(lambda code: float(struct.unpack("<f", struct.pack("<I", code << 16))[0]))
headers = st.builds(
    StreamHeader,
    codec_identifier=st.integers(1, 15),
    rate_hz=st.integers(1, 200_000),
    samples=st.none() | st.integers(0, 2**63 - 2),
    unit=st.sampled_from(STREAM_UNITS),
    gains=st.lists(gains, min_size=1, max_size=16).map(tuple),
    configuration=st.binary(max_size=255),
    image_hash=st.sampled_from([b"", b"\x01\x02\x03\x04"]),
)
HEADER = StreamHeader(1, 2800, 700, "m/s^2", (2.5,), b"\x01\x02")


def numbered(payloads: list[bytes]) -> list[bytes]:
    return [pack_varint(index * 2 + (index == 0)) + payload for index, payload in enumerate(payloads)]


@given(headers, st.lists(st.binary(max_size=300), max_size=5).map(numbered))
def test_file_round_trip(header: StreamHeader, packets: list[bytes]) -> None:
    assert unpack_file(pack_file(header, packets)) == (header, packets)


@given(headers, st.binary(max_size=20))
def test_header_states_its_own_length(header: StreamHeader, following: bytes) -> None:
    packed = header.pack()
    assert StreamHeader.unpack(packed + following) == (header, len(packed))


@given(st.binary(max_size=100))
def test_any_bytes_are_read_or_rejected(data: bytes) -> None:
    for start in (b"", MAGIC, MAGIC + b"\x12\x00"):
        try:
            header, packets = unpack_file(start + data)
        except StreamError:
            continue
        assert pack_file(header, packets)


@pytest.mark.parametrize("payloads", [[b"some payload"], [b"some payload", b"more"]])
def test_every_flipped_bit_is_found(payloads: list[bytes]) -> None:
    data = pack_file(HEADER, numbered(payloads))
    for position in range(len(data) * 8):
        damaged = bytearray(data)
        damaged[position // 8] ^= 1 << position % 8
        with pytest.raises(StreamError):
            unpack_file(bytes(damaged))


@pytest.mark.parametrize("payloads", [[b"some payload"], [b"some payload", b"more", b"and more"]])
def test_every_cut_inside_a_packet_is_found(payloads: list[bytes]) -> None:
    data = pack_file(HEADER, numbered(payloads))
    # Only the codec knows how many packets there are.
    ends = {len(data)} if len(payloads) == 1 else {len(data) - cut for cut in ends_of(payloads)}
    for length in range(len(data)):
        if length in ends:
            assert len(unpack_file(data[:length])[1]) < len(payloads)
        else:
            with pytest.raises(StreamError):
                unpack_file(data[:length])


def ends_of(payloads: list[bytes]) -> list[int]:
    """Bytes of the last 0, 1, ... packets of a file that holds several short ones."""
    return [sum(1 + len(payload) + 2 for payload in payloads[first:]) for first in range(len(payloads) + 1)]


def test_missing_packet_is_found() -> None:
    payloads = [b"a", b"b", b"c"]
    data = pack_file(HEADER, numbered(payloads))
    last, two = ends_of(payloads)[2], ends_of(payloads)[1]
    with pytest.raises(StreamError, match="packet 1 fails its checksum, or one before it is missing"):
        unpack_file(data[:-two] + data[-last:])
    with pytest.raises(StreamError, match="packet 2 follows 1 packets"):
        pack_file(HEADER, [numbered(payloads)[0], numbered(payloads)[2]])


@pytest.mark.parametrize("gain", [0.0, -1.0, math.inf, math.nan, 1.001, 1e39, 1e-46])
def test_gain_that_cannot_be_stored_is_rejected(gain: float) -> None:
    with pytest.raises(StreamError, match="gain"):
        StreamHeader(1, 2800, None, "um", (gain,), b"")


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"VCT\x11\x00", "format 1, .* encode the recording again"),
        (b"\xd2\x12", "format 2, .* encode the recording again"),
        (b"\xd4\x12", "format 4, .* the version of vibrocast that wrote it"),
        (b"RIFF", "not a coded stream"),
    ],
)
def test_other_formats_are_named(start: bytes, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        StreamHeader.unpack(start + HEADER.pack())


def test_golden_files() -> None:
    data = pack_file(HEADER, numbered([b"\xaa\xbb"]))
    assert data.hex() == "d3" + "12" + "09" + "38" + "bd05" + "2040" + "0102" + "aabb" + "8580"
    other = StreamHeader(4, 2801, None, "um", (2.5, 1.0), bytes(15), b"hash")
    data = pack_file(other, numbered([b"\xaa", b"\xbb"]))
    header = "d3" + "4f" + "16" + "e32b" + "00" + "2040" + "803f" + "68617368" + "0f" + "00" * 15
    assert data.hex() == header + "03aa" + "c0e3" + "02bb" + "7fec"


def test_first_packet_that_is_no_refresh_is_rejected() -> None:
    with pytest.raises(StreamError, match="no refresh"):
        pack_file(HEADER, [pack_varint(0) + b"payload"])
    data = HEADER.pack() + b"\x02a"
    with pytest.raises(StreamError, match="no refresh"):
        unpack_file(data + crc16(data).to_bytes(2, "little"))


@pytest.mark.parametrize("packets", [[b""], [bytes(65_536)]])
def test_packet_that_cannot_be_stored_is_rejected(packets: list[bytes]) -> None:
    with pytest.raises(StreamError, match="1 to 65535"):
        pack_file(HEADER, packets)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_packet_sequence(sequence: int, random_access: bool) -> None:
    assert packet_sequence(pack_varint(2 * sequence + random_access) + b"payload") == (sequence, random_access)


@pytest.mark.parametrize("head", [b"", pack_varint(2**33), pack_varint(2**35), b"\x81\x80\x80\x80\x80\x00"])
def test_packet_sequence_that_no_decoder_takes_is_rejected(head: bytes) -> None:
    with pytest.raises(StreamError):
        packet_sequence(head)
