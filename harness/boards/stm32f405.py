"""The firmware of the Feather STM32F405 on an emulated board: the same image as for the board, with interrupts."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards.board import FIRST_LINE, NEVER, Board
from vibrocast.harness.boards.emulator import SYSTEM_SPACE, Processor
from vibrocast.host.devices import FirmwareDevice
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.flash import FlashMemory

FLASH_BYTES = 1 << 20
"""All of the chip's flash: firmware, records and model images."""

_FLASH, _PERIPHERALS = 0x0800_0000, 0x4000_0000
_PERIPHERALS_BYTES = 0x2_4000
# The last is of the system memory, which holds the chip's unique number.
_MEMORIES = {0x2000_0000: 128 << 10, 0x1000_0000: 64 << 10, 0x1FFF_7000: 4 << 10}
_UNIQUE = 0x1FFF_7A10
UNIQUE_NUMBER = b"emulated.405"
"""Of the emulated chip; HelloResponse states it in hexadecimal."""
_SECTOR_STARTS = (*range(0, 0x1_0000, 0x4000), 0x1_0000, *range(0x2_0000, FLASH_BYTES + 1, 0x2_0000))
_MIDDLE = 2048  # of the DAC's range
# Time is counted in ticks of the timers' clock, 84 MHz; SysTick's goes twice as fast.
_TICKS_PER_US = 84
_TICKS_PER_MS = 1000 * _TICKS_PER_US
_CYCLES_PER_TICK = 2
# The least time after which the chip's independent watchdog resets it (board.h).
_WATCHDOG_US = 2_700_000

# Registers, by their offset from _PERIPHERALS; names and bits as in firmware/ports/stm32f405/registers.h.
_TIM6_CR1, _TIM6_ARR = 0x1000, 0x102C
_IWDG_KR = 0x3000
_USART_SR, _USART_DR, _USART_CR1 = 0x4800, 0x4804, 0x480C
_RXNE, _TXE, _RXNEIE, _TXEIE = 1 << 5, 1 << 7, 1 << 5, 1 << 7
_DHR12RD = 0x7420
_RCC_CR, _RCC_CFGR = 0x2_3800, 0x2_3808
_FLASH_KEYR, _FLASH_SR, _FLASH_CR = 0x2_3C04, 0x2_3C0C, 0x2_3C10
_KEYS = (0x4567_0123, 0xCDEF_89AB)
_PG, _SER, _STRT, _LOCK = 1, 1 << 1, 1 << 16, 1 << 31
_PGPERR, _PGSERR = 1 << 6, 1 << 7

# A register of the system space, and numbers of exceptions.
_SYSTICK_VALUE = 0x18
_SYSTICK, _USART3, _TIM6 = 15, FIRST_LINE + 39, FIRST_LINE + 54

_LINE_BYTES = 65_536
# Bytes from the host come together, as an adapter on USB has them: each takes ten bits of 921 600 baud.
_TOGETHER_BYTES = 64
_TOGETHER_TICKS = _TOGETHER_BYTES * 1000 * _TICKS_PER_MS * 10 // 921_600


