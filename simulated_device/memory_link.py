"""A link in memory to a controller in simulated time."""

from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_wire import FaultyWire

STEP_US = 1000


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

    `clock` and `sleep` are the host's, in simulated time. `time`: shared with other links, None = its own. The cable
    is out where the controller is at the end of a FaultyWire that is cut.
    """

    def __init__(self, controller: Device, *, time: SimulatedTime | None = None) -> None:
        self.controller = controller
        self.time = time or SimulatedTime()
        self.time.links.append(self)

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
        self.controller.receive(data, self.now_us)

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes from the controller; time passes until some have come, or `timeout_s` is over."""
        end_us = self.now_us + round(timeout_s * 1e6)
        while True:
            self._need_cable()
            data = self.controller.transmit()
            if data or self.now_us >= end_us:
                return data
            self.sleep(min(self.time.step_us, end_us - self.now_us) / 1e6)

    def reopen(self) -> None:
        """Open the port again. Raises TransportError while the cable is out."""
        self._need_cable()
        self.controller.transmit()

    def close(self) -> None:
        """Do nothing: there is no port to release."""

    def _need_cable(self) -> None:
        if isinstance(self.controller, FaultyWire) and self.controller.is_cut(self.now_us):
            raise TransportError("the cable to the simulated controller is out; plug it in")
