"""Encodings that frames, messages and coded streams share: CRC-16 and numbers of variable length."""

import binascii
from collections.abc import Callable
from functools import lru_cache


def crc16(data: bytes, start: int = 0xFFFF) -> int:
    """CRC-16/IBM-3740 (also "CCITT-FALSE"): polynomial 0x1021, not reflected, no final XOR.

    `start`: the CRC of the bytes before, or the initial state.
    """
    return binascii.crc_hqx(data, start)


@lru_cache(maxsize=4096)
def pack_varint(value: int) -> bytes:
    """Return `value` >= 0 as LEB128: seven bits a byte, lowest first, the top bit set on all but the last byte."""
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def unpack_varint(data: bytes, position: int, bits: int) -> tuple[int, int]:
    """Return the LEB128 number at `position` and the position after it.

    Raises ValueError if it is cut, or longer than `bits`; extra zeros above them count, if they take more bytes.
    """
    if bits >= 7 and position < len(data) and data[position] < 0x80:
        return data[position], position + 1
    value = 0
    for index, byte in enumerate(data[position : position + -(-bits // 7)]):
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80 and value < 1 << bits:
            return value, position + index + 1
    raise ValueError(f"a number of variable length is cut or longer than {bits} bits")


class Reader:
    """Takes fields from the front of `data`. `error`: makes the exception for a flaw from its text."""

    def __init__(self, data: bytes, error: Callable[[str], Exception], position: int = 0) -> None:
        self.position = position
        self._data, self._error = data, error

    @property
    def at_end(self) -> bool:
        """Whether nothing is left."""
        return self.left == 0

    @property
    def left(self) -> int:
        """Bytes that are left."""
        return len(self._data) - self.position

    def take(self, count: int) -> bytes:
        """Take `count` bytes."""
        end = self.position + count
        if end > len(self._data):
            raise self._error(f"{len(self._data)} bytes, {end} are needed")
        taken = self._data[self.position : end]
        self.position = end
        return taken

    def varint(self, bits: int) -> int:
        """Take a LEB128 number of at most `bits` bits."""
        try:
            value, self.position = unpack_varint(self._data, self.position, bits)
        except ValueError as error:
            raise self._error(str(error)) from error
        return value
