"""Reads the programs that firmware.build links: what is loaded where, and where its parts lie."""

import struct
from dataclasses import dataclass
from pathlib import Path

_MAGIC = b"\x7fELF\x01\x01"  # 32 bits, little-endian
_LOADED, _SYMBOLS, _FUNCTION = 1, 2, 2


@dataclass(frozen=True)
class Segment:
    """What one program header tells: `data` goes to `load_address`, and takes part in a run at `address`."""

    address: int
    load_address: int
    size_bytes: int
    data: bytes


@dataclass(frozen=True)
class Section:
    """Where a section lies in memory."""

    address: int
    size_bytes: int


class Elf:
    """A linked 32-bit program: `segments` in memory, `sections` and `symbols` by name, names of `functions` by address.

    Tables as in the System V ABI, chapters 4 and 5. Raises ValueError for any other file.
    """

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        if not data.startswith(_MAGIC):
            raise ValueError(f"{path} is no 32-bit little-endian ELF file")
        programs_offset, sections_offset = struct.unpack_from("<II", data, 28)
        program_bytes, programs, section_bytes, sections, names = struct.unpack_from("<5H", data, 42)
        headers = [
            struct.unpack_from("<10I", data, sections_offset + section_bytes * index) for index in range(sections)
        ]
        self.segments: list[Segment] = []
        for index in range(programs):
            kind, offset, address, load_address, file_bytes, size_bytes = struct.unpack_from(
                "<6I", data, programs_offset + program_bytes * index
            )
            if kind == _LOADED and size_bytes:
                self.segments.append(Segment(address, load_address, size_bytes, data[offset : offset + file_bytes]))
        self.sections = {
            _text(data, headers[names][4] + name): Section(address, size_bytes)
            for name, _, _, address, _, size_bytes, *_ in headers
        }
        self.symbols: dict[str, int] = {}
        self.functions: dict[int, str] = {}
        for _, kind, _, _, offset, size_bytes, link, _, _, entry_bytes in headers:
            if kind == _SYMBOLS:
                for place in range(offset, offset + size_bytes, entry_bytes):
                    name, value, _, information = struct.unpack_from("<IIIB", data, place)
                    text = _text(data, headers[link][4] + name)
                    self.symbols[text] = value
                    if information & 0xF == _FUNCTION:
                        self.functions[value & ~1] = text

    def function_at(self, address: int) -> str:
        """Return the name of the last function that begins at an address or before it."""
        return self.functions.get(max((start for start in self.functions if start <= address), default=-1), "?")


def _text(data: bytes, offset: int) -> str:
    return data[offset : data.index(0, offset)].decode()
