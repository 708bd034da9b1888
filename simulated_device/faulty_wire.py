"""The one wire with faults, in front of any controller: loss, damage, delay, capacity and cut cables, by a schedule."""

import contextlib
import math
import random
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec.structs import replace

from vibrocast.device_protocol.frames import DELIMITER
from vibrocast.device_protocol.transports import Closing, DeviceGone, Transport, TransportError
from vibrocast.errors import located
from vibrocast.simulated_device.device import Device
from vibrocast.toml_tables import Table, convert, one_of, read_toml, within

DIRECTIONS = ("to_controller", "to_host", "both")
_REOPEN_S = 0.2
# While bytes are on a slow way, it is looked at so often.
_CARRIED_S = 0.001
Probability = Annotated[float, within(0, 1, "probability for each frame")]
Milliseconds = Annotated[float, within(0, 10_000, "time in ms")]


class Fault(Table, frozen=True, kw_only=True):
    """Faults of a wire from `at_s` on, for `for_s` seconds, since the host's first byte.

    `lost`, `flipped` (a byte of it), `doubled`, `swapped` (with the next one): probability for each frame. `delay_ms`,
    and up to `jitter_ms` more at random: later by so long, in order. `bits_per_second`: 8 to a byte. A UART of B baud
    carries 0.8 B, because each byte has a start and a stop bit. `cut`: the cable is out.
    """

    at_s: Annotated[float, within(0, 1e6, "time in s")] = 0.0
    for_s: Annotated[float, within(0, 1e6, "time in s")] = math.inf
    direction: Annotated[str, one_of(DIRECTIONS)] = "both"
    lost: Probability = 0.0
    flipped: Probability = 0.0
    doubled: Probability = 0.0
    swapped: Probability = 0.0
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


class FrameDamage:
    """Loses, damages, doubles and reorders frames at random, as a Fault has it. The same seed gives the same faults."""

    def __init__(self, fault: Fault, seed: int) -> None:
        self._fault = fault
        self._random = random.Random(seed)
        self._partial = b""
        self._held = b""

    def carry(self, data: bytes) -> bytes:
        """Take the bytes sent; return the bytes that arrive."""
        *frames, self._partial = (self._partial + data).split(DELIMITER)
        return b"".join(self._carry_frame(frame + DELIMITER) for frame in frames)

    def _carry_frame(self, frame: bytes) -> bytes:
        chance = self._random.random
        if chance() < self._fault.lost:
            return b""
        if chance() < self._fault.flipped:
            damaged = bytearray(frame)
            damaged[self._random.randrange(len(frame))] ^= self._random.randrange(1, 256)
            frame = bytes(damaged)
        if chance() < self._fault.doubled:
            frame += frame
        if not self._held and chance() < self._fault.swapped:
            self._held = frame
            return b""
        arrived, self._held = frame + self._held, b""
        return arrived


