"""What steers a player while it plays: the keys of a terminal, and lines on a socket."""

import contextlib
import json
import os
import select
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from vibrocast.errors import InputError
from vibrocast.host.track_player import Command, Event, Remote, command_of

KEYS = {
    " ": Command("toggle"),
    "\x1b[C": Command("seek", 1.0),
    "\x1b[D": Command("seek", -1.0),
    "\x1b[A": Command("gain", 1.0),
    "\x1b[B": Command("gain", -1.0),
    "n": Command("next"),
    "p": Command("previous"),
    "l": Command("loop"),
    "q": Command("stop"),
}
_POLL_S = 0.1
_LINE_BYTES = 1000
_LISTENERS = 16


@contextlib.contextmanager
def keys(remote: Remote) -> Iterator[None]:
    """Let the keys of the terminal steer a player, if stdin and stderr are one; where keys cannot be read, do nothing.

    Yields while they do. Ctrl-C interrupts as always, and the terminal is left as it was.
    """
    try:
        import termios
        import tty
    except ImportError:  # on Windows
        yield
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        yield
        return
    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            if select.select([file], [], [], _POLL_S)[0]:
                pressed = os.read(file, 8).decode(errors="replace")
                if not pressed:
                    return
                for command in _commands(pressed):
                    remote.send(command)

    thread = threading.Thread(target=read, name="keys", daemon=True)
    tty.setcbreak(file)
    try:
        thread.start()
        yield
    finally:
        done.set()
        thread.join()
        termios.tcsetattr(file, termios.TCSADRAIN, before)


def _commands(pressed: str) -> Iterator[Command]:
    """Yield the commands of keys that were pressed; others do nothing."""
    while pressed:
        key = next((key for key in KEYS if pressed.startswith(key)), pressed[0])
        if key in KEYS:
            yield KEYS[key]
        pressed = pressed[len(key) :]


class Control:
    """A Unix socket whose lines are commands; every client gets the player's events, each as a line of JSON."""

    def __init__(self, path: Path, remote: Remote) -> None:
        """Listen. Raises InputError where nothing can listen there."""
        self._path, self._remote = path, remote
        self._clients: list[socket.socket] = []
        self._lock = threading.Lock()
        try:
            self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._server.bind(str(path))
            path.chmod(0o600)  # whoever may write to it may steer the actuator
            self._server.listen()
        except (OSError, AttributeError) as error:
            raise InputError(
                f"{path}: no control socket can be there: {error}; give a name that is free, in a folder of yours"
            ) from error
        threading.Thread(target=self._accept, name="control", daemon=True).start()

    def tell(self, event: Event) -> None:
        """Send an event to all clients; one that does not read is dropped."""
        told = {**vars(event), "error": None if event.error is None else str(event.error)}
        line = json.dumps(told).encode() + b"\n"
        with self._lock:
            for client in self._clients:
                sent = 0
                with contextlib.suppress(OSError):
                    sent = client.send(line, socket.MSG_DONTWAIT)
                if sent < len(line):
                    _end(client)

    def close(self) -> None:
        """Stop listening, and remove the socket."""
        self._server.close()
        self._path.unlink(missing_ok=True)
        with self._lock:
            for client in self._clients:
                _end(client)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # it is closed
            while True:
                client, _ = self._server.accept()
                with self._lock:
                    if len(self._clients) >= _LISTENERS:
                        client.close()
                        continue
                    self._clients.append(client)
                threading.Thread(target=self._read, args=(client,), name="control client", daemon=True).start()

    def _read(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError), client.makefile("rb") as lines:
            while (line := lines.readline(_LINE_BYTES)).endswith(b"\n"):
                try:
                    self._remote.send(command_of(line.decode(errors="replace")))
                except InputError as error:
                    client.sendall(json.dumps({"error": str(error)}).encode() + b"\n")
        with self._lock:
            self._clients.remove(client)
        client.close()


def _end(client: socket.socket) -> None:
    """End the connection; the thread that reads then closes it."""
    with contextlib.suppress(OSError):
        client.shutdown(socket.SHUT_RDWR)
