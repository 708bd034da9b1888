"""Stream headers and heads of packets in C against device_protocol/coded_stream.py: the same of any bytes."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.device_protocol.test_coded_stream import headers
from tests.firmware.native import ffi, native, rejection_text
from vibrocast.device_protocol.coded_stream import MAGIC, STREAM_UNITS, StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.encoding import pack_varint

LENGTH_UNKNOWN = 2**64 - 1


def check_read_as_in_python(data: bytes) -> None:
    header, rejection, memory = ffi.new("vc_stream_header *"), ffi.new("vc_rejection *"), ffi.new("uint8_t[]", data)
    code = native.vc_stream_header_read(header, memory, len(data), rejection)
    try:
        expected, used = StreamHeader.unpack(data)
    except StreamError:
        used = -1
    if used != len(data):
        assert code == rejection.code == native.VC_BAD_VALUE
        assert rejection_text(rejection)
        return
    assert code == 0
    assert header.codec == expected.codec_identifier
    assert header.samples == (LENGTH_UNKNOWN if expected.samples is None else expected.samples)
    assert header.output.rate_hz == expected.rate_hz
    assert STREAM_UNITS[header.output.unit] == expected.unit
    assert header.output.channels == expected.channels
    gains = [struct.unpack("<f", struct.pack("<I", gain << 16))[0] for gain in header.output.gain]
    assert tuple(gains[: expected.channels]) == expected.gains
    assert (bytes(header.image_hash) if header.needs_image else b"") == expected.image_hash
    assert bytes(header.configuration)[: header.configuration_length] == expected.configuration


@given(headers)
def test_reads_every_header(header: StreamHeader) -> None:
    check_read_as_in_python(header.pack())


@given(headers, st.data())
def test_reads_or_rejects_damaged_headers_as_python(header: StreamHeader, data: st.DataObject) -> None:
    packed = bytearray(header.pack())
    place = data.draw(st.integers(0, len(packed) - 1))
    check_read_as_in_python(bytes(packed[:place]))
    check_read_as_in_python(bytes(packed) + data.draw(st.binary(max_size=4)))
    packed[place] = data.draw(st.integers(0, 255))
    check_read_as_in_python(bytes(packed))


@given(st.binary(max_size=60))
def test_reads_or_rejects_any_bytes_as_python(data: bytes) -> None:
    for start in (b"", MAGIC, MAGIC + b"\x12\x00\x38\x00"):
        check_read_as_in_python(start + data)


@pytest.mark.parametrize("rate", [0, 1, 28, 2000, 2001, 200_000, 200_001, 2**31 - 1, 2**31 + 28, 2**62])
def test_takes_the_rates_that_python_takes(rate: int) -> None:
    for exact in (2 * rate + 1, 2 * rate):
        check_read_as_in_python(MAGIC + b"\x10\x00" + pack_varint(exact) + b"\x00\x80\x3f")


@given(st.one_of(st.binary(max_size=8), st.integers(0, 2**36).map(pack_varint)))
def test_heads_of_packets_as_in_python(packet: bytes) -> None:
    sequence, refresh, memory = ffi.new("uint32_t *"), ffi.new("int *"), ffi.new("uint8_t[]", packet)
    status = native.vc_packet_sequence(memory, len(packet), sequence, refresh)
    try:
        expected = packet_sequence(packet)
    except StreamError:
        assert status == -1
    else:
        assert (status, sequence[0], bool(refresh[0])) == (0, *expected)