class Stm32F405(Board):
    """A controller (simulated_device.device.Device): the firmware built for `stm32f405` on an emulated board.

    `actuator`: a C source with the actuator, as firmware.build takes it; None = the port's.
    `flash`: FLASH_BYTES bytes, in which images outlive this object; None = a blank one. A file behind it is not
    written. `on_dac`: called with each run of the DAC's output, int16 (n, 2), 0 = the middle of its range. `drift_ppm`:
    how much faster than true time its clock runs.

    It emulates processor, memory, SysTick, interrupts, USART3 with the time that bytes to it take, TIM6, the DAC's
    register, the flash interface, and clocks that are ready at once. Interrupts come only where the image waits for
    one. All other registers of the chip keep the values written to them. Raises as CortexM does.
    """

    def __init__(
        self,
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
        drift_ppm: int = 0,
        actuator: Path | None = None,
    ) -> None:
        self._flash = flash or FlashMemory(FLASH_BYTES, sector_bytes=1 << 14)
        processor = Processor(
            Elf(build("stm32f405", actuator=actuator)),
            "M4",
            _MEMORIES,
            (_FLASH, self._flash),
            self._write_flash,
        )
        super().__init__(processor, _TICKS_PER_US, _CYCLES_PER_TICK, _WATCHDOG_US, on_dac, drift_ppm)
        processor.add_registers(_PERIPHERALS, self._read, self._write, _PERIPHERALS_BYTES)
        processor.add_registers(SYSTEM_SPACE, self._read_system, self._write_system)
        self._registers = defaultdict(int, {_FLASH_CR: _LOCK})
        self._keys: tuple[int, ...] = ()
        self._programmed: list[tuple[int, int]] = []  # offset and byte of unfinished writes
        self._next_conversion = self._next_bytes = self._ready_bytes = 0
        self._next_millisecond = _TICKS_PER_MS
        processor.unicorn.mem_write(_UNIQUE, UNIQUE_NUMBER)
        self.boot()

    def _due(self) -> int | None:
        if self._next_conversion <= self._now:
            self._next_conversion += self._registers[_TIM6_ARR] + 1
            return _TIM6
        if self._next_millisecond <= self._now:
            self._next_millisecond += _TICKS_PER_MS
            return _SYSTICK
        return _USART3 if self._receives() or self._sends() else None

    def _next_event(self) -> int:
        receiving = self._incoming and self._registers[_USART_CR1] & _RXNEIE
        return min(self._next_millisecond, self._next_conversion, self._next_bytes if receiving else NEVER)

    def _receives(self) -> bool:
        return self._has_byte() and bool(self._registers[_USART_CR1] & _RXNEIE)

    def _next_byte(self) -> int:
        if not self._incoming:
            return 0
        if self._ready_bytes == 0:
            self._ready_bytes = _TOGETHER_BYTES
            self._next_bytes = self._now + _TOGETHER_TICKS
        self._ready_bytes -= 1
        return self._incoming.popleft()

    def _has_byte(self) -> bool:
        return bool(self._incoming) and (self._ready_bytes > 0 or self._next_bytes <= self._now)

    def _sends(self) -> bool:
        return len(self._outgoing) < _LINE_BYTES and bool(self._registers[_USART_CR1] & _TXEIE)

    def _read(self, offset: int) -> int:
        if offset == _USART_SR:
            return (_RXNE if self._has_byte() else 0) | (_TXE if len(self._outgoing) < _LINE_BYTES else 0)
        if offset == _USART_DR:
            return self._next_byte()
        if offset == _FLASH_SR:
            self._finish_programming()
        value = self._registers[offset]
        if offset == _RCC_CR:
            return value | value << 1  # a clock that is on is ready
        if offset == _RCC_CFGR:
            return value | (value & 3) << 2  # a chosen clock is in use
        return value

    def _write(self, offset: int, value: int) -> None:
        if offset == _USART_DR:
            self._outgoing.append(value & 0xFF)
        elif offset == _IWDG_KR:
            self._feed_watchdog()
        elif offset == _FLASH_KEYR:
            self._keys = (*self._keys, value)[-2:]
            if self._keys == _KEYS:
                self._registers[_FLASH_CR] &= ~_LOCK
        elif offset == _FLASH_SR:
            self._registers[offset] = self._registers[offset] & ~value
        elif offset == _FLASH_CR:
            if self._registers[_FLASH_CR] & _LOCK:
                return
            self._registers[offset] = value & ~_STRT
            if value & _STRT and value & _SER:
                sector = value >> 3 & 0xF
                start, end = _SECTOR_STARTS[sector : sector + 2]
                self._flash.contents[start:end] = b"\xff" * (end - start)
        else:
            self._registers[offset] = value
            if offset == _DHR12RD:
                self._codes.append(((value & 0xFFF) - _MIDDLE, (value >> 16 & 0xFFF) - _MIDDLE))

    def _write_flash(self, offset: int, size_bytes: int, value: int) -> None:
        """Note the bytes of a write to flash: the processor writes all of it, whatever flash makes of it."""
        old = bytes(self._flash.contents[offset : offset + size_bytes])
        control = self._registers[_FLASH_CR]
        new = old
        if control & _LOCK or not control & _PG:
            self._registers[_FLASH_SR] |= _PGSERR
        elif 1 << (control >> 8 & 3) != size_bytes or offset % size_bytes:
            self._registers[_FLASH_SR] |= _PGPERR
        else:
            new = bytes(a & b for a, b in zip(old, value.to_bytes(size_bytes, "little"), strict=True))
        self._programmed += enumerate(new, offset)

    def _finish_programming(self) -> None:
        for offset, byte in self._programmed:
            self._flash.contents[offset] = byte
        self._programmed.clear()

    def _read_system(self, offset: int) -> int:
        if offset == _SYSTICK_VALUE:
            left = self._next_millisecond - self._time()
            return (_CYCLES_PER_TICK * left - 1) % (_CYCLES_PER_TICK * _TICKS_PER_MS)
        return super()._read_system(offset)


DEVICE = FirmwareDevice(
    summary="the firmware of the Feather STM32F405 board, emulated",
    board=Stm32F405,
    channels=2,
    core="M4F",
    clock_hz=168e6,
    flash_bytes=FLASH_BYTES,
    ram_bytes=192 * 1024,
)
"""The address `stm32f405`."""
