"""A firmware image on an emulated Cortex-M: processor and memory in Unicorn, to which boards add peripherals."""

import ctypes
from collections.abc import Callable
from typing import Any

from vibrocast import extras
from vibrocast.errors import VibrocastError
from vibrocast.firmware.elf import Elf
from vibrocast.simulated_device.flash import FlashMemory

PAGE_BYTES = 4096
SYSTEM_SPACE = 0xE000_E000
"""Address of the processor's own registers: SysTick, interrupt controller, FPU (DDI 0403, B3.2.1)."""

_PAINT = b"\xa5"
# The processor never fetches instructions from there.
_NOWHERE = 0xFFFF_FFFE
_IN_CONDITION = 0x0600_FC00  # of xPSR: the conditions of the instructions behind an IT
_FRAME_BYTES = 104
# ARM DDI 0439, 3.9: 12 cycles of latency, and as many to return.
_ENTRY_AND_EXIT_CYCLES = 24


class EmulationError(VibrocastError):
    """The image did something that stops a processor."""


class Processor:
    """A Cortex-M with an image in its memory, about to come out of reset.

    `processor`: as Unicorn names it, "M4" of UC_CPU_ARM_CORTEX_M4. `memories`: address and size of each memory except
    `flash`. That is mapped, not copied, so writes of the image stay there. `on_flash_write`: called with offset, size
    and value before each of these writes. `counter`: what the code takes.
    """

    def __init__(
        self,
        image: Elf,
        processor: str,
        memories: dict[int, int],
        flash: tuple[int, FlashMemory],
        on_flash_write: Callable[[int, int, int], None] | None = None,
    ) -> None:
        extras.require("firmware", "unicorn", "capstone", "ziglang")
        # Only what emulates needs the extra: the rest of a board's file loads without.
        import unicorn
        from unicorn import arm_const

        from vibrocast.harness.boards.cycles import CycleCounter

        self._arm, self._error = arm_const, unicorn.UcError
        self._image = image
        self._flash_address, self._flash = flash  # keeps the mapped bytes alive
        self._on_flash_write = on_flash_write
        self._failure = ""
        self.unicorn: Any = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self.unicorn.ctl_set_cpu_model(getattr(arm_const, f"UC_CPU_ARM_CORTEX_{processor}"))
        for address, size_bytes in memories.items():
            self.unicorn.mem_map(address, size_bytes)
        pointer = ctypes.addressof(ctypes.c_char.from_buffer(self._flash.contents))
        access = unicorn.UC_PROT_ALL
        if on_flash_write is not None:
            access &= ~unicorn.UC_PROT_WRITE
            self.unicorn.hook_add(unicorn.UC_HOOK_MEM_WRITE_PROT, self._write_flash)
        self.unicorn.mem_map_ptr(self._flash_address, len(self._flash), access, pointer)
        for segment in image.segments:
            self.unicorn.mem_write(segment.load_address, segment.data)
        self._stack = image.sections[".stack"]
        self.unicorn.mem_write(self._stack.address, _PAINT * self._stack.size_bytes)
        self.unicorn.hook_add(unicorn.UC_HOOK_INTR, self._stop_at_exception)
        self.unicorn.hook_add(unicorn.UC_HOOK_MEM_UNMAPPED, self._stop_at_no_memory)
        self.counter = CycleCounter(self.unicorn)
        vectors = image.sections.get(".vectors", image.segments[0]).address
        self._return_address = vectors  # there is no instruction
        stack_top, reset = (int.from_bytes(self.unicorn.mem_read(vectors + 4 * index, 4), "little") for index in (0, 1))
        self.unicorn.reg_write(arm_const.UC_ARM_REG_SP, stack_top)
        self.unicorn.reg_write(arm_const.UC_ARM_REG_PC, reset)

    def add_registers(
        self, address: int, read: Callable[[int], int], write: Callable[[int, int], None], size_bytes: int = PAGE_BYTES
    ) -> None:
        """Put a peripheral's registers at `address`: `read` is called with an offset, `write` with offset and value."""
        self.unicorn.mmio_map(
            address,
            size_bytes,
            lambda _, offset, size, context: read(offset),
            None,
            lambda _, offset, size, value, context: write(offset, value),
            None,
        )

    def run(self, deadline_cycles: int | None = None) -> None:
        """Run until `stop`, until the image waits for an interrupt, or until the counter has reached a deadline.

        Raises EmulationError.
        """
        self.counter.stop_at(deadline_cycles)
        self._go_on(self.unicorn.reg_read(self._arm.UC_ARM_REG_PC), _NOWHERE)

    @property
    def masks_interrupts(self) -> bool:
        """Whether the image has interrupts switched off."""
        return bool(self.unicorn.reg_read(self._arm.UC_ARM_REG_PRIMASK))

    def _go_on(self, where: int, until: int) -> None:
        try:
            self.unicorn.emu_start(where | 1, until)
        except self._error as error:
            self._failure = self._failure or str(error)
        if self._failure:
            where = self.unicorn.reg_read(self._arm.UC_ARM_REG_PC)
            function = self._image.function_at(where)
            raise EmulationError(f"the image stopped at 0x{where:08x} ({function}): {self._failure}")

    def stop(self) -> None:
        """Make `run` return; peripherals call it."""
        self.unicorn.emu_stop()

    def stack_bytes(self) -> int:
        """Return the most bytes of stack used so far."""
        stack = bytes(self.unicorn.mem_read(self._stack.address, self._stack.size_bytes))
        return len(stack.lstrip(_PAINT))

    def interrupt(self, handler: int) -> None:
        """Run an interrupt's handler to its end, as if it came where the image has stopped. Raises EmulationError.

        The stack keeps room for a frame with the FPU's registers (DDI 0403, B1.5.6), and all registers come back.
        """
        before = self.unicorn.context_save()
        self.counter.add_cycles(_ENTRY_AND_EXIT_CYCLES)
        self.counter.stop_at(None)
        self.unicorn.reg_write(self._arm.UC_ARM_REG_SP, self.unicorn.reg_read(self._arm.UC_ARM_REG_SP) - _FRAME_BYTES)
        self.unicorn.reg_write(self._arm.UC_ARM_REG_LR, self._return_address | 1)
        status = self.unicorn.reg_read(self._arm.UC_ARM_REG_XPSR)
        self.unicorn.reg_write(self._arm.UC_ARM_REG_XPSR, status & ~_IN_CONDITION)
        self._go_on(handler, self._return_address)
        self.unicorn.context_restore(before)

    def _write_flash(
        self, emulator: Any, kind: int, address: int, size_bytes: int, value: int, context: object
    ) -> bool:
        assert self._on_flash_write is not None
        self._on_flash_write(address - self._flash_address, size_bytes, value)
        return True

    def _stop_at_exception(self, emulator: Any, number: int, context: object) -> None:
        self._failure = f"exception {number}"
        emulator.emu_stop()

    def _stop_at_no_memory(
        self, emulator: Any, kind: int, address: int, size_bytes: int, value: int, context: object
    ) -> bool:
        self._failure = f"there is nothing at 0x{address:08x}"
        return False
