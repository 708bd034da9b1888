"""Model images, stream headers and heads of packets in C against device_protocol: the same of any bytes."""

import struct
import zlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.device_protocol.test_coded_stream import headers
from tests.device_protocol.test_model_image import images
from tests.firmware.native import ffi, native, piece_bytes, rejection_text
from vibrocast.device_protocol.coded_stream import MAGIC, STREAM_UNITS, StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.device_protocol.model_image import MAX_NUMBER, ModelError, ModelImage, unsigned, with_signature

LENGTH_UNKNOWN = 2**64 - 1
Check = Callable[[bytes], None]


def check_image(data: bytes) -> None:
    image, rejection, memory = ffi.new("vc_model_image *"), ffi.new("vc_rejection *"), ffi.new("uint8_t[]", data)
    code = native.vc_model_image_read(image, memory, len(data), rejection)
    assert native.vc_model_image_unsigned_bytes(memory, len(data)) == len(unsigned(data))
    try:
        expected = ModelImage.unpack(data)
    except ModelError:
        assert code == rejection.code == native.VC_IMAGE_REJECTED
        assert rejection_text(rejection)
    else:
        name, version, hardware = (piece_bytes(text).decode() for text in (image.name, image.version, image.hardware))
        assert code == 0
        signature = bytes(ffi.buffer(image.signature, 64)) if image.signature else b""
        payload = piece_bytes(image.payload)
        assert ModelImage(image.codec, name, version, hardware, payload, image.number, signature) == expected


def with_crc(data: bytes) -> bytes:
    return data + zlib.crc32(data).to_bytes(4, "little")


def check_header(data: bytes) -> None:
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


def check_damaged(check: Check, whole: bytes, data: st.DataObject) -> bytes:
    """Check bytes that are cut, longer, or have another byte; return the last ones."""
    place = data.draw(st.integers(0, len(whole) - 1))
    check(whole[:place])
    check(whole + data.draw(st.binary(max_size=4)))
    changed = whole[:place] + bytes([data.draw(st.integers(0, 255))]) + whole[place + 1 :]
    check(changed)
    return changed


@given(images, st.integers(0, MAX_NUMBER), st.binary(min_size=64, max_size=64), st.data())
def test_images_are_read_or_rejected_as_in_python(
    image: ModelImage, number: int, signature: bytes, data: st.DataObject
) -> None:
    packed = image.pack()
    check_image(packed)
    check_image(with_signature(packed, number, signature))
    changed = check_damaged(check_image, packed, data)
    check_image(with_crc(changed[:-4]))
    check_image(changed + bytes(68))


@pytest.mark.parametrize("lengths", ["ff" * 7, "ff" * 3 + "00" * 4, "00" * 3 + "ff" * 4, "000000" + "afffffff"])
def test_lengths_that_overflow_32_bits_are_rejected(lengths: str) -> None:
    for size in (0, 4, 68, 72, 85, 1000):
        check_image(b"VCMI\x01\x01" + bytes.fromhex(lengths) + bytes(size))


@given(headers, st.data())
def test_headers_are_read_or_rejected_as_in_python(header: StreamHeader, data: st.DataObject) -> None:
    check_header(header.pack())
    check_damaged(check_header, header.pack(), data)


@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_rejected_as_in_python(data: bytes) -> None:
    for start in (b"", b"VCMI\x01", b"VCMI\x01\x01\x02\x01\x03\x05\0\0\0"):
        check_image(start + data)
        check_image(with_crc(start + data))
    for start in (b"", MAGIC, MAGIC + b"\x12\x00\x38\x00"):
        check_header(start + data)


@pytest.mark.parametrize("rate", [0, 1, 28, 2000, 2001, 200_000, 200_001, 2**31 - 1, 2**31 + 28, 2**62])
def test_takes_the_rates_that_python_takes(rate: int) -> None:
    for exact in (2 * rate + 1, 2 * rate):
        check_header(MAGIC + b"\x10\x00" + pack_varint(exact) + b"\x00\x80\x3f")


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
