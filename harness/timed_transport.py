"""The way to the controller under test, which also ends a test that hangs."""

import math

import pytest

from vibrocast.simulated_device.faulty_wire import FaultyTransport


class TimedTransport(FaultyTransport):
    """A FaultyTransport that a test may use for a limited time."""

    _seconds: float | None = None
    _expires_s = math.inf

    def expire_after(self, seconds: float | None) -> None:
        """Fail the test at its next word with the controller after so long from now; None = never."""
        self._seconds = seconds
        self._expires_s = math.inf if seconds is None else self.clock() + seconds

    def _need_cable(self) -> None:
        if self.clock() > self._expires_s:
            pytest.fail(f"the test still talks to its controller after {self._seconds:g} s; see --vibrocast-timeout-s")
        super()._need_cable()
