"""Stream headers and .vct files: every value survives, every damage is found."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.coded_stream import (
    STREAM_UNITS,
    StreamError,
    StreamHeader,
    pack_file,
    packet_sequence,
    unpack_file,
)
from vibrocast.device_protocol.encoding import pack_varint

gains = st.integers(1, 0x7F7F).map(lambda code: float(struct.unpack("<f", struct.pack("<I", code << 16))[0]))
headers = st.builds(
    StreamHeader,
    codec_identifier=st.integers(1, 15),
    rate_hz=st.integers(1, 200_000),
    samples=st.none() | st.integers(0, 2**63 - 1),
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
    for start in (b"", b"VCT\x11"):
        try:
            header, packets = unpack_file(start + data)
        except StreamError:
            continue
        assert pack_file(header, packets)


def test_every_flipped_bit_is_found() -> None:
    data = pack_file(HEADER, numbered([b"some payload", b"more"]))
    for position in range(len(data) * 8):
        damaged = bytearray(data)
        damaged[position // 8] ^= 1 << position % 8
        with pytest.raises(StreamError):
            unpack_file(bytes(damaged))


def test_every_cut_inside_a_packet_is_found() -> None:
    packets = numbered([b"some payload", b"more"])
    data = pack_file(HEADER, packets)
    whole = {len(pack_file(HEADER, packets[:count])) for count in range(3)}
    for length in set(range(len(data))) - whole:
        with pytest.raises(StreamError):
            unpack_file(data[:length])


def test_missing_packet_is_found() -> None:
    packets = numbered([b"a", b"b", b"c"])
    with pytest.raises(StreamError, match="packet 1 is missing"):
        unpack_file(pack_file(HEADER, [packets[0], packets[2]]))


@pytest.mark.parametrize("gain", [0.0, -1.0, math.inf, math.nan, 1.001, 1e39, 1e-46])
def test_gain_that_cannot_be_stored_is_rejected(gain: float) -> None:
    with pytest.raises(StreamError, match="gain"):
        StreamHeader(1, 2800, None, "um", (gain,), b"")


def test_other_version_is_named() -> None:
    data = bytearray(HEADER.pack())
    data[3] = 0x21
    with pytest.raises(StreamError, match="version 2"):
        StreamHeader.unpack(bytes(data))


def test_golden_file() -> None:
    data = pack_file(HEADER, numbered([b"\xaa\xbb"]))
    assert data.hex() == "56435411" + "01" + "f015" + "bc05" + "2040" + "02" + "0102" + "03" + "01aabb" + "f332"


def test_first_packet_without_random_access_is_rejected() -> None:
    with pytest.raises(StreamError, match="no random-access packet"):
        unpack_file(pack_file(HEADER, [pack_varint(0) + b"payload"]))


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
