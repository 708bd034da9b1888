"""COBS, CRC-16, CRC-32 and SHA-256 of the core against the libraries that Python uses."""

import hashlib
import zlib

import pytest
from cobs import cobs
from hypothesis import example, given
from hypothesis import strategies as st

from tests.firmware.native import ffi, native
from vibrocast.device_protocol.layout import crc16

# Long runs without a zero, where groups of COBS are full.
stuffed = st.lists(st.integers(0, 600).map(lambda length: b"x" * length)).map(b"\0".join)


@given(st.binary(max_size=600), st.integers(0, 600))
def test_checksums_are_those_of_the_libraries_in_one_piece_and_in_two(data: bytes, cut: int) -> None:
    first, second = data[:cut], data[cut:]
    assert native.vc_crc16(second, len(second), native.vc_crc16(first, len(first), 0xFFFF)) == crc16(data)
    assert native.vc_crc32(second, len(second), native.vc_crc32(first, len(first), 0)) == zlib.crc32(data)


@pytest.mark.parametrize("length", [*range(130), 1000, 4096])
def test_sha256_is_that_of_the_library_at_every_length_of_a_last_block(length: int) -> None:
    data = bytes(number * 7 % 251 for number in range(length))
    digest = ffi.new("uint8_t[32]")
    native.vc_sha256(data, length, digest)
    assert bytes(digest) == hashlib.sha256(data).digest()


@given(st.one_of(st.binary(max_size=600), stuffed), st.lists(st.integers(0, 700)))
@example(b"x" * 254, [])
@example(b"x" * 254 + b"\0", [])
def test_cobs_encodes_as_the_library_however_the_bytes_are_cut(data: bytes, cuts: list[int]) -> None:
    expected = cobs.encode(data)
    for capacity in (len(expected), len(expected) - 1):
        encoder = ffi.new("vc_cobs_encoder *")
        encoded = ffi.new("uint8_t[]", capacity)
        native.vc_cobs_begin(encoder, encoded, capacity)
        for start, end in zip([0, *sorted(cuts)], [*sorted(cuts), len(data)], strict=True):
            native.vc_cobs_put(encoder, data[start:end], len(data[start:end]))
        length = native.vc_cobs_end(encoder)
        assert bytes(encoded)[:length] == (expected if capacity == len(expected) else b"")


def decoded(data: bytes) -> bytes | None:
    memory, length = ffi.new("uint8_t[]", data), ffi.new("size_t *")
    if native.vc_cobs_decode(memory, len(data), length) != 0:
        return None
    return bytes(memory)[: length[0]]


@given(st.one_of(st.binary(max_size=300), st.lists(st.integers(0, 4), max_size=8).map(bytes), stuffed))
def test_cobs_decodes_as_the_library(data: bytes) -> None:
    assert decoded(cobs.encode(data)) == data
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        assert decoded(data) is None
    else:
        assert decoded(data) == expected
