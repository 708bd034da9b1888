"""A transport whose frames a test may lose, damage or double, and whose cable it may pull."""

import math
import time
from typing import Any

import pytest

from vibrocast.device_protocol.transports import Closing, Transport, TransportError
from vibrocast.simulated_device.faulty_link import FaultyDirection


class FaultyTransport(Closing):
    """The way to a controller, without faults until a test asks for some."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._there, self._back = FaultyDirection(), FaultyDirection()
        self._out_until_s = 0.0
        self._seconds: float | None = None
        self._expires_s = math.inf

    def expire_after(self, seconds: float | None) -> None:
        """Fail the test at its next word with the controller after so long from now; None = never."""
        self._seconds = seconds
        self._expires_s = math.inf if seconds is None else time.monotonic() + seconds

    def damage(
        self, *, lost: float = 0.0, flipped: float = 0.0, doubled: float = 0.0, direction: str = "both", seed: int = 0
    ) -> None:
        """From now on, lose, damage or double frames with these probabilities; without arguments, none.

        `direction`: "to_controller", "to_host" or "both". The same seed gives the same faults for the same frames.
        """
        there, back = (lost, flipped, doubled), (lost, flipped, doubled)
        none = (0.0, 0.0, 0.0)
        self._there = FaultyDirection(seed, *(none if direction == "to_host" else there))
        self._back = FaultyDirection(seed + 1, *(none if direction == "to_controller" else back))

    def pull_cable(self, seconds: float) -> None:
        """Pull the cable, and plug it in again after a time."""
        self._out_until_s = time.monotonic() + seconds

    def __getattr__(self, name: str) -> Any:
        """Return what else the transport has, such as its file."""
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises TransportError."""
        self._need_cable()
        self._transport.write(self._there.carry(data))

    def read(self, timeout_s: float) -> bytes:
        """Return the available bytes. Raises TransportError."""
        self._need_cable()
        return self._back.carry(self._transport.read(timeout_s))

    def reopen(self) -> None:
        """Close the port or device, and open it again. Raises TransportError while it is absent."""
        self._need_cable()
        self._transport.reopen()

    def close(self) -> None:
        """Release the port; may be called again."""
        self._transport.close()

    def _need_cable(self) -> None:
        if time.monotonic() > self._expires_s:
            pytest.fail(f"the test still talks to its controller after {self._seconds:g} s; see --vibrocast-timeout-s")
        if time.monotonic() < self._out_until_s:
            raise TransportError("the test has pulled the cable")
