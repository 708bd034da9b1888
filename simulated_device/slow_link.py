"""A link of limited capacity in front of a controller: bit/s, a delay, a finite buffer, all in its own time."""

import math
from collections import deque
from collections.abc import Callable

from vibrocast.simulated_device.device import Device

# The buffer of a small radio or a USB serial adapter.
BUFFER_BYTES = 4096


class Wire:
    """One direction of a link, or of several links that share it.

    `bits_per_second`, 8 to a byte, may change at any time; infinity carries at once. A UART of B baud carries 0.8 B,
    because each byte has a start and a stop bit. `delay_s`: travel time of a bit. `buffer_bytes`: most bytes that may
    wait; more are lost. `waiting_bytes`: bytes that wait now.
    """

    def __init__(
        self, bits_per_second: float = math.inf, delay_s: float = 0.0, buffer_bytes: int = BUFFER_BYTES
    ) -> None:
        self.bits_per_second = bits_per_second
        self.waiting_bytes = 0
        self._delay_us = round(1e6 * delay_s)
        self._buffer_bytes = buffer_bytes
        self._waiting: deque[tuple[Callable[[bytes, int], None], bytes]] = deque()
        self._under_way: deque[tuple[int, Callable[[bytes, int], None], bytes]] = deque()
        self._now_us = 0
        self._room_bits = 0.0  # capacity so far that the link has not used

    def put(self, data: bytes, deliver: Callable[[bytes, int], None]) -> None:
        """Take bytes for a receiver; `deliver(bytes, now_us)` is called when they have crossed the link."""
        if math.isfinite(self.bits_per_second):
            data = data[: max(0, self._buffer_bytes - self.waiting_bytes)]
        if data:
            self._waiting.append((deliver, data))
            self.waiting_bytes += len(data)

    def advance(self, now_us: int) -> None:
        """Carry bytes up to this time, and deliver those that have crossed the link."""
        passed_us, self._now_us = max(0, now_us - self._now_us), max(now_us, self._now_us)
        endless = math.isinf(self.bits_per_second)
        self._room_bits += 0.0 if endless else self.bits_per_second * passed_us / 1e6
        while self._waiting:
            deliver, data = self._waiting[0]
            count = len(data) if endless else min(len(data), int(self._room_bits // 8))
            if not count:
                break
            self._room_bits -= 0.0 if endless else 8.0 * count
            self.waiting_bytes -= count
            self._under_way.append((self._now_us + self._delay_us, deliver, data[:count]))
            if count == len(data):
                self._waiting.popleft()
            else:
                self._waiting[0] = deliver, data[count:]
        if not self._waiting:
            self._room_bits = 0.0  # the unused capacity of an idle link is lost
        while self._under_way and self._under_way[0][0] <= self._now_us:
            _, deliver, data = self._under_way.popleft()
            deliver(data, self._now_us)


class SlowLink(Device):
    """A controller at the far end of a link: a Device, so that any port serves it. Several may share a Wire."""

    def __init__(self, controller: Device, there: Wire | None = None, back: Wire | None = None) -> None:
        self.controller = controller
        self.there = there or Wire()
        self.back = back or Wire()
        self._arrived_back = bytearray()

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host, which arrive when the link has carried them."""
        self.advance(now_us)
        self.there.put(data, self.controller.receive)
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass on the link and at its far end."""
        self.there.advance(now_us)
        self.controller.advance(now_us)
        self.back.put(self.controller.transmit(), self._note_arrival)
        self.back.advance(now_us)

    def transmit(self) -> bytes:
        """Return the bytes that have come back, once."""
        data = bytes(self._arrived_back)
        self._arrived_back.clear()
        return data

    def _note_arrival(self, data: bytes, now_us: int) -> None:
        self._arrived_back += data
