"""An emulated board whose image works by interrupts: time, the sample clock, and bytes to and from the host."""

from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable

import numpy as np

from vibrocast.harness.boards.emulator import EmulationError, Processor
from vibrocast.output.actuator import Codes

# While interrupts are switched off, the processor runs in steps of this length.
_MASKED_TICKS = 50
# Registers of the system space: interrupts to switch on, and the vector table.
_ENABLE, _VECTOR_TABLE = 0x100, 0xD08
FIRST_LINE = 16
"""An interrupt's exception is its line and this."""
NEVER = 1 << 62
"""A time that does not come."""


class Board(ABC):
    """A controller (simulated_device.device.Device) on an emulated processor; time is counted in ticks.

    `ticks_per_us`, `cycles_per_tick`: of the timers' clock, and of the processor's. `watchdog_us`: the time after which
    the board's watchdog resets it. `on_dac`: called with each run of the output, int16 (n, channels), 0 = rest.
    `drift_ppm`: how much faster than true time its clock runs.

    A subclass maps its registers and then calls `boot`. It tells which interrupts are due. Interrupts come between any
    two blocks of instructions. Raises EmulationError, and as CortexM does.
    """

    def __init__(
        self,
        processor: Processor,
        ticks_per_us: int,
        cycles_per_tick: int,
        watchdog_us: int,
        on_dac: Callable[[Codes], None] | None,
        drift_ppm: int,
    ) -> None:
        self.processor = processor
        self._ticks_per_us, self._cycles_per_tick = ticks_per_us, cycles_per_tick
        self._watchdog_ticks = watchdog_us * ticks_per_us
        self._on_dac = on_dac
        self._drift_ppm = drift_ppm
        self._system: defaultdict[int, int] = defaultdict(int)
        self._enabled: set[int] = set()
        self._origin_us: int | None = None
        self._now = 0
        self._incoming: deque[int] = deque()
        self._outgoing = bytearray()
        self._codes: list[tuple[int, ...]] = []
        self._fed_at = self._fed_cycles = self._longest_turn_cycles = 0
        self._ran_from = 0, 0  # the time, and the cycles, at which the processor was last started
        self._sleeping = False

    @abstractmethod
    def _due(self) -> int | None:
        """Return an exception that is due now, or None; what it came from is over by that."""

    @abstractmethod
    def _next_event(self) -> int:
        """Return the time from which on `_due` may return another exception; it may have passed."""

    def boot(self) -> None:
        """Run the image until it first waits for an interrupt: starting takes no time."""
        self.processor.run()
        self._sleeping = True
        self._ran_from = 0, self.processor.counter.cycles
        self._now = 0

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self.advance(now_us)
        self._incoming.extend(data)

    def advance(self, now_us: int) -> None:
        """Let the board's time pass; call it every few milliseconds."""
        if self._origin_us is None:
            self._origin_us = now_us
        true_us = now_us - self._origin_us
        end = (true_us + true_us * self._drift_ppm // 1_000_000) * self._ticks_per_us
        while True:
            while self._sleeping or not self.processor.masks_interrupts:
                due = self._due()
                if due is None:
                    break
                self._interrupt(due)
            if self._now >= end:
                break
            event = min(max(self._next_event(), self._now), end)
            if self._sleeping:
                self._now = event
            else:
                self._run(max(event, self._now + _MASKED_TICKS))
        if self._now - self._fed_at > self._watchdog_ticks:
            seconds = self._watchdog_ticks / (1_000_000 * self._ticks_per_us)
            raise EmulationError(f"the watchdog has reset the board: its loop stood still for {seconds:.1f} s")
        codes, self._codes = self._codes, []
        if codes and self._on_dac is not None:
            self._on_dac(np.array(codes, np.int16))

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def longest_turn_us(self) -> float:
        """Return the longest time that the processor worked between two turns of the loop, and begin again.

        Each turn feeds the watchdog. Interrupts are part of the time, waiting for them is not.
        """
        longest, self._longest_turn_cycles = self._longest_turn_cycles, 0
        return longest / (self._cycles_per_tick * self._ticks_per_us)

    @property
    def now_us(self) -> float:
        """The time since the board's start, also while it works."""
        return self._time() / self._ticks_per_us

    def _run(self, until: int) -> None:
        """Run the processor up to a time, or until it waits for an interrupt."""
        deadline = self.processor.counter.cycles + self._cycles_per_tick * (until - self._now)
        self._ran_from = self._now, self.processor.counter.cycles
        self.processor.run(deadline)
        self._sleeping = self.processor.counter.cycles < deadline
        self._now = self._time()

    def _time(self) -> int:
        """Return the time, also while the processor runs."""
        at, cycles = self._ran_from
        return max(self._now, at + (self.processor.counter.cycles - cycles) // self._cycles_per_tick)

    def _interrupt(self, exception: int) -> None:
        """Run an exception's handler, unless it is an interrupt that is switched off."""
        if exception < FIRST_LINE or exception - FIRST_LINE in self._enabled:
            entry = self._system[_VECTOR_TABLE] + 4 * exception
            self._ran_from = self._now, self.processor.counter.cycles
            self.processor.interrupt(int.from_bytes(self.processor.unicorn.mem_read(entry, 4), "little"))
            self._now = self._time()
            self._sleeping = False

    def _feed_watchdog(self) -> None:
        cycles = self.processor.counter.cycles
        self._longest_turn_cycles = max(self._longest_turn_cycles, cycles - self._fed_cycles)
        self._fed_cycles, self._fed_at = cycles, self._time()

    def _read_system(self, offset: int) -> int:
        return self._system[offset]

    def _write_system(self, offset: int, value: int) -> None:
        self._system[offset] = value
        if _ENABLE <= offset < _ENABLE + 32:
            self._enabled |= {8 * (offset - _ENABLE) + bit for bit in range(32) if value >> bit & 1}
