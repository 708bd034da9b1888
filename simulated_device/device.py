"""The interface of every controller to the ports that serve it: bytes and time in, bytes out."""

from typing import Protocol


class Device(Protocol):
    """A controller without a port: simulated in Python, the C firmware in this process, or on an emulated processor.

    The clock is in microseconds and never goes back. No bytes from a host raise an exception.
    """

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""

    def advance(self, now_us: int) -> None:
        """Play the samples that are due, and run the watchdog; call it every few milliseconds."""

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
