"""The firmware of a board with an RP2040 on an emulated processor: the same image as for the board, with interrupts."""

from collections import defaultdict, deque
from collections.abc import Callable

import numpy as np

from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards.board import FIRST_LINE, NEVER, Board
from vibrocast.harness.boards.emulator import SYSTEM_SPACE, EmulationError, Processor
from vibrocast.host.devices import FirmwareDevice
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.flash import FlashMemory

FLASH_BYTES = 2 << 20
"""All of the board's flash: firmware, records and model images."""
UNIQUE_NUMBER = b"emulated"
"""Of the emulated flash chip; HelloResponse states it in hexadecimal."""

_FLASH, _ROM, _RAM = 0x1000_0000, 0, 0x2000_0000
_ROM_BYTES, _RAM_BYTES = 16 << 10, 264 << 10
_PERIPHERALS, _PERIPHERALS_BYTES = 0x4000_0000, 0x1030_0000
_SSI, _SSI_SR, _SSI_DR0 = 0x1800_0000, 0x28, 0x60
_CHIP_SELECT, _SELECTED, _READ_UNIQUE = 0x1_800C, 2 << 8, 0x4B
# Time is counted in cycles of the processor, 120 MHz.
_TICKS_PER_US = 120
_WATCHDOG_US = 4_000_000

# Registers, by their offset from _PERIPHERALS; names and bits as in firmware/ports/rp2040/registers.h.
_RESETS, _RESETS_DONE = 0xC000, 0xC008
_CLK_REF, _CLK_REF_SELECTED, _CLK_SYS, _CLK_SYS_SELECTED = 0x8030, 0x8038, 0x803C, 0x8044
_XOSC_STATUS, _PLL_CS = 0x2_4004, 0x2_8000
_UART_DR, _UART_FR, _UART_IMSC, _UART_ICR = 0x3_4000, 0x3_4018, 0x3_4038, 0x3_4044
_RXFE, _TXFF, _RX, _TX, _RX_TIMEOUT = 1 << 4, 1 << 5, 1 << 4, 1 << 5, 1 << 6
_PWM_CC, _PWM_TOP, _PWM_EN, _PWM_INTR, _PWM_INTE = 0x5_0020, 0x5_0010, 0x5_00A0, 0x5_00A4, 0x5_00A8
_TIMER_HIGH, _TIMER_LOW = 0x5_4024, 0x5_4028
_WATCHDOG_LOAD = 0x5_8004
_I2C_DATA_CMD, _I2C_TXFLR, _I2C_STOP = 0x4_4010, 0x4_4074, 1 << 9
_DMA_CHANNELS, _DMA_CONTROL, _DMA_INTE, _DMA_INTS = 0x1000_0000, 0x1000_0010, 0x1000_0404, 0x1000_040C
_PIO_MEMORY, _PIO_CLKDIV, _PIO_FRAME_CYCLES = 0x1020_0048, 0x1020_00C8, 64
# Bit of each subsystem in _RESETS, by its first register.
_RESET_BITS = {
    0x1000_0000: 2,
    0x1020_0000: 10,
    0x1_4000: 5,
    0x1_C000: 8,
    0x2_8000: 12,
    0x3_4000: 22,
    0x4_4000: 3,
    0x5_0000: 14,
    0x5_4000: 21,
}
_ALL_RESETS = 0x1FF_FFFF
_REST = 2500  # of PWM: half of its steps

_PWM, _DMA, _UART = FIRST_LINE + 4, FIRST_LINE + 11, FIRST_LINE + 20
_BYTE_TICKS = 1302  # ten bits of 921 600 baud
_TIMEOUT_TICKS = 32 * _BYTE_TICKS // 10
_I2C_BYTE_TICKS = 9 * 300  # nine bits of 400 kHz
_FIFO_BYTES, _RX_LEVEL, _TX_LEVEL = 32, 4, 16

# Functions of the boot ROM, by their codes, and the places of stand-ins for them.
_ROM_STUBS = 0x100
_LOOK_UP = "look up"
_FUNCTIONS = (_LOOK_UP, "IF", "EX", "RE", "RP", "FC")
_RETURN = b"\x70\x47"  # bx lr


