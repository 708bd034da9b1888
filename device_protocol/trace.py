"""Traces of links: frames of both directions with their times, as pcapng for Wireshark or as JSON lines.

Every link of this program is tapped: the last frames are kept, and all are written where a trace is asked for.

pcapng: draft-ietf-opsawg-pcapng, section 4. A packet is a frame as on the wire, still COBS-encoded, without its
delimiter; a damaged frame is kept as it came. The link type is LINKTYPE_USER0 (147). Each link is an interface whose
name is the address of the controller. The direction is in the flags of a packet: outbound is from the host.
"""

import contextlib
import json
import struct
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from vibrocast.device_protocol.frames import FrameSplitter, payload_of
from vibrocast.device_protocol.messages import Message, MessageError, unpack
from vibrocast.device_protocol.transports import Closing, Transport, selectable
from vibrocast.errors import InputError
from vibrocast.files import atomic_write
from vibrocast.memory import shortage

LINK_TYPE = 147
SUFFIXES = (".pcapng", ".jsonl")
KEPT_BYTES = 4 << 20
"""Of frames, by the tracer."""
_FLUSH_S = 1.0

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_BYTE_ORDER = 0x1A2B3C4D
_IF_NAME, _IF_TSRESOL, _FLAGS = 2, 9, 2
_NANOSECONDS = 9
_INBOUND, _OUTBOUND = 1, 2
_BLOCK = struct.Struct("<II")
_PACKET_HEAD = struct.Struct("<IIIII")
_MAX_BLOCK_BYTES = 1 << 20


@dataclass(frozen=True)
class TracedFrame:
    """A frame on a link. `time_ns`: since 1970, UTC. `link`: the controller's address. `encoded`: without delimiter."""

    time_ns: int
    from_host: bool
    link: str
    encoded: bytes

    def message(self) -> tuple[int, Message] | None:
        """Return the sequence number and the message; None for a damaged frame, or a message of a later version."""
        try:
            return unpack(payload_of(self.encoded))
        except MessageError:
            return None

    def as_json(self) -> dict[str, Any]:
        """Return the frame ready for JSON: the message with its fields, and the bytes in hexadecimal."""
        document: dict[str, Any] = {
            "time_ns": self.time_ns,
            "from": "host" if self.from_host else "controller",
            "link": self.link,
        }
        if (found := self.message()) is None:
            document["message"] = None
        else:
            sequence, message = found
            document |= {"sequence": sequence, "message": type(message).__name__, "fields": _plain(vars(message))}
        return {**document, "frame": self.encoded.hex()}


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold; an infinity stands in words."""
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(vars(value))
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, float) and value - value != 0:
        return str(value)
    return value


class Writer(Protocol):
    """Writes frames into an open file."""

    def write(self, frame: TracedFrame) -> None:
        """Write a frame. Raises OSError."""


class PcapngWriter:
    """Writes pcapng; the section's header at once, an interface before its first packet."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._links: dict[str, int] = {}
        self._write(_SECTION, struct.pack("<IHHq", _BYTE_ORDER, 1, 0, -1))

    def write(self, frame: TracedFrame) -> None:
        """Write a frame as an Enhanced Packet Block."""
        if frame.link not in self._links:
            self._links[frame.link] = len(self._links)
            name = _option(_IF_NAME, frame.link.encode())
            resolution = _option(_IF_TSRESOL, bytes([_NANOSECONDS]))
            self._write(_INTERFACE, struct.pack("<HHI", LINK_TYPE, 0, 0) + name + resolution + _option(0, b""))
        size = len(frame.encoded)
        head = _PACKET_HEAD.pack(self._links[frame.link], frame.time_ns >> 32, frame.time_ns & 0xFFFF_FFFF, size, size)
        flags = struct.pack("<I", _OUTBOUND if frame.from_host else _INBOUND)
        self._write(_PACKET, head + _padded(frame.encoded) + _option(_FLAGS, flags) + _option(0, b""))

    def _write(self, kind: int, body: bytes) -> None:
        length = len(body) + 12
        self._file.write(_BLOCK.pack(kind, length) + body + struct.pack("<I", length))


