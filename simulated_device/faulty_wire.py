"""A wire with faults by a schedule, in front of any controller: loss, damage, delay, bandwidth and cut cables."""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from vibrocast.device_protocol.transports import Transport, TransportError
from vibrocast.errors import located
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_link import FaultyDirection
from vibrocast.toml_tables import Table, convert, one_of, read_toml, within

DIRECTIONS = ("to_controller", "to_host", "both")
Probability = Annotated[float, within(0, 1, "probability for each frame")]
Milliseconds = Annotated[float, within(0, 10_000, "time in ms")]


class Fault(Table, frozen=True, kw_only=True):
    """Faults of a wire from `at_s` on, for `for_s` seconds, since the host's first byte.

    `lost`, `flipped` (a byte of it), `doubled`: probability for each frame. `delay_ms`, and up to `jitter_ms` more at
    random: later by so long, in order. `bits_per_second`: 8 to a byte. `cut`: the cable is out.
    """

    at_s: Annotated[float, within(0, 1e6, "time in s")] = 0.0
    for_s: Annotated[float, within(0, 1e6, "time in s")] = math.inf
    direction: Annotated[str, one_of(DIRECTIONS)] = "both"
    lost: Probability = 0.0
    flipped: Probability = 0.0
    doubled: Probability = 0.0
    delay_ms: Milliseconds = 0.0
    jitter_ms: Milliseconds = 0.0
    bits_per_second: Annotated[float, within(1, 1e9, "capacity in bit/s")] | None = None
    cut: bool = False

    def is_on(self, since_us: int) -> bool:
        """Return whether a time since the first byte is within that of the fault."""
        return 1e6 * self.at_s <= since_us < 1e6 * self.at_s + 1e6 * self.for_s


class _FaultsFile(Table, frozen=True, kw_only=True):
    faults: tuple[Fault, ...]


def read_faults(path: Path) -> tuple[Fault, ...]:
    """Read a schedule of faults, tables [[faults]] in TOML. Raises InputError and OSError."""
    with located(path):
        return convert(read_toml(path, "schedule of faults"), _FaultsFile).faults


class _Direction:
    """One direction of the wire: a queue of frames with the times at which they arrive."""

    def __init__(self, name: str, faults: Sequence[Fault], seed: int) -> None:
        self._faults = [each for each in faults if each.direction in (name, "both")]
        self._damage = [FaultyDirection(seed + 2 * n, f.lost, f.flipped, f.doubled) for n, f in enumerate(self._faults)]
        self._random = random.Random(seed)
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._free_us = 0.0

    def put(self, data: bytes, now_us: int) -> None:
        """Take bytes that are sent."""
        delay_us = 0.0
        bits_per_second = math.inf
        for fault, damage in zip(self._faults, self._damage, strict=True):
            if fault.is_on(now_us):
                data = b"" if fault.cut else damage.carry(data)
                delay_us += 1e3 * (fault.delay_ms + fault.jitter_ms * self._random.random())
                bits_per_second = min(bits_per_second, fault.bits_per_second or math.inf)
        if not data:
            return
        self._free_us = max(self._free_us, now_us) + 8e6 * len(data) / bits_per_second
        due_us = round(self._free_us + delay_us)
        last_us = self._under_way[-1][0] if self._under_way else 0
        self._under_way.append((max(due_us, last_us), data))

    def take(self, now_us: int) -> bytes:
        """Return the bytes that have arrived by now, once."""
        arrived = b""
        while self._under_way and self._under_way[0][0] <= now_us:
            arrived += self._under_way.popleft()[1]
        return arrived


class FaultyWire(Device):
    """A controller at the far end of a wire with faults; the same seed gives the same faults for the same frames.

    `on_cut`: called with whether the cable is out, when that changes.
    """

    def __init__(
        self,
        controller: Device,
        faults: Sequence[Fault],
        seed: int = 0,
        on_cut: Callable[[bool], None] | None = None,
    ) -> None:
        self._controller = controller
        self._faults, self._on_cut = faults, on_cut
        self._there = _Direction("to_controller", faults, 2 * seed)
        self._back = _Direction("to_host", faults, 2 * seed + 1)
        self._arrived = b""
        self._began_us: int | None = None
        self._is_cut = False

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host; the first ones begin the schedule."""
        if self._began_us is None:
            self._began_us = now_us
        self._there.put(data, self._since_start(now_us))
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass on the wire and at its far end."""
        since_us = self._since_start(now_us)
        arrived = self._there.take(since_us)
        if arrived:
            self._controller.receive(arrived, now_us)
        else:
            self._controller.advance(now_us)
        self._back.put(self._controller.transmit(), since_us)
        self._arrived += self._back.take(since_us)
        is_cut = any(fault.cut and fault.is_on(since_us) for fault in self._faults)
        if is_cut != self._is_cut:
            self._is_cut = is_cut
            if self._on_cut is not None:
                self._on_cut(is_cut)

    def transmit(self) -> bytes:
        """Return the bytes that have come back, once."""
        data, self._arrived = self._arrived, b""
        return data

    def _since_start(self, now_us: int) -> int:
        return 0 if self._began_us is None else now_us - self._began_us


class RemoteDevice(Device):
    """A controller behind a transport, such as one on a serial port. `failure`: why the transport broke, if it did."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self.failure: TransportError | None = None

    def receive(self, data: bytes, now_us: int) -> None:
        """Hand bytes from the host on. Raises TransportError."""
        self._tried(lambda: self._transport.write(data))

    def advance(self, now_us: int) -> None:
        """Do nothing: the controller has a clock of its own."""

    def transmit(self) -> bytes:
        """Return the bytes that have come from the controller. Raises TransportError."""
        read = bytearray()
        self._tried(lambda: read.extend(self._transport.read(0.0)))
        return bytes(read)

    def _tried(self, action: Callable[[], None]) -> None:
        try:
            action()
        except TransportError as error:
            self.failure = error
            raise
