"""A simulated controller behind a real pseudo-terminal: any program can open it as a serial port."""

import contextlib
import os
import queue
import re
import select
import tempfile
import threading
import tty
from collections.abc import Callable
from pathlib import Path

from vibrocast.files import runs
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.real_time import PERIOD_S, RealTimePort

_READ_BYTES = 65_536
_OWNER = re.compile(r"vibrocast-(\d+)-")
"""The process in the name of a port's folder."""


class PtyPort(RealTimePort):
    """Serves a controller on a pseudo-terminal.

    `name`: the port that a host opens; the link stays the same when the cable is pulled and plugged in again. A host
    may close and open it at any time. `link`: that name, None = in a temporary folder. Raises OSError if the system has
    no pseudo-terminals, and FileExistsError where a file has this name, or another running controller.
    """

    def __init__(self, controller: Device, link: Path | None = None) -> None:
        super().__init__(controller)
        # Its name says whose it is: the system gives the pseudo-terminal of a killed process to another one.
        self._folder = tempfile.TemporaryDirectory(prefix=f"vibrocast-{os.getpid()}-")
        self._port = Path(self._folder.name) / "controller"
        self.name = str(link or self._port)
        self._orders: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        self._master = self._slave = -1
        self._connect()
        if link is not None:
            self._link()

    def unplug(self) -> None:
        """Remove the port, as a pulled cable does. The controller runs on."""
        self._order(self._disconnect)

    def plug(self) -> None:
        """Make the port appear again."""
        self._order(self._connect)

    def close(self) -> None:
        """Stop serving and remove the port; may be called again. Raises TransportError if the controller failed."""
        try:
            super().close()
        finally:
            self._disconnect()
            with contextlib.suppress(OSError):  # someone else may have deleted it
                if os.readlink(self.name) == str(self._port):
                    os.unlink(self.name)
            self._folder.cleanup()

    def _run(self) -> None:
        super()._run()
        self._disconnect()

    def _order(self, action: Callable[[], None]) -> None:
        """Let the serving thread do an action, and wait for it: no other thread may close the file that it reads.

        If the thread has ended, there is nothing to plug or unplug.
        """
        done = threading.Event()
        self._orders.put((action, done))
        while self._thread.is_alive() and not done.wait(PERIOD_S):
            pass

    def _connect(self) -> None:
        if self._master < 0:
            # The slave stays open here, so the port outlives every host that closes it.
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self._port.symlink_to(os.ttyname(self._slave))

    def _link(self) -> None:
        """Give this port its name, in place of a link that a killed controller has left. Raises OSError."""
        if os.path.islink(self.name):
            owner = _OWNER.search(os.readlink(self.name))
            if not os.path.exists(self.name) or (owner is not None and not runs(int(owner[1]))):
                os.unlink(self.name)
        try:
            os.symlink(self._port, self.name)
        except FileExistsError as error:
            problem = (
                "a file has this name, or a controller runs behind it; end that or remove it, or choose another name"
            )
            raise FileExistsError(f"{self.name}: {problem}") from error
        except OSError as error:
            error.filename, error.filename2 = self.name, None
            raise

    def _disconnect(self) -> None:
        if self._master >= 0:
            self._port.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1
            self._pending = b""

    def _wait(self) -> bytes:
        while not self._orders.empty():
            action, done = self._orders.get()
            action()
            done.set()
        if self._master < 0:
            self._closing.wait(PERIOD_S)
            return b""
        # Bytes that nobody reads wait for the next time.
        with contextlib.suppress(BlockingIOError):
            self._pending = self._pending[os.write(self._master, self._pending) :]
        readable, _, _ = select.select([self._master], [], [], PERIOD_S)
        return os.read(self._master, _READ_BYTES) if readable else b""
