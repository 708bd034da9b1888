"""Flash memory in a file, and its connection to the controller in C; the power may fail at any byte."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast.files import atomic_write
from vibrocast.simulated_device.callbacks import Callbacks

SLOTS = 2
ERASED = 0xFF


class PowerCut(Exception):
    """The power failed while flash was being written; raised only on a test's request."""


class FlashMemory:
    """Flash: erasing a sector sets its bytes to 0xFF; then each piece of `write_bytes` may be programmed once.

    Kept in the file `path`, or only in memory without one. `cut_after_bytes`: raise PowerCut after this many bytes more
    have been erased or programmed, with the next one half done; None = never. The piece of a cut takes nothing more,
    even if it looks blank. Raises OSError if the file cannot be used, ValueError if it has another size.
    """

    def __init__(
        self, size_bytes: int, sector_bytes: int = 4096, path: Path | None = None, write_bytes: int = 1
    ) -> None:
        self.sector_bytes, self.write_bytes = sector_bytes, write_bytes
        self.cut_after_bytes: int | None = None
        self._path = path
        self._data = bytearray([ERASED]) * size_bytes
        if path is not None and path.exists():
            if (held_bytes := path.stat().st_size) != size_bytes:
                raise ValueError(f"{path} has {held_bytes} bytes, not the {size_bytes} of this flash; delete it")
            self._data = bytearray(path.read_bytes())
        elif path is not None:
            with atomic_write(path) as partial:
                partial.write_bytes(self._data)
        self._programmed = np.any(np.frombuffer(self._data, np.uint8).reshape(-1, write_bytes) != ERASED, axis=1)

    def __len__(self) -> int:
        return len(self._data)

    @property
    def contents(self) -> memoryview:
        """All bytes, in place; changes to them do not go to the file."""
        return memoryview(self._data)

    def read(self, address: int, count: int) -> bytes:
        """Return `count` bytes from `address` on."""
        return bytes(self._data[address : address + count])

    def erase(self, address: int, count: int) -> None:
        """Erase whole sectors: `address` and `count` are multiples of the sector size."""
        self._change(address, bytes([ERASED]) * count, lambda byte, _: byte | 0xF0)
        self._programmed[address // self.write_bytes : (address + count) // self.write_bytes] = False

    def program(self, address: int, data: bytes) -> None:
        """Write whole pieces. Raises ValueError if they are not, OSError if one has been programmed before."""
        if address % self.write_bytes or len(data) % self.write_bytes:
            raise ValueError(f"{len(data)} bytes at {address}: not in whole writes of {self.write_bytes}")
        first, count = address // self.write_bytes, len(data) // self.write_bytes
        if self._programmed[first : first + count].any():
            raise OSError(f"{len(data)} bytes at {address}: programmed twice")
        begun = count if self.cut_after_bytes is None else min(count, self.cut_after_bytes // self.write_bytes + 1)
        self._programmed[first : first + begun] = True
        self._change(address, data, lambda byte, after: byte & (after | 0x0F))

    def _change(self, address: int, after: bytes, half_done: Callable[[int, int], int]) -> None:
        """Change bytes, up to a cut; `half_done` returns a byte's value half-way, from before and after."""
        done = len(after)
        if self.cut_after_bytes is not None:
            done = min(done, self.cut_after_bytes)
            self.cut_after_bytes -= done
        cut = done < len(after)
        changed = after
        if cut:
            changed = after[:done] + bytes([half_done(self._data[address + done], after[done])])
        if self._path is not None:
            with self._path.open("r+b") as file:
                file.seek(address)
                file.write(changed)
        self._data[address : address + len(changed)] = changed
        if cut:
            raise PowerCut


class FlashPort:
    """A FlashMemory for the controller in C: `pointer` is its vc_flash.

    The memory has a sector for each copy of the record, then two slots of the same size. An OSError means that the
    flash did not take the data; `callbacks` keeps all other exceptions of the memory.
    """

    def __init__(self, ffi: Any, flash: FlashMemory, callbacks: Callbacks) -> None:
        def changed(change: Callable[..., None], *arguments: Any) -> int:
            try:
                change(*arguments)
            except OSError:
                return -1
            return 0

        def erase(context: Any, offset: int, length: int) -> int:
            return changed(flash.erase, offset, length)

        def program(context: Any, offset: int, data: Any, length: int) -> int:
            return changed(flash.program, offset, bytes(ffi.buffer(data, length)))

        sector_bytes = flash.sector_bytes
        slot_bytes = (len(flash) // sector_bytes - 2) // SLOTS * sector_bytes
        self._kept = (
            ffi.from_buffer(flash.contents),
            callbacks.make("int(void *, uint32_t, uint32_t)", erase, -1),
            callbacks.make("int(void *, uint32_t, const uint8_t *, uint32_t)", program, -1),
        )
        base, erase_callback, program_callback = self._kept
        self.pointer = ffi.new(
            "vc_flash *",
            {
                "base": base,
                "record": [0, sector_bytes],
                "record_bytes": sector_bytes,
                "slot": [2 * sector_bytes, 2 * sector_bytes + slot_bytes],
                "slot_bytes": slot_bytes,
                "write_bytes": flash.write_bytes,
                "erase": erase_callback,
                "program": program_callback,
            },
        )
