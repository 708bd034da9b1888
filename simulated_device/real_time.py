"""Runs a controller in real time in its own thread; the ports build on it."""

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Self

from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.simulated_device.device import Device

# The samples of each period are made at its end. So a packet may come this much too late and still be played.
PERIOD_S = 0.002
# A computer under load may delay the thread, which no controller's own processor does. Of a longer delay, the
# controller's clock counts only this much.
MAX_STEP_US = 50_000


class ComputerClock:
    """The time of this computer in us, from 0 on, without the greater part of long delays."""

    def __init__(self) -> None:
        self._read_us = time.monotonic_ns() // 1000
        self._now_us = 0

    def __call__(self) -> int:
        """Return the time."""
        read_us = time.monotonic_ns() // 1000
        self._now_us += min(MAX_STEP_US, read_us - self._read_us)
        self._read_us = read_us
        return self._now_us


class RealTimePort(Closing):
    """A controller that runs against the clock. A port implements `_wait`, and passes bytes with `_exchange`.

    A context manager: the thread runs inside it, and ends at its end. A controller that fails takes its port with it;
    `close` then raises the reason. `clock`: the controller's time in us, which never goes back; None = the computer's.
    """

    def __init__(self, controller: Device, clock: Callable[[], int] | None = None) -> None:
        self._controller = controller
        self._clock = clock or ComputerClock()
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)
        self._pending = b""  # from the controller, not yet taken by the host
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop the controller's time; may be called again. Raises TransportError if the controller failed."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise TransportError(
                f"the simulated controller failed ({failure!r}), which is a fault in it; please report it"
            ) from failure

    def _run(self) -> None:
        while not self._closing.is_set():
            self._exchange(self._wait())

    @abstractmethod
    def _wait(self) -> bytes:
        """Return the bytes from the host; wait for them for PERIOD_S at most."""

    def _exchange(self, data: bytes) -> None:
        """Give bytes to the controller, let its time pass, and put its bytes into `_pending`."""
        with self._lock:
            try:
                now_us = self._clock()
                if data:
                    self._controller.receive(data, now_us)
                else:
                    self._controller.advance(now_us)
            except Exception as failure:  # whatever the failure is, the host must see that the device is gone
                self._failure = failure
                self._closing.set()
            # Bytes that the host does not take stay in the controller, which limits them.
            if not self._pending:
                self._pending = self._controller.transmit()
