"""A simulated controller behind a real pseudo-terminal: any program can open it as a serial port."""

import contextlib
import os
import queue
import select
import tempfile
import threading
import tty
from collections.abc import Callable
from pathlib import Path

from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.real_time import PERIOD_S, RealTimePort

_READ_BYTES = 65_536


class PtyPort(RealTimePort):
    """Serves a controller on a pseudo-terminal.

    `name`: the port that a host opens; the link stays the same when the cable is pulled and plugged in again. A host
    may close and open it at any time. `link`: that name, None = in a temporary folder. Raises OSError if the system has
    no pseudo-terminals, and FileExistsError where a file has this name.
    """

    def __init__(self, controller: Device, link: Path | None = None) -> None:
        super().__init__(controller)
        self._folder = tempfile.TemporaryDirectory(prefix="vibrocast-")
        self.name = str(link or Path(self._folder.name) / "controller")
        self._orders: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        self._master = self._slave = -1
        self._connect()

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
            self._link(os.ttyname(self._slave))

    def _link(self, port: str) -> None:
        """Give a pseudo-terminal the name of this port, in place of a link that leads nowhere. Raises OSError.

        A controller that was killed leaves such a link.
        """
        if os.path.islink(self.name) and not os.path.exists(self.name):
            os.unlink(self.name)
        try:
            os.symlink(port, self.name)
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
            with contextlib.suppress(FileNotFoundError):  # someone else may have deleted it
                os.unlink(self.name)
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
