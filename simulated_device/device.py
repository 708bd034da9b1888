"""What every controller is to the ports that serve it: bytes and time in, bytes out."""

from typing import Protocol


class Device(Protocol):
    """A controller without a port: simulated in Python, the C firmware in this process, or on an emulated processor.

    The clock is in microseconds and never goes back; nothing that a host sends raises anything.
    """

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""

    def advance(self, now_us: int) -> None:
        """Play what is due, and watch over the host; to be called every few milliseconds."""

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
