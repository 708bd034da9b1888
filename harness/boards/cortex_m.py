"""The controller's firmware on an emulated MPS2 board with a Cortex-M4, M7 or M33: the same image as for a board."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards.emulator import SYSTEM_SPACE, Processor
from vibrocast.host.devices import FirmwareDevice
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.flash import FlashMemory

FLASH_BYTES = 2056 * 1024
"""Flash for model images: two sectors of 4096 bytes for records, two slots of 1 MiB."""

_MEMORY_BYTES = 4 << 20
# Bytes that the host does not take fill the line. Then the image keeps the rest, within its limit.
_LINE_BYTES = 65_536
_TIMER_DIVIDER = 16

# Registers, as in firmware/ports/mps2/board.h.
_UART_DATA, _UART_STATE = 0x0, 0x4
_SEND_FULL, _RECEIVE_FULL = 1, 2
_TIMER_VALUE = 0x4
_OUTPUT_SAMPLES = 0x8


@dataclass(frozen=True)
class _Board:
    """An MPS2 board: its processor, and addresses as in firmware/ports/mps2/board.h.

    `timer_mhz`: of the board's timer. `processor_mhz`: of a microcontroller with this processor.
    """

    processor: str
    processor_mhz: int
    uart: int = 0x4000_4000
    timer: int = 0x4000_2000
    output: int = 0x4002_4000
    timer_mhz: int = 25


_BOARDS = {
    "cortex-m4": _Board("M4", 168),
    "cortex-m7": _Board("M7", 480),
    "cortex-m33": _Board("M33", 150, 0x5020_0000, 0x5000_2000, 0x5030_1000, 20),
}
CORES = tuple(_BOARDS)


class CortexM:
    """A controller (simulated_device.device.Device): the firmware built for `core`, one of CORES, on an emulated board.

    `flash`: FLASH_BYTES bytes, in which images outlive this object; None = a blank one. A file behind it is not
    written. `on_dac`: called with each run of codes int16 (n, channels) as they go to the DAC. `drift_ppm`: how much
    faster than true time the board's clock runs.

    Each call runs the image's main loop until nothing is left to do. Its clock goes on meanwhile, by the cycles of a
    processor at the rate of docs/benchmarks/firmware.md: while it is ahead of the host's, calls do nothing. Raises
    BuildError, and EmulationError if the image does something that stops a processor.
    """

    def __init__(
        self,
        core: str = "cortex-m4",
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
        drift_ppm: int = 0,
    ) -> None:
        image, board = Elf(build(core)), _BOARDS[core]
        memories = {image.segments[0].address: _MEMORY_BYTES, image.sections[".stack"].address: _MEMORY_BYTES}
        model_flash = (image.sections[".model_flash"].address, flash or FlashMemory(FLASH_BYTES))
        self.processor = Processor(image, board.processor, memories, model_flash)
        self.processor.add_registers(board.uart, self._read_uart, self._write_uart)
        self.processor.add_registers(SYSTEM_SPACE, lambda offset: 0, lambda offset, value: None)
        self.processor.add_registers(board.timer, self._read_timer, lambda offset, value: None)
        self.processor.add_registers(board.output, lambda offset: 0, self._write_output)
        self._on_dac = on_dac
        self._drift_ppm = drift_ppm
        self._board = board
        self._origin_us: int | None = None
        self._incoming: deque[int] = deque()
        self._outgoing = bytearray()
        self._codes: list[Codes] = []
        self._output = [0, 0]
        self._ran_from = 0, 0  # the time in us, and the cycles, at which the processor was last started
        self.processor.run()
        self._boot_us = self._time_us()

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self._incoming.extend(data)
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        """Play the samples that are due, and run the watchdog; call it every few milliseconds."""
        if self._origin_us is None:
            self._origin_us = now_us
        true_us = now_us - self._origin_us
        board_us = self._boot_us + true_us + true_us * self._drift_ppm // 1_000_000
        if board_us < self._time_us():
            return
        self._ran_from = board_us, self.processor.counter.cycles
        self.processor.run()
        codes, self._codes = self._codes, []
        if self._on_dac is not None:
            for run in codes:
                self._on_dac(run)

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def _time_us(self) -> int:
        at_us, cycles = self._ran_from
        return at_us + (self.processor.counter.cycles - cycles) // self._board.processor_mhz

    def _read_uart(self, offset: int) -> int:
        if offset == _UART_DATA:
            return self._incoming.popleft() if self._incoming else 0
        if offset != _UART_STATE:
            return 0
        return (_RECEIVE_FULL if self._incoming else 0) | (_SEND_FULL if len(self._outgoing) >= _LINE_BYTES else 0)

    def _write_uart(self, offset: int, value: int) -> None:
        if offset == _UART_DATA:
            self._outgoing.append(value & 0xFF)

    def _read_timer(self, offset: int) -> int:
        if offset != _TIMER_VALUE:
            return 0
        return -(self._time_us() * self._board.timer_mhz // _TIMER_DIVIDER) & 0xFFFF_FFFF

    def _write_output(self, offset: int, value: int) -> None:
        if offset < _OUTPUT_SAMPLES:
            self._output[offset // 4] = value
        elif offset == _OUTPUT_SAMPLES:
            address, channels = self._output
            shown = self.processor.unicorn.mem_read(address, 2 * channels * value)
            self._codes.append(np.frombuffer(bytes(shown), "<i2").astype(np.int16).reshape(value, channels))


def _device(core: str, name: str, planned_core: str) -> FirmwareDevice:
    return FirmwareDevice(
        summary=f"the firmware on an emulated {name}",
        board=partial(CortexM, core),
        channels=4,
        core=planned_core,
        clock_hz=1e6 * _BOARDS[core].processor_mhz,
    )


CORTEX_M4 = _device("cortex-m4", "Cortex-M4", "M4F")
"""The address `cortex-m4`."""
CORTEX_M7 = _device("cortex-m7", "Cortex-M7", "M7")
"""The address `cortex-m7`."""
CORTEX_M33 = _device("cortex-m33", "Cortex-M33", "M33")
"""The address `cortex-m33`."""
