"""Numbers as bytes, wire types that annotate the fields of a class, and the layout of bytes that they define."""

import binascii
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass
from enum import IntEnum
from functools import cache, lru_cache
from operator import attrgetter
from types import NoneType
from typing import Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

VARINT_BITS = 32
_MAX_VARINT = (1 << VARINT_BITS) - 1
MAX_VARINT_BYTES = -(-VARINT_BITS // 7)
SHA256_BYTES = 32
TLV_HEAD = struct.Struct("<BH")
"""Tag, then the length of the value."""


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


class BadValueError(ValueError):
    """A value of the right size without meaning."""


def check_factor(factor: float) -> float:
    """Return a finite factor of at least 0. Raises BadValueError for others."""
    if not (math.isfinite(factor) and factor >= 0):
        raise BadValueError(f"{factor} is not a finite factor of at least 0")
    return factor


def _sha256(sha256: bytes) -> bytes:
    if len(sha256) != SHA256_BYTES:
        raise ValueError(f"a SHA-256 has {SHA256_BYTES} bytes, not {len(sha256)}")
    return sha256


@dataclass(frozen=True)
class Fixed:
    """A field of the fixed part. `name`: as in docs/reference/protocol.md. `code`: of `struct`. `check`: validates."""

    name: str
    code: str
    check: Callable[[Any], Any] | None = None


@dataclass(frozen=True)
class Flag:
    """A u8 of flags in the fixed part, in which only 0x01 is known. Others are bad values."""

    code: str = "B"


@dataclass(frozen=True)
class Part:
    """A field behind the fixed part. `pack`: returns the bytes of a value. `unpack`: returns the value at a position of
    the data, and the position after it. Both raise ValueError."""

    name: str
    pack: Callable[[Any], bytes]
    unpack: Callable[[bytes, int], tuple[Any, int]]


@dataclass(frozen=True)
class Rest(Part):
    """A field that reaches to the end."""

    description: str


@dataclass(frozen=True)
class Tag:
    """The value of a TLV: bytes, a text, an object with a layout; or a tuple of these, in one TLV each.

    The TLV is required unless the field has a default or is a tuple.
    """

    number: int
    description: str


def _pack_varint(value: int) -> bytes:
    if not 0 <= value <= _MAX_VARINT:
        raise ValueError(f"{value} is not in 0 to {_MAX_VARINT}")
    return pack_varint(value)


def _unpack_varint(data: bytes, position: int) -> tuple[int, int]:
    return unpack_varint(data, position, VARINT_BITS)


def _pack_counted(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<B", len(encoded)) + encoded


def _unpack_counted(data: bytes, position: int) -> tuple[str, int]:
    length = _take(data, position, 1)[0]
    return _decode(str, _take(data, position + 1, length)), position + 1 + length


def _pack_items(items: tuple[bytes, ...]) -> bytes:
    pieces: list[bytes] = []
    for item in items:
        pieces += (pack_varint(len(item)), item)
    return b"".join(pieces)


def _unpack_items(data: bytes, position: int) -> tuple[tuple[bytes, ...], int]:
    items, end = [], len(data)
    while position < end:
        length, position = unpack_varint(data, position, VARINT_BITS)
        items.append(data[position : position + length])
        position += length
    if position > end:
        raise ValueError(f"an item of {length} bytes, {len(items[-1])} are left")
    return tuple(items), position


def rest(description: str) -> Rest:
    """Return a field of bytes to the end."""
    return Rest("bytes", bytes, lambda data, position: (data[position:], len(data)), description)


def rest_text(description: str) -> Rest:
    """Return a field of text to the end."""
    return Rest("text", str.encode, lambda data, position: (_decode(str, data[position:]), len(data)), description)


def rest_items(description: str) -> Rest:
    """Return a field of bytes objects to the end, each after its length as a varint."""
    return Rest("items", _pack_items, _unpack_items, description)


U8 = Annotated[int, Fixed("u8", "B")]
U16 = Annotated[int, Fixed("u16", "H")]
U32 = Annotated[int, Fixed("u32", "I")]
U64 = Annotated[int, Fixed("u64", "Q")]
I64 = Annotated[int, Fixed("i64", "q")]
F32 = Annotated[float, Fixed("f32", "f")]
FLAG = Annotated[bool, Flag()]
FACTOR = Annotated[float, Fixed("f32", "f", check_factor)]
"""Finite and at least 0."""
SHA256 = Annotated[bytes, Fixed(f"{SHA256_BYTES} bytes", f"{SHA256_BYTES}s", _sha256)]
VARINT = Annotated[int, Part("varint", _pack_varint, _unpack_varint)]
"""LEB128 of at most VARINT_BITS bits."""
COUNTED_TEXT = Annotated[str, Part("counted", _pack_counted, _unpack_counted)]
"""A text after its length in a u8."""

Wire = Fixed | Flag | Part | Tag


@dataclass(frozen=True)
class WireField:
    """A field of a class: its name, its type in Python, how it lies on the wire, its default or MISSING."""

    name: str
    type: Any
    wire: Wire
    default: Any

    @property
    def item(self) -> Any:
        """The type of the items of a tuple, of an optional value, or the type itself."""
        return get_args(self.type)[0] if self.is_tuple or self.is_optional else self.type

    @property
    def is_tuple(self) -> bool:
        """Whether the field is a tuple."""
        return get_origin(self.type) is tuple

    @property
    def is_optional(self) -> bool:
        """Whether the field may be None, which its tag's absence means."""
        return NoneType in get_args(self.type)

    def items(self, value: Any) -> tuple[Any, ...]:
        """Return the items of a value, each for a tag of its own."""
        if self.is_tuple:
            return tuple(value)
        return () if value is None else (value,)


def wire_fields(owner: type) -> list[WireField]:
    """Return the fields of a dataclass or named tuple as they lie on the wire.

    The fixed part comes first, then the others, both in declaration order. An IntEnum is a u8.
    """
    fields = []
    for name, hint in get_type_hints(owner, include_extras=True).items():
        if get_origin(hint) is ClassVar:
            continue
        kind, wire = get_args(hint) if get_origin(hint) is Annotated else (hint, Fixed("u8", "B", _member_of(hint)))
        default = getattr(owner, name, MISSING)
        if isinstance(default, Field):
            default = default.default
        fields.append(WireField(name, kind, wire, default))
    return sorted(fields, key=lambda field: not isinstance(field.wire, Fixed | Flag))


def _member_of(enumeration: type[IntEnum]) -> Callable[[int], IntEnum]:
    members = {int(member): member for member in enumeration}

    def member(value: int) -> IntEnum:
        try:
            return members[value]
        except KeyError:
            raise BadValueError(f"{value} is no {enumeration.__name__}") from None

    return member


class Layout:
    """The bytes of a class's objects: the fixed part, then the other fields.

    Unless a field reaches to the end, TLVs follow or, with `skipped`, additions of a later minor version. A method
    `check` of the class raises ValueError if fields contradict each other.
    """

    def __init__(self, owner: type, *, skipped: bool = False) -> None:
        self._owner = owner
        fields = wire_fields(owner)
        self._names = [field.name for field in fields if isinstance(field.wire, Fixed | Flag)]
        self.fixed = struct.Struct("<" + "".join(f.wire.code for f in fields if isinstance(f.wire, Fixed | Flag)))
        self._checks = [(i, f.wire.check) for i, f in enumerate(fields) if isinstance(f.wire, Fixed) and f.wire.check]
        self._flags = [i for i, f in enumerate(fields) if isinstance(f.wire, Flag)]
        self._parts = [(f.name, f.wire) for f in fields if isinstance(f.wire, Part)]
        self._tags = [(f, f.wire) for f in fields if isinstance(f.wire, Tag)]
        self._check_all: Callable[[Any], None] | None = getattr(owner, "check", None)
        self._has_tlvs = not skipped and not any(isinstance(field.wire, Rest) for field in fields)
        self._get = attrgetter(*self._names) if self._names else None
        self._has_one = len(self._names) == 1

    def pack(self, value: Any) -> bytes:
        """Return the bytes of an object. Raises ValueError for a value that its field cannot hold."""
        if self._check_all:
            self._check_all(value)
        fixed = self._get(value) if self._get else ()
        if self._has_one:
            fixed = (fixed,)
        for index, check in self._checks:
            check(fixed[index])
        try:
            packed = self.fixed.pack(*fixed)
            for name, part in self._parts:
                packed += part.pack(getattr(value, name))
            for field, tag in self._tags:
                for item in field.items(getattr(value, field.name)):
                    encoded = _encode(field.item, item)
                    packed += TLV_HEAD.pack(tag.number, len(encoded)) + encoded
        except (struct.error, OverflowError) as error:
            raise ValueError(str(error)) from error
        return packed

    def unpack(self, data: bytes, position: int = 0) -> Any:
        """Return the object whose bytes begin at `position`. Raises ValueError, for values BadValueError."""
        end = position + self.fixed.size
        if len(data) < end:
            raise ValueError(f"{len(data) - position} bytes, at least {self.fixed.size} are needed")
        fixed = [*self.fixed.unpack_from(data, position)]
        for index in self._flags:
            if fixed[index] > 1:
                raise BadValueError(f"flags 0x{fixed[index]:02x} are set, only 0x01 is known")
            fixed[index] = bool(fixed[index])
        others: dict[str, Any] = {}
        for name, part in self._parts:
            others[name], end = part.unpack(data, end)
        if self._has_tlvs and (self._tags or end < len(data)):
            others |= self._unpack_tags(list(_tlvs(data, end)))
        for index, check in self._checks:
            fixed[index] = check(fixed[index])
        if not others:
            return self._owner(*fixed)
        unpacked = self._owner(**dict(zip(self._names, fixed, strict=True)), **others)
        if self._check_all:
            self._check_all(unpacked)
        return unpacked

    def _unpack_tags(self, tlvs: list[tuple[int, bytes]]) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for field, tag in self._tags:
            found = [value for number, value in tlvs if number == tag.number]
            if field.is_tuple:
                values[field.name] = tuple([_decode(field.item, value) for value in found])
            elif found:
                values[field.name] = _decode(field.item, found[-1])
            elif field.default is MISSING:
                raise ValueError(f"tag {tag.number} is missing: {tag.description}")
        return values


@cache
def _layout_of(owner: type) -> Layout:
    """Return the layout of a class whose objects are values of TLVs; it skips additions of later versions."""
    return Layout(owner, skipped=True)


def _encode(kind: Any, value: Any) -> bytes:
    if kind is bytes:
        return bytes(value)
    return bytes(value.encode()) if kind is str else _layout_of(kind).pack(value)


def _decode(kind: Any, data: bytes) -> Any:
    if kind is bytes:
        return data
    if kind is not str:
        return _layout_of(kind).unpack(data)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ValueError("text that is not UTF-8") from error


def _take(data: bytes, position: int, length: int) -> bytes:
    if length > len(data) - position:
        raise ValueError(f"a field of {length} bytes, {len(data) - position} are left")
    return data[position : position + length]


def _tlvs(data: bytes, position: int) -> Iterator[tuple[int, bytes]]:
    """Yield (tag, value) of each TLV from `position` on. Raises ValueError if a length does not fit."""
    while position < len(data):
        tag, length = TLV_HEAD.unpack(_take(data, position, TLV_HEAD.size))
        yield tag, _take(data, position + TLV_HEAD.size, length)
        position += TLV_HEAD.size + length