class _Direction:
    """One direction of the wire: bytes that wait for its capacity, and bytes under way with the times they arrive.

    `waiting_bytes`: how many wait.
    """

    def __init__(self, name: str, seed: int) -> None:
        self._name, self._seed = name, seed
        self._faults: list[tuple[Fault, FrameDamage]] = []
        self._random = random.Random(seed)
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._now_us = 0
        self._room_bits = 0.0  # capacity so far that no byte has used
        self.waiting_bytes = 0

    def change(self, faults: Sequence[Fault]) -> None:
        """Have other faults from now on."""
        chosen = [each for each in faults if each.direction in (self._name, "both")]
        self._faults = [(each, FrameDamage(each, self._seed + 2 * number)) for number, each in enumerate(chosen)]

    @property
    def is_carrying(self) -> bool:
        """Whether bytes are on their way."""
        return bool(self._waiting or self._under_way)

    def put(self, data: bytes, since_us: int) -> None:
        """Take bytes that are sent. `since_us`: the time of the schedule."""
        delay_ms = 0.0
        for fault, damage in self._faults:
            if fault.is_on(since_us):
                data = b"" if fault.cut else damage.carry(data)
                delay_ms += fault.delay_ms + fault.jitter_ms * self._random.random()
        if data:
            self._waiting.append((round(1e3 * delay_ms), data))
            self.waiting_bytes += len(data)

    def take(self, now_us: int, since_us: int) -> bytes:
        """Carry bytes up to this time; return those that have arrived, once."""
        passed_us, self._now_us = max(0, now_us - self._now_us), max(now_us, self._now_us)
        limits = [fault.bits_per_second for fault, _ in self._faults if fault.is_on(since_us)]
        bits_per_second = min((each for each in limits if each is not None), default=math.inf)
        self._room_bits += bits_per_second * passed_us / 1e6 if math.isfinite(bits_per_second) else 0.0
        while self._waiting:
            delay_us, data = self._waiting[0]
            count = len(data) if math.isinf(bits_per_second) else min(len(data), int(self._room_bits // 8))
            if not count:
                break
            self._room_bits = max(0.0, self._room_bits - 8.0 * count)
            self.waiting_bytes -= count
            last_us = self._under_way[-1][0] if self._under_way else 0
            self._under_way.append((max(self._now_us + delay_us, last_us), data[:count]))
            self._waiting[0] = delay_us, data[count:]
            if count == len(data):
                self._waiting.popleft()
        if not self._waiting:
            self._room_bits = 0.0  # the unused capacity of an idle wire is lost
        arrived = b""
        while self._under_way and self._under_way[0][0] <= self._now_us:
            arrived += self._under_way.popleft()[1]
        return arrived


class FaultyWire(Device):
    """A controller at the far end of a wire with faults; the same seed gives the same faults for the same frames.

    `on_cut`: called with whether the cable is out, when that changes.
    """

    def __init__(
        self,
        controller: Device,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        on_cut: Callable[[bool], None] | None = None,
    ) -> None:
        self.controller = controller
        self._on_cut = on_cut
        self._there = _Direction("to_controller", 2 * seed + 1)
        self._back = _Direction("to_host", 2 * seed + 2)
        self._arrived = b""
        self._now_us = 0
        self._is_cut = False
        self._began_us: int | None = None
        self._set(faults)

    @property
    def waiting_bytes(self) -> int:
        """How many bytes wait for capacity on the way to the controller."""
        return self._there.waiting_bytes

    def change(self, *faults: Fault) -> None:
        """Have other faults; their schedule begins now. Bytes on their way go on."""
        self._began_us = self._now_us
        self._set(faults)

    def _set(self, faults: Sequence[Fault]) -> None:
        self._faults = faults
        self._there.change(faults)
        self._back.change(faults)

    def is_cut(self, now_us: int) -> bool:
        """Return whether the cable is out."""
        since_us = self._since_start(now_us)
        return any(fault.cut and fault.is_on(since_us) for fault in self._faults)

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host; the first ones begin the schedule."""
        if self._began_us is None:
            self._began_us = now_us
        self._there.put(data, self._since_start(now_us))
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass on the wire and at its far end."""
        self._now_us = now_us
        since_us = self._since_start(now_us)
        arrived = self._there.take(now_us, since_us)
        if arrived:
            self.controller.receive(arrived, now_us)
        else:
            self.controller.advance(now_us)
        self._back.put(self.controller.transmit(), since_us)
        self._arrived += self._back.take(now_us, since_us)
        is_cut = self.is_cut(now_us)
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
    """A controller behind a transport, such as one on a serial port. `failure`: why the transport broke for good.

    `on_cut`: called with whether the controller is gone, such as for a power cycle; None = the transport then fails.
    """

    def __init__(self, transport: Transport, on_cut: Callable[[bool], None] | None = None) -> None:
        self._transport = transport
        self._on_cut = on_cut
        self._is_gone = False
        self._again_s = 0.0
        self.failure: TransportError | None = None

    def receive(self, data: bytes, now_us: int) -> None:
        """Hand bytes from the host on. Raises TransportError."""
        self._tried(lambda: self._transport.write(data))

    def advance(self, now_us: int) -> None:
        """Open the way to a controller that is gone again; one that is there has a clock of its own."""
        if self._on_cut is None or not self._is_gone or time.monotonic() < self._again_s:
            return
        self._again_s = time.monotonic() + _REOPEN_S
        with contextlib.suppress(TransportError):
            self._transport.reopen()
            self._is_gone = False
            self._on_cut(False)

    def transmit(self) -> bytes:
        """Return the bytes that have come from the controller. Raises TransportError."""
        read = bytearray()
        self._tried(lambda: read.extend(self._transport.read(0.0)))
        return bytes(read)

    def _tried(self, action: Callable[[], None]) -> None:
        """Do what needs the controller; nothing while it is gone. Raises TransportError."""
        if self._is_gone:
            return
        try:
            action()
        except TransportError as error:
            if self._on_cut is None or isinstance(error, DeviceGone):
                self.failure = error
                raise
            self._is_gone = True
            self._on_cut(True)


class FaultyTransport(Closing):
    """The host's end of the wire: a transport (device_protocol.transports.Transport) around another one.

    It has no faults until somebody asks for some. `clock`: the host's; for a transport in simulated time, its own.
    `to_controller`, `to_host`: the damage of each direction; None = none.
    """

    def __init__(self, transport: Transport, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.to_controller: FrameDamage | None = None
        self.to_host: FrameDamage | None = None
        self._there, self._back = _Direction("to_controller", 0), _Direction("to_host", 1)
        self._transport = transport
        self._out_from_s = self._out_until_s = 0.0
        self._pull: tuple[float, float] | None = None  # of a cable that is to be pulled
        self.was_pulled = False

    def damage(self, *, seed: int = 0, **faults: Any) -> None:
        """From now on, have these faults of a Fault, such as `lost` or `delay_ms`; without arguments, none.

        The same seed gives the same faults for the same frames. Raises InputError for wrong ones.
        """
        fault = convert(faults, Fault)
        self.to_controller = None if fault.direction == "to_host" else FrameDamage(fault, seed)
        self.to_host = None if fault.direction == "to_controller" else FrameDamage(fault, seed + 1)
        for way in (self._there, self._back):
            way.change([replace(fault, lost=0.0, flipped=0.0, doubled=0.0, swapped=0.0)])

    def pull_cable(self, seconds: float, after_s: float = 0.0) -> None:
        """Pull the cable `after_s` after the host's next byte, 0 = now, and plug it in again `seconds` later."""
        self.was_pulled = True
        self._pull = after_s, seconds
        if not after_s:
            self._begin_pull()

    def _begin_pull(self) -> None:
        if self._pull is not None:
            after_s, seconds = self._pull
            self._out_from_s = self.clock() + after_s
            self._out_until_s, self._pull = self._out_from_s + seconds, None

    def __getattr__(self, name: str) -> Any:
        """Return what else the transport has, such as its file."""
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises TransportError."""
        self._begin_pull()
        self._need_cable()
        self._there.put(data if self.to_controller is None else self.to_controller.carry(data), 0)
        self._hand_on()

    def read(self, timeout_s: float) -> bytes:
        """Return the available bytes, waiting for them at most `timeout_s`. Raises TransportError."""
        until_s = self.clock() + timeout_s
        while True:
            self._need_cable()
            self._hand_on()
            left_s = max(0.0, until_s - self.clock())
            carries = self._there.is_carrying or self._back.is_carrying
            data = self._transport.read(min(left_s, _CARRIED_S) if carries else left_s)
            self._back.put(data if self.to_host is None else self.to_host.carry(data), 0)
            arrived = self._back.take(self._now_us(), 0)
            if arrived or self.clock() >= until_s:
                return arrived

    def _hand_on(self) -> None:
        """Hand the bytes on that have reached the controller. Raises TransportError."""
        if arrived := self._there.take(self._now_us(), 0):
            self._transport.write(arrived)

    def _now_us(self) -> int:
        return round(1e6 * self.clock())

    def reopen(self) -> None:
        """Close the port or device, and open it again. Raises TransportError while it is absent."""
        self._need_cable()
        self._transport.reopen()

    def close(self) -> None:
        """Release the port; may be called again."""
        self._transport.close()

    def _need_cable(self) -> None:
        if self._out_from_s <= self.clock() < self._out_until_s:
            raise TransportError("the test has pulled the cable")
