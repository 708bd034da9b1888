"""CRC-16, CRC-32 and SHA-256 of the core against the libraries that Python uses."""

import hashlib
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.firmware.native import ffi, native
from vibrocast.device_protocol.encoding import crc16


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
