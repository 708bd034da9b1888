"""A simulated controller behind a TCP socket of this machine, which pyserial opens as a serial port."""

import contextlib
import select
import socket

from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.real_time import PERIOD_S, RealTimePort

_READ_BYTES = 65_536


class SocketPort(RealTimePort):
    """Serves a controller on a loopback socket, one host at a time.

    `name`: the URL of pyserial that a host opens. A host may close and open it at any time. While it is open, the port
    closes the connection of any other host at once. Raises OSError if the system gives no socket.
    """

    def __init__(self, controller: Device) -> None:
        super().__init__(controller)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        address, port = self._listener.getsockname()
        self.name = f"socket://{address}:{port}"
        self._host: socket.socket | None = None

    def close(self) -> None:
        """Stop serving and close the socket; may be called again. Raises TransportError if the controller failed."""
        try:
            super().close()
        finally:
            self._shut()

    def _run(self) -> None:
        super()._run()
        self._shut()

    def _shut(self) -> None:
        self._hang_up()
        self._listener.close()

    def _wait(self) -> bytes:
        if self._host is None:
            self._pending = b""  # nobody is there to take it
        else:
            self._send(self._host)
        host = self._host
        readable, _, _ = select.select([self._listener] if host is None else [self._listener, host], [], [], PERIOD_S)
        # First handle the end of a host, so that the next one does not count as a second one.
        if host is not None and host in readable:
            return self._receive(host)
        if readable:
            self._greet()
        return b""

    def _greet(self) -> None:
        """Serve a host that connects, unless another one is served."""
        with contextlib.suppress(OSError):  # it has left already
            arrived, _ = self._listener.accept()
            if self._host is not None:
                arrived.close()
                return
            arrived.setblocking(False)
            arrived.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._host = arrived

    def _receive(self, host: socket.socket) -> bytes:
        try:
            data = host.recv(_READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def _send(self, host: socket.socket) -> None:
        try:
            # Bytes that nobody reads wait for the next time.
            with contextlib.suppress(BlockingIOError):
                self._pending = self._pending[host.send(self._pending) :]
        except OSError:
            self._hang_up()

    def _hang_up(self) -> None:
        """Close the connection to the host, and drop the bytes that it has not taken."""
        if self._host is not None:
            self._host.close()
            self._host = None
        self._pending = b""
