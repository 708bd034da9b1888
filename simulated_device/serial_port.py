"""The serial port of a simulated controller: a pseudo-terminal, or a socket on a system without them."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from vibrocast.simulated_device.device import Device

if TYPE_CHECKING:
    from vibrocast.simulated_device.pty_port import PtyPort
    from vibrocast.simulated_device.socket_port import SocketPort


def has_pseudo_terminals() -> bool:
    """Return whether this system has pseudo-terminals: Linux and macOS have, Windows has not."""
    return find_spec("termios") is not None


def serial_port(controller: Device, link: Path | None = None) -> "PtyPort | SocketPort":
    """Return a port that serves a controller; a host opens its `name` as a serial port. Raises OSError.

    `link`: this name, where the system has pseudo-terminals; None = any.
    """
    if has_pseudo_terminals():
        from vibrocast.simulated_device.pty_port import PtyPort

        return PtyPort(controller, link)
    from vibrocast.simulated_device.socket_port import SocketPort

    return SocketPort(controller)
