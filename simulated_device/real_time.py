"""Runs a controller in real time in a thread of its own; the ports build on it."""

import threading
import time
from abc import abstractmethod
from typing import Self

from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.simulated_device.device import Device

# What goes to the DAC in between is made at its end, so by this much a packet may come too late and still be played.
PERIOD_S = 0.002
# A computer under load may keep the thread waiting, which no controller's own processor does: of a longer wait, the
# controller's clock counts only so much.
MAX_STEP_US = 50_000


class RealTimePort(Closing):
    """A controller that runs against the clock. A port fills `_wait`, and hands bytes over with `_exchange`.

    A context manager: the thread runs inside it, and has ended when it is left. A controller that fails takes its port
    with it; `close` then says why.
    """

    def __init__(self, controller: Device) -> None:
        self._controller = controller
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)
        self._read_us = time.monotonic_ns() // 1000
        self._now_us = 0
        self._pending = b""  # from the controller, not yet taken by the host
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop the controller's time; may be called again. Raises TransportError if the controller had failed."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise TransportError(
                f"the simulated controller failed ({failure!r}): this is a fault in it, please report it"
            ) from failure

    def _run(self) -> None:
        while not self._closing.is_set():
            self._exchange(self._wait())

    @abstractmethod
    def _wait(self) -> bytes:
        """Return what the host sent, waiting for it PERIOD_S at most."""

    def _exchange(self, data: bytes) -> None:
        """Give bytes to the controller, let its time pass, and put what it sends into `_pending`."""
        with self._lock:
            read_us = time.monotonic_ns() // 1000
            self._now_us += min(MAX_STEP_US, read_us - self._read_us)
            self._read_us = read_us
            try:
                if data:
                    self._controller.receive(data, self._now_us)
                else:
                    self._controller.advance(self._now_us)
            except Exception as failure:  # whatever it is: the host must see that the device is gone
                self._failure = failure
                self._closing.set()
            # What the host does not take stays in the controller, which bounds it.
            if not self._pending:
                self._pending = self._controller.transmit()
