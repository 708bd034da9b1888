"""Taps every link of this program: keeps the last frames, and writes all of them where a trace is asked for."""

import contextlib
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from vibrocast.device_protocol.frames import FrameSplitter
from vibrocast.device_protocol.trace import TracedFrame, Writer, writer
from vibrocast.device_protocol.transports import Closing, Transport, selectable
from vibrocast.files import atomic_write

KEPT_BYTES = 4 << 20
_FLUSH_S = 1.0


class Tracer:
    """Keeps the last KEPT_BYTES of frames, of all links together."""

    def __init__(self) -> None:
        self._kept: deque[TracedFrame] = deque()
        self._kept_bytes = 0
        self._path: Path | None = None
        self._file: BinaryIO | None = None
        self._writer: Writer | None = None
        self._flushed_s = 0.0

    @property
    def frames(self) -> tuple[TracedFrame, ...]:
        """The last frames."""
        return tuple(self._kept)

    def note(self, frame: TracedFrame) -> None:
        """Take in a frame. Raises OSError where it cannot be written."""
        self._kept.append(frame)
        self._kept_bytes += len(frame.encoded)
        while self._kept_bytes > KEPT_BYTES and self._kept:
            self._kept_bytes -= len(self._kept.popleft().encoded)
        if self._path is not None:
            self._write(frame, self._path)

    def _write(self, frame: TracedFrame, path: Path) -> None:
        """Write a frame into a file that the first one opens; after a failure, no other. Raises OSError."""
        try:
            if self._file is None or self._writer is None:
                self._file = path.open("wb")
                self._writer = writer(self._file, path.suffix)
            self._writer.write(frame)
            if time.monotonic() - self._flushed_s > _FLUSH_S:
                self._file.flush()
                self._flushed_s = time.monotonic()
        except OSError as error:
            with contextlib.suppress(OSError):
                self._close()
            error.filename = str(path)
            raise

    def _close(self) -> None:
        """Write no more frames. Raises OSError."""
        file, self._path, self._file, self._writer = self._file, None, None, None
        if file is not None:
            file.close()

    def take(self) -> tuple[TracedFrame, ...]:
        """Return the kept frames, once."""
        taken = []
        with contextlib.suppress(IndexError):
            while True:  # another thread may add to them
                taken.append(self._kept.popleft())
        self._kept_bytes = 0
        return tuple(taken)

    def save(self, path: Path) -> None:
        """Write the kept frames, whole or not at all. Raises OSError."""
        with atomic_write(path) as partial, partial.open("wb") as file:
            written = writer(file, path.suffix)
            for frame in self._kept:
                written.write(frame)

    @contextlib.contextmanager
    def writing(self, path: Path) -> Iterator[None]:
        """Write each frame of the block into a file, one of `trace.SUFFIXES`; without a frame, none. Raises OSError."""
        self._path = path
        try:
            yield
        except BaseException:
            with contextlib.suppress(OSError):  # the failure itself is the news
                self._close()
            raise
        try:
            self._close()
        except OSError as error:
            error.filename = str(path)
            raise


tracer = Tracer()
"""The one of this program."""


class TappedTransport(Closing):
    """A transport whose bytes the tracer sees; all else is that of the transport."""

    def __init__(self, transport: Transport, link: str) -> None:
        self._transport = transport
        self._link = link
        self._splitters = {True: FrameSplitter(), False: FrameSplitter()}

    def __getattr__(self, name: str) -> Any:
        """Return what else the transport has, such as its file."""
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises TransportError."""
        self._see(data, from_host=True)
        self._transport.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Return the available bytes. Raises TransportError."""
        data = self._transport.read(timeout_s)
        if data:
            self._see(data, from_host=False)
        return data

    def reopen(self) -> None:
        """Close the port or device, and open it again. Raises TransportError while it is absent."""
        self._transport.reopen()

    def close(self) -> None:
        """Release the port; may be called again."""
        self._transport.close()

    def make_selectable(self) -> None:
        """Give the transport a file that can be waited for, where it lacks one and can be given one."""
        self._transport = selectable(self._transport)

    def _see(self, data: bytes, from_host: bool) -> None:
        now_ns = time.time_ns()
        for encoded in self._splitters[from_host].feed(data):
            tracer.note(TracedFrame(now_ns, from_host, self._link, encoded))