class Rp2040(Board):
    """A controller (simulated_device.device.Device): the firmware built for `rp2040` on an emulated board.

    `image`: `rp2040`; instead of PWM, `rp2040-drv260x` has a haptic driver, and `rp2040-i2s` an amplifier.

    `flash`: FLASH_BYTES bytes, in which images outlive this object; None = a blank one. A file behind it is not
    written. `on_dac`: called with each run of the PWM's levels, int16 (n, 2), 0 = half of its steps, or of the frames
    of I2S. `drift_ppm`: how much faster than true time its clock runs.

    It emulates processor, memory, interrupts, the serial port with the time that each byte takes, PWM, timer, watchdog,
    the boot ROM's functions for flash, subsystems in reset, and clocks that are ready at once. DMA sends two buffers in
    turn to the PIO, whose program does not run. While flash is being changed, it cannot be read. All other registers
    keep the values written to them. Cycles are those of a Cortex-M4, without the waits of a real board for its flash.
    Raises as CortexM does.
    """

    def __init__(
        self,
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
        drift_ppm: int = 0,
        image: str = "rp2040",
    ) -> None:
        self._flash = flash or FlashMemory(FLASH_BYTES)
        processor = Processor(
            Elf(build(image)),
            "M0",
            {_ROM: _ROM_BYTES, _RAM: _RAM_BYTES},
            (_FLASH, self._flash),
            lambda offset, size_bytes, value: self._fail(f"a write to flash at offset 0x{offset:x}"),
        )
        super().__init__(processor, _TICKS_PER_US, 1, _WATCHDOG_US, on_dac, drift_ppm)
        processor.add_registers(_PERIPHERALS, self._read, self._write, _PERIPHERALS_BYTES)
        processor.add_registers(_SSI, self._read_flash_interface, self._write_flash_interface)
        processor.add_registers(SYSTEM_SPACE, self._read_system, self._write_system)
        self._add_rom()
        self._registers = defaultdict(int, {_RESETS: _ALL_RESETS})
        self._failure = ""
        self._next_wrap, self._wrapped_at = NEVER, 0
        self._buffer, self._next_buffer = 0, NEVER  # the DMA channel that runs, and when it ends
        self.latest_level_ticks = 0
        """The longest time from the sample clock's tick to the level that it asked for."""
        self.haptic_writes: list[tuple[int, ...]] = []
        """Of the image `rp2040-drv260x`: register and value of each write to the haptic driver."""
        self._i2c_bytes: tuple[int, ...] = ()
        self._i2c_free_at = 0
        self._to_chip = bytearray()  # since it was selected
        self._from_chip: deque[int] = deque()
        self._arrived: deque[int] = deque()
        self._next_arrival = 0
        self._sent_at = 0  # when the last byte will have left
        self._half_sent_at = NEVER
        self.boot()

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self.advance(now_us)
        if not self._incoming:
            self._next_arrival = max(self._next_arrival, self._now + _BYTE_TICKS)
        self._incoming.extend(data)

    def advance(self, now_us: int) -> None:
        """Let the board's time pass; call it every few milliseconds."""
        super().advance(now_us)
        if self._failure:
            raise EmulationError(f"the image did what the chip does not allow: {self._failure}")

    def _due(self) -> int | None:
        if self._next_wrap <= self._now:
            self._wrapped_at, self._next_wrap = self._next_wrap, self._next_wrap + self._registers[_PWM_TOP] + 1
            return _PWM if self._registers[_PWM_INTE] & 1 else None
        if self._next_buffer <= self._now:
            self._end_buffer()
            return _DMA if self._registers[_DMA_INTS] & self._registers[_DMA_INTE] else None
        self._take_arrived()
        mask = self._registers[_UART_IMSC]
        if mask & _RX and len(self._arrived) >= _RX_LEVEL:
            return _UART
        if mask & _RX_TIMEOUT and self._arrived and self._times_out_at() <= self._now:
            return _UART
        return _UART if mask & _TX and self._half_sent_at <= self._now else None

    def _next_event(self) -> int:
        times = [self._next_wrap, self._next_buffer, self._half_sent_at]
        missing = _RX_LEVEL - len(self._arrived)
        if len(self._incoming) >= missing:
            times.append(self._next_arrival + (missing - 1) * _BYTE_TICKS)
        elif self._incoming:
            times.append(self._next_arrival + (len(self._incoming) - 1) * _BYTE_TICKS)
        elif self._arrived:
            times.append(self._times_out_at())
        return min(times)

    def _end_buffer(self) -> None:
        """End a DMA channel: its frames are played, and the channel that it chains to begins."""
        address, _, count, control = (
            self._registers[_DMA_CHANNELS + 0x40 * self._buffer + 4 * n] for n in (0, 1, 2, 4)
        )
        frames = np.frombuffer(self.processor.unicorn.mem_read(address, 4 * count), np.dtype("<i2")).reshape(-1, 2)
        self._codes += [(left, right) for right, left in frames.tolist()]
        self._registers[_DMA_INTS] |= 1 << self._buffer
        self._buffer = control >> 11 & 15
        self._begin_buffer(self._next_buffer)

    def _begin_buffer(self, now: int) -> None:
        count = self._registers[_DMA_CHANNELS + 0x40 * self._buffer + 8]
        self._next_buffer = now + count * _PIO_FRAME_CYCLES * self._registers[_PIO_CLKDIV] // (1 << 16)

    def _times_out_at(self) -> int:
        """Return when the bytes that have arrived are too few for too long."""
        return self._next_arrival - _BYTE_TICKS + _TIMEOUT_TICKS

    def _take_arrived(self) -> None:
        """Take in the bytes that have arrived by now; those without room are lost."""
        now = self._time()
        while self._incoming and self._next_arrival <= now:
            byte = self._incoming.popleft()
            if len(self._arrived) < _FIFO_BYTES:
                self._arrived.append(byte)
            self._next_arrival += _BYTE_TICKS

    def _fail(self, reason: str) -> None:
        self._failure = self._failure or reason
        self.processor.stop()

    def _check_out_of_reset(self, offset: int) -> None:
        bit = _RESET_BITS.get(offset & ~0x3FFF)
        if bit is not None and self._registers[_RESETS] >> bit & 1:
            self._fail(f"an access to 0x{_PERIPHERALS + offset:08x}, which is in reset")

    def _read(self, offset: int) -> int:
        self._check_out_of_reset(offset)
        if offset == _UART_FR:
            self._take_arrived()
            full = self._sent_at - self._time() > (_FIFO_BYTES - 1) * _BYTE_TICKS
            return (0 if self._arrived else _RXFE) | (_TXFF if full else 0)
        if offset == _UART_DR:
            return self._arrived.popleft() if self._arrived else 0
        if offset == _TIMER_LOW:
            return self._time() // _TICKS_PER_US & 0xFFFF_FFFF
        if offset == _TIMER_HIGH:
            return self._time() // _TICKS_PER_US >> 32
        if offset == _I2C_TXFLR:
            # Two of three bytes on the bus, because the driver's address is none of them.
            return -(-2 * max(0, self._i2c_free_at - self._time()) // (3 * _I2C_BYTE_TICKS))
        answers = {
            _RESETS_DONE: ~self._registers[_RESETS] & _ALL_RESETS,
            _CLK_REF_SELECTED: 1 << (self._registers[_CLK_REF] & 3),
            _CLK_SYS_SELECTED: 1 << (self._registers[_CLK_SYS] & 1),
            _XOSC_STATUS: 1 << 31,
            _PLL_CS: self._registers[_PLL_CS] | 1 << 31,
        }
        return answers.get(offset, self._registers[offset])

    def _write(self, offset: int, value: int) -> None:
        self._check_out_of_reset(offset)
        if offset == _UART_DR:
            self._outgoing.append(value & 0xFF)
            now = self._time()
            self._sent_at = max(self._sent_at, now) + _BYTE_TICKS
            if self._sent_at - now > _TX_LEVEL * _BYTE_TICKS:
                self._half_sent_at = self._sent_at - _TX_LEVEL * _BYTE_TICKS
        elif offset == _UART_ICR:
            if value & _TX and self._half_sent_at <= self._time():
                self._half_sent_at = NEVER
        elif offset == _I2C_DATA_CMD:
            self._i2c_free_at = max(self._i2c_free_at, self._time()) + _I2C_BYTE_TICKS
            self._i2c_bytes += (value & 0xFF,)
            if value & _I2C_STOP:
                self._i2c_free_at += _I2C_BYTE_TICKS  # the driver's address, before both bytes
                self.haptic_writes.append(self._i2c_bytes)
                self._i2c_bytes = ()
        elif offset == _WATCHDOG_LOAD:
            self._feed_watchdog()
        elif offset == _DMA_INTS:
            self._registers[_DMA_INTS] &= ~value
        elif offset == _DMA_CHANNELS + 0xC:  # CTRL_TRIG of channel 0: it starts
            self._registers[_DMA_CONTROL] = value
            self._buffer = 0
            self._begin_buffer(self._time())
        else:
            self._registers[offset] = value
            if offset == _CHIP_SELECT:
                self._to_chip.clear()
            if offset == _PWM_EN and value & 1:
                self._next_wrap = self._time() + self._registers[_PWM_TOP] + 1
            elif offset == _PWM_CC and self._registers[_PWM_EN] & 2:
                self.latest_level_ticks = max(self.latest_level_ticks, self._time() - self._wrapped_at)
                self._codes.append(((value & 0xFFFF) - _REST, (value >> 16) - _REST))

    def _read_flash_interface(self, offset: int) -> int:
        if offset == _SSI_SR:
            return 8 if self._from_chip else 0
        return self._from_chip.popleft() if offset == _SSI_DR0 and self._from_chip else 0

    def _write_flash_interface(self, offset: int, value: int) -> None:
        if offset == _SSI_DR0 and self._registers[_CHIP_SELECT] == _SELECTED:
            self._to_chip.append(value & 0xFF)
            answers = bytes(5) + UNIQUE_NUMBER if self._to_chip[0] == _READ_UNIQUE else b""
            self._from_chip.append(answers[len(self._to_chip) - 1] if len(self._to_chip) <= len(answers) else 0xFF)

    def _add_rom(self) -> None:
        """Put the boot ROM's table and stand-ins for its functions in place."""
        from unicorn import UC_HOOK_CODE

        unicorn = self.processor.unicorn
        unicorn.mem_write(_ROM + 0x14, b"\0\0\0\0" + (_ROM_STUBS | 1).to_bytes(2, "little"))
        unicorn.mem_write(_ROM + _ROM_STUBS, _RETURN * len(_FUNCTIONS))
        end = _ROM + _ROM_STUBS + len(_RETURN) * (len(_FUNCTIONS) - 1)
        unicorn.hook_add(UC_HOOK_CODE, self._call_rom, None, _ROM + _ROM_STUBS, end)

    def _call_rom(self, emulator: object, address: int, size_bytes: int, context: object) -> None:
        """Do what the function at an address does. Flash cannot be read from EX to FC."""
        from unicorn import UC_PROT_EXEC, UC_PROT_NONE, UC_PROT_READ, arm_const

        unicorn = self.processor.unicorn
        name = _FUNCTIONS[(address - _ROM_STUBS) // len(_RETURN)]
        first, second, third = (
            unicorn.reg_read(register)
            for register in (arm_const.UC_ARM_REG_R0, arm_const.UC_ARM_REG_R1, arm_const.UC_ARM_REG_R2)
        )
        if name == _LOOK_UP:
            code = second.to_bytes(2, "little").decode()
            unicorn.reg_write(arm_const.UC_ARM_REG_R0, _ROM_STUBS + len(_RETURN) * _FUNCTIONS.index(code) | 1)
        elif name == "EX":
            unicorn.mem_protect(_FLASH, FLASH_BYTES, UC_PROT_NONE)
        elif name == "FC":
            unicorn.mem_protect(_FLASH, FLASH_BYTES, UC_PROT_READ | UC_PROT_EXEC)
        elif name == "RE":
            self._flash.contents[first : first + second] = b"\xff" * second
        elif name == "RP":
            data = bytes(unicorn.mem_read(second, third))
            old = bytes(self._flash.contents[first : first + third])
            self._flash.contents[first : first + third] = bytes(a & b for a, b in zip(old, data, strict=True))


DEVICE = FirmwareDevice(summary="the firmware of a board with an RP2040, emulated", board=Rp2040, channels=2)
"""The address `rp2040`."""
