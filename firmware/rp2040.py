"""Finishes an image for the RP2040: writes the checksum of its second boot stage, and a file in UF2."""

import struct
from pathlib import Path

from vibrocast import extras

FLASH = 0x1000_0000
"""Address at which flash begins."""
BOOT_BYTES = 256
"""Of the second boot stage, its checksum included."""

# Microsoft, UF2 file format: three magic numbers, a flag "family ID present", and the ID of the RP2040.
_MAGIC_START, _MAGIC_END = (0x0A32_4655, 0x9E5D_5157), 0x0AB1_6F30
_FAMILY_PRESENT, _FAMILY_RP2040 = 0x2000, 0xE48B_FF56
_PAGE_BYTES, _BLOCK_DATA_BYTES = 256, 476


def checksum(code: bytes) -> int:
    """Return the CRC-32 that the boot ROM computes over the first 252 bytes (RP2040 datasheet, 2.8.1.3.1)."""
    register = 0xFFFF_FFFF
    for byte in code:
        register ^= byte << 24
        for _ in range(8):
            register = (register << 1 ^ (0x04C1_1DB7 if register >> 31 else 0)) & 0xFFFF_FFFF
    return register


def finish(image: Path) -> None:
    """Write the checksum into a linked image, and next to it the file that a board takes over USB, suffix ".uf2".

    Raises ValueError if the image has no second boot stage, and MissingExtraError.
    """
    extras.require("firmware", "elftools")
    from elftools.elf.elffile import ELFFile

    with image.open("r+b") as file:
        section = ELFFile(file).get_section_by_name(".boot2")
        if section is None:
            raise ValueError(f"{image}: no section .boot2; take the linker script of ports/rp2040")
        code = section.data()[: BOOT_BYTES - 4]
        file.seek(section["sh_offset"] + BOOT_BYTES - 4)
        file.write(struct.pack("<I", checksum(code)))
    image.with_suffix(".uf2").write_bytes(uf2(image))


def uf2(image: Path) -> bytes:
    """Return the image's bytes in flash as blocks of UF2, each a page of 256 bytes."""
    from vibrocast.firmware.elf import Elf

    pages: dict[int, bytearray] = {}
    for segment in Elf(image).segments:
        for place, byte in enumerate(segment.data, segment.load_address):
            page = pages.setdefault(place // _PAGE_BYTES * _PAGE_BYTES, bytearray(b"\xff" * _PAGE_BYTES))
            page[place % _PAGE_BYTES] = byte
    return b"".join(
        struct.pack(
            f"<8I{_BLOCK_DATA_BYTES}sI",
            *_MAGIC_START,
            _FAMILY_PRESENT,
            address,
            _PAGE_BYTES,
            number,
            len(pages),
            _FAMILY_RP2040,
            bytes(pages[address]),
            _MAGIC_END,
        )
        for number, address in enumerate(sorted(pages))
    )
