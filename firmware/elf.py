"""Reads the programs that firmware.build links: their bytes, their addresses, and their parts."""

from dataclasses import dataclass
from pathlib import Path

from vibrocast import extras


@dataclass(frozen=True)
class Segment:
    """One program header: `data` is stored at `load_address`, and used at `address`."""

    address: int
    load_address: int
    size_bytes: int
    data: bytes


@dataclass(frozen=True)
class Section:
    """The place of a section in memory."""

    address: int
    size_bytes: int


class Elf:
    """A linked 32-bit program: `segments` in memory, `sections` and `symbols` by name, names of `functions` by address.

    Raises ValueError for any other file, and MissingExtraError.
    """

    def __init__(self, path: Path) -> None:
        extras.require("firmware", "elftools")
        from elftools.common.exceptions import ELFError
        from elftools.elf.elffile import ELFFile
        from elftools.elf.sections import SymbolTableSection

        with path.open("rb") as file:
            try:
                program = ELFFile(file)
            except ELFError as error:
                raise ValueError(f"{path}: not an ELF file: {error}") from error
            if program.elfclass != 32 or not program.little_endian:
                raise ValueError(f"{path}: not a 32-bit little-endian ELF file")
            self.segments = [
                Segment(part["p_vaddr"], part["p_paddr"], part["p_memsz"], part.data())
                for part in program.iter_segments("PT_LOAD")
                if part["p_memsz"]
            ]
            sections = list(program.iter_sections())
            self.sections = {part.name: Section(part["sh_addr"], part["sh_size"]) for part in sections}
            symbols = [
                symbol for part in sections if isinstance(part, SymbolTableSection) for symbol in part.iter_symbols()
            ]
        self.symbols = {symbol.name: int(symbol["st_value"]) for symbol in symbols}
        self.functions = {
            int(symbol["st_value"]) & ~1: str(symbol.name)
            for symbol in symbols
            if symbol["st_info"]["type"] == "STT_FUNC"
        }

    def function_at(self, address: int) -> str:
        """Return the name of the last function that begins at an address or before it."""
        return self.functions.get(max((start for start in self.functions if start <= address), default=-1), "?")
