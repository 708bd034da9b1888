"""A link in memory to a controller in simulated time; on request it loses, damages or delays frames."""

import random

from vibrocast.device_protocol.frames import DELIMITER
from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.simulated_device.device import Device

STEP_US = 1000


class FaultyDirection:
    """One direction of a link, which loses, damages, doubles and reorders frames at random.

    `lost`, `flipped` (one byte of the frame), `doubled`, `swapped` (with the next one): probability for each frame. The
    same seed gives the same faults.
    """

    def __init__(
        self, seed: int = 0, lost: float = 0.0, flipped: float = 0.0, doubled: float = 0.0, swapped: float = 0.0
    ) -> None:
        self._random = random.Random(seed)
        self._lost, self._flipped, self._doubled, self._swapped = lost, flipped, doubled, swapped
        self._partial = b""
        self._held = b""

    def carry(self, data: bytes) -> bytes:
        """Take the bytes sent; return the bytes that arrive."""
        *frames, self._partial = (self._partial + data).split(DELIMITER)
        return b"".join(self._carry_frame(frame + DELIMITER) for frame in frames)

    def _carry_frame(self, frame: bytes) -> bytes:
        chance = self._random.random
        if chance() < self._lost:
            return b""
        if chance() < self._flipped:
            damaged = bytearray(frame)
            damaged[self._random.randrange(len(frame))] ^= self._random.randrange(1, 256)
            frame = bytes(damaged)
        if chance() < self._doubled:
            frame += frame
        if not self._held and chance() < self._swapped:
            self._held = frame
            return b""
        arrived, self._held = frame + self._held, b""
        return arrived


class SimulatedTime:
    """The time of one link, or of several; it passes in steps of at most `step_us`."""

    def __init__(self, step_us: int = STEP_US) -> None:
        self.now_us = 0
        self.links: list[MemoryLink] = []
        self.step_us = step_us

    def sleep(self, seconds: float) -> None:
        """Let time pass for all controllers."""
        end_us = self.now_us + round(seconds * 1e6)
        while self.now_us < end_us:
            self.now_us = min(end_us, self.now_us + self.step_us)
            for link in self.links:
                link.controller.advance(self.now_us)


class MemoryLink(Closing):
    """A transport (device_protocol.transports.Transport) to a controller; time passes while you read from it.

    `clock` and `sleep` are the host's, in simulated time. `time`: shared with other links, None = its own.
    """

    def __init__(
        self,
        controller: Device,
        to_controller: FaultyDirection | None = None,
        to_host: FaultyDirection | None = None,
        *,
        time: SimulatedTime | None = None,
    ) -> None:
        self.controller = controller
        self.time = time or SimulatedTime()
        self.time.links.append(self)
        self._to_controller = to_controller or FaultyDirection()
        self._to_host = to_host or FaultyDirection()
        self._cable_out_until_us = 0.0

    @property
    def now_us(self) -> int:
        """The simulated time in microseconds."""
        return self.time.now_us

    def clock(self) -> float:
        """Return the simulated time in seconds."""
        return self.now_us / 1e6

    def sleep(self, seconds: float) -> None:
        """Let simulated time pass."""
        self.time.sleep(seconds)

    def write(self, data: bytes) -> None:
        """Send bytes to the controller. Raises TransportError while the cable is out."""
        self._need_cable()
        self.controller.receive(self._to_controller.carry(data), self.now_us)

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes from the controller; time passes until some have come, or `timeout_s` is over."""
        end_us = self.now_us + round(timeout_s * 1e6)
        while True:
            self._need_cable()
            data = self._to_host.carry(self.controller.transmit())
            if data or self.now_us >= end_us:
                return data
            self.sleep(min(self.time.step_us, end_us - self.now_us) / 1e6)

    def unplug(self, seconds: float) -> None:
        """Pull the cable, and plug it in again after `seconds`; bytes sent meanwhile are lost."""
        self._cable_out_until_us = self.now_us + seconds * 1e6

    def reopen(self) -> None:
        """Open the port again. Raises TransportError while the cable is out."""
        self._need_cable()
        self.controller.transmit()

    def close(self) -> None:
        """Do nothing: there is no port to release."""

    def _need_cable(self) -> None:
        if self.now_us < self._cable_out_until_us:
            raise TransportError("the cable to the simulated controller is out; plug it in")
