"""The way to the controller under test: it notes which messages pass, and does harm where a test asks for it."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from vibrocast.device_protocol.frames import FrameReader
from vibrocast.device_protocol.messages import Error, Message, MessageError, Status, unpack
from vibrocast.device_protocol.transports import Transport
from vibrocast.harness.sensors import Recorder
from vibrocast.simulated_device.faulty_wire import FaultyTransport


class TappedLink(FaultyTransport):
    """A FaultyTransport that notes which messages pass.

    `clock`, `sleep`: the host's; for a transport in simulated time, its own. `restart`: takes the power from the
    controller and gives it back; None where nobody can. `may_flash`: whether slots for model images may be written.
    `recorder`: of the real output, a sensor's or the file in which a port writes its DAC codes; None = there is none.
    `messages`: names of the types of message that passed either way, whole. `error_codes`: those of the controller.
    `late_s`: since `forget_lateness`, the most by which this machine woke up late from a wait, or by which the
    controller's clock fell behind: a Status was read late, or what runs the controller stood still.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        restart: Callable[[], None] | None = None,
        may_flash: bool = True,
        recorder: Path | Recorder | None = None,
    ) -> None:
        super().__init__(transport, clock)
        self._sleep = sleep
        self.forget_lateness()
        self.restart = restart
        self.may_flash = may_flash
        self.recorder = recorder
        self.messages: set[str] = set()
        self.error_codes: set[int] = set()
        self._sent, self._received = FrameReader(), FrameReader()

    def forget_lateness(self) -> None:
        """Begin to measure `late_s` again."""
        self.late_s = self._device_s = 0.0
        self._least_lag_s = math.inf

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        due_s = self.clock() + seconds
        self._sleep(seconds)
        self.late_s = max(self.late_s, self.clock() - due_s)

    def cut(self) -> None:
        """Fail, as a pulled cable does, until the transport is opened again."""
        self._out_until_s = math.inf

    def heal(self) -> None:
        """End all harm. Raises TransportError where the transport cannot be opened again."""
        self.to_controller = self.to_host = None
        if math.isinf(self._out_until_s):
            self.reopen()

    def write(self, data: bytes) -> None:
        """Send bytes. Raises TransportError."""
        self._need_cable()
        for message in _messages(self._sent, data):
            self.messages.add(type(message).__name__)
        super().write(data)

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, waiting for it at most `timeout_s`. Raises TransportError."""
        self._need_cable()
        due_s = self.clock() + timeout_s
        data = self._transport.read(timeout_s)
        self.late_s = max(self.late_s, self.clock() - due_s)
        for message in _messages(self._received, data):
            self.messages.add(type(message).__name__)
            if isinstance(message, Error):
                self.error_codes.add(message.code)
            if isinstance(message, Status):
                self._compare_clocks(message.device_time_us / 1e6)
        return data if self.to_host is None else self.to_host.carry(data)

    def _compare_clocks(self, device_s: float) -> None:
        lag_s = self.clock() - device_s
        # A clock that goes back is one of a restarted controller, or a wrong one: no sign of a slow machine.
        self._least_lag_s = min(self._least_lag_s, lag_s) if device_s >= self._device_s else lag_s
        self._device_s = device_s
        self.late_s = max(self.late_s, lag_s - self._least_lag_s)

    def reopen(self) -> None:
        """Close, and open again. Raises TransportError."""
        self._transport.reopen()
        self._out_until_s = 0.0


def _messages(reader: FrameReader, data: bytes) -> Iterator[Message]:
    """Yield the messages in the frames that these bytes complete, as far as they can be read."""
    for payload in reader.feed(data):
        with contextlib.suppress(MessageError):
            yield unpack(payload)[1]