class JsonLinesWriter:
    """Writes one JSON object a line."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, frame: TracedFrame) -> None:
        """Write a frame as a line."""
        self._file.write(json.dumps(frame.as_json(), allow_nan=False).encode() + b"\n")


def writer(file: BinaryIO, suffix: str) -> Writer:
    """Return the writer for one of SUFFIXES."""
    return JsonLinesWriter(file) if suffix.lower() == ".jsonl" else PcapngWriter(file)


def read_trace(path: Path) -> Iterator[TracedFrame]:
    """Yield the frames of a trace, in their order; a last block or line that was cut is left out.

    Raises InputError, with what to do, for any other file, and OSError.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: no file; give a trace, as `vibrocast --trace FILE` writes it")
    if lack := shortage(path.stat().st_size):
        raise InputError(f"{path}: {lack}")
    with path.open("rb") as file:
        begin = file.read(4)
        file.seek(0)
        if begin == struct.pack("<I", _SECTION):
            yield from _read_pcapng(file, path)
        elif begin[:1] == b"{":
            yield from _read_lines(file, path)
        else:
            raise InputError(f"{path}: no trace; give one that `vibrocast --trace FILE` wrote")


def _read_pcapng(file: BinaryIO, path: Path) -> Iterator[TracedFrame]:
    links: list[str] = []
    while len(head := file.read(_BLOCK.size)) == _BLOCK.size:
        kind, length = _BLOCK.unpack(head)
        if length < 12 or length % 4 or length > _MAX_BLOCK_BYTES:
            raise InputError(f"{path}: a block of {length} bytes; the file is damaged, trace again")
        body = file.read(length - _BLOCK.size)
        if len(body) < length - _BLOCK.size:
            return
        try:
            if kind == _SECTION and struct.unpack_from("<I", body) != (_BYTE_ORDER,):
                raise InputError(f"{path}: of another byte order; give a trace that vibrocast wrote")
            if kind == _INTERFACE:
                (link_type,) = struct.unpack_from("<H", body)
                if link_type != LINK_TYPE:
                    raise InputError(f"{path}: link type {link_type}; give a trace that vibrocast wrote")
                links.append(_options(body[8:-4]).get(_IF_NAME, b"").decode(errors="replace"))
            elif kind == _PACKET:
                number, high, low, size, _ = _PACKET_HEAD.unpack_from(body)
                encoded = body[_PACKET_HEAD.size :][:size]
                options = _options(body[_PACKET_HEAD.size + (size + 3) // 4 * 4 : -4])
                (flags,) = struct.unpack("<I", options.get(_FLAGS, bytes(4)))
                yield TracedFrame(high << 32 | low, flags & 3 == _OUTBOUND, links[number], encoded)
        except (struct.error, IndexError) as error:
            raise InputError(f"{path}: a damaged block; trace again") from error


def _read_lines(file: BinaryIO, path: Path) -> Iterator[TracedFrame]:
    for number, line in enumerate(file, 1):
        if not line.endswith(b"\n"):
            return
        try:
            frame = json.loads(line)
            yield TracedFrame(
                int(frame["time_ns"]),
                frame["from"] == "host",
                str(frame["link"]),
                bytes.fromhex(frame["frame"]),
            )
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no frame; trace again") from error


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _options(data: bytes) -> dict[int, bytes]:
    found = {}
    while len(data) >= 4:
        code, length = struct.unpack_from("<HH", data)
        if code == 0:
            break
        found[code] = data[4 : 4 + length]
        data = data[4 + (length + 3) // 4 * 4 :]
    return found


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
        """Write each frame of the block into a file, one of SUFFIXES; without a frame, none. Raises OSError."""
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
