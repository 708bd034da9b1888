"""CRC-16 against its published check value, and variable-length numbers, written and read."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.layout import crc16, pack_varint, unpack_varint


def test_crc_check_value_in_one_piece_and_in_two() -> None:
    assert crc16(b"123456789") == 0x29B1
    assert crc16(b"6789", crc16(b"12345")) == 0x29B1


@given(st.integers(1, 70), st.data())
def test_varint_round_trip(bits: int, data: st.DataObject) -> None:
    value = data.draw(st.integers(0, 2**bits - 1))
    packed = pack_varint(value)
    assert unpack_varint(b"\xff" + packed + b"\xff", 1, bits) == (value, 1 + len(packed))
    with pytest.raises(ValueError, match="cut"):
        unpack_varint(packed[:-1], 0, bits)


@pytest.mark.parametrize("data", [pack_varint(2**32), pack_varint(2**35), b"\x81\x80\x80\x80\x80\x00", b"", b"\x80"])
def test_varint_that_is_cut_or_too_long_is_rejected(data: bytes) -> None:
    with pytest.raises(ValueError, match="longer than 32 bits"):
        unpack_varint(data, 0, 32)
