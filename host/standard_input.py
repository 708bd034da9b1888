"""Live samples from standard input: raw, or behind the header of a WAV, AU or CAF file, as soon as they come."""

import contextlib
import io
import math
import queue
import struct
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import soundfile

from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, StreamError, StreamHeader
from vibrocast.errors import InputError
from vibrocast.textures import INPUT_UNITS, sound_files
from vibrocast.textures.recording import MAX_CHANNELS, Signal

_CHUNK_BYTES = 1 << 16
_CHUNKS = 64  # read ahead of the stream: a source that is no live one waits then
_MAX_HEADER_BYTES = 1 << 20
_BLOCK_S = 0.01
_SAMPLE_BYTES = {"PCM_S8": 1, "PCM_U8": 1, "ULAW": 1, "ALAW": 1, "PCM_16": 2, "PCM_24": 3, "PCM_32": 4, "FLOAT": 4}
_SAMPLE_BYTES["DOUBLE"] = 8
_OTHER_KINDS = {b"FORM": "an AIFF", b"fLaC": "a FLAC", b"OggS": "an Ogg", b"ID3": "an MP3", b"\x89HDF": "an HDF5"}
# Raw samples are multiples of full scale, or of a count. Most other data, read as floats, are beyond these.
_LEAST, _MOST = 1e-20, 1e9
_JUDGED_SAMPLES, _WRONG_PART = 16, 0.25


@dataclass(frozen=True)
class _Header:
    """What a header states. `stated`: unit, full scale and axes of a comment. `data_bytes`: None = not known."""

    kind: str
    rate_hz: int
    channels: int
    subtype: str
    endian: str
    stated: tuple[str, float, str] | None
    data_bytes: int | None


class StandardInput:
    """Samples from standard input, in the unit.

    Without a header they are 32-bit floats, little-endian, with interleaved channels.

    Attributes:
        rate_hz: Samples per second and channel.
        channels: How many there are.
        unit: "full scale", "m/s^2" or "um".
        full_scale: The value of 1.0, in `unit`.
    """

    def __init__(
        self, rate_hz: int | None, channels: int | None, unit: str | None, full_scale: float | None, raw_rate_hz: int
    ) -> None:
        """Wait for the first bytes. `raw_rate_hz`: without a header and a rate. None: a header says it, or a default.

        `unit`: one of INPUT_UNITS. `full_scale`: in it. Raises InputError for files of other kinds, for options that
        are missing or contradict a header, and where nothing comes.
        """
        if sys.stdin is None:
            raise InputError("standard input is closed; pipe samples into it, or name a texture")
        self._received: queue.Queue[bytes] = queue.Queue(_CHUNKS)
        self._pending = b""
        self._ended = False
        # Without the buffer, whose lock the thread would hold when the program ends.
        stream = getattr(sys.stdin.buffer, "raw", sys.stdin.buffer)
        threading.Thread(target=self._receive, args=(stream,), daemon=True).start()
        header = _read_header(self._take, self._put_back)
        if header is None:
            header = _Header("raw", rate_hz or raw_rate_hz, channels or 1, "FLOAT", "LITTLE", None, None)
        for name, given, states in (("rate_hz", rate_hz, header.rate_hz), ("channels", channels, header.channels)):
            if given not in (None, states):
                raise InputError(
                    f"the header on standard input states `{name}` {states}",
                    f"`{name}` is {given}",
                    "leave it out",
                    name,
                )
        if header.channels > MAX_CHANNELS or header.rate_hz > MAX_RATE_HZ:
            raise InputError(
                f"standard input has {header.channels} channels at {header.rate_hz} Hz; give at most {MAX_CHANNELS} at "
                f"{MAX_RATE_HZ} Hz"
            )
        self.rate_hz, self.channels = header.rate_hz, header.channels
        self.unit, self.full_scale = _unit(header, unit, full_scale)
        self._header = header
        self._left_bytes = math.inf if header.data_bytes is None else header.data_bytes
        self._frame_bytes = _SAMPLE_BYTES[header.subtype] * header.channels
        self._block_bytes = max(1, int(_BLOCK_S * header.rate_hz)) * self._frame_bytes
        self._any = False

    def read(self, timeout_s: float) -> Signal | None:
        """Return the samples (n, channels) of at most 10 ms that come next; none after `timeout_s`; None at the end.

        Raises InputError for what can be no samples, and where the input ends before its first sample.
        """
        if len(self._pending) < self._frame_bytes and not self._ended:
            with contextlib.suppress(queue.Empty):
                self._append(self._received.get(timeout=timeout_s))
        whole = int(min(len(self._pending), self._block_bytes, self._left_bytes))
        whole -= whole % self._frame_bytes
        data, self._pending = self._pending[:whole], self._pending[whole:]
        self._left_bytes -= whole
        if not whole and (self._ended or self._left_bytes < self._frame_bytes):
            if not self._any:
                raise InputError("standard input ended before its first sample; check the program that writes to it")
            return None
        self._any |= whole > 0
        samples, _ = soundfile.read(
            io.BytesIO(data),
            dtype="float64",
            always_2d=True,
            samplerate=self.rate_hz,
            channels=self.channels,
            format="RAW",
            subtype=self._header.subtype,
            endian=self._header.endian,
        )
        if self._header.kind == "raw":
            _check_raw(samples, data + self._pending)
        return np.asarray(samples * self.full_scale)

    def _receive(self, stream: BinaryIO) -> None:
        """Hand on what comes, as soon as it is there, in a thread of its own; empty bytes are the end."""
        data = b"first"
        while data:
            data = stream.read(_CHUNK_BYTES)
            self._received.put(data)

    def _append(self, data: bytes) -> None:
        self._pending += data
        self._ended = not data

    def _take(self, count: int) -> bytes:
        """Return the next bytes, as many as there are before the end."""
        while len(self._pending) < count and not self._ended:
            self._append(self._received.get())
        taken, self._pending = self._pending[:count], self._pending[count:]
        return taken

    def _put_back(self, data: bytes) -> None:
        self._pending = data + self._pending


def _unit(header: _Header, unit: str | None, full_scale: float | None) -> tuple[str, float]:
    """Return the unit and the value of 1.0 in it, of a header or a person. Raises InputError."""
    if header.stated is not None:
        if unit is not None or full_scale is not None:
            raise InputError(
                f"standard input states its unit, {header.stated[0]}",
                action="leave out `unit` and `full_scale`",
                parameter=("unit", "full_scale"),
            )
        return header.stated[:2]
    if unit is None:
        raise InputError(
            "standard input does not state its unit",
            action="give `unit`, or drive for a drive signal",
            parameter="unit",
        )
    output_unit, factor = INPUT_UNITS[unit]
    if full_scale is None and output_unit != "full scale" and header.kind != "raw":
        raise InputError(
            f"the {header.kind} file on standard input is relative to full scale",
            action=f"give `full_scale` too, the value of 1.0 in {unit}",
            parameter="full_scale",
        )
    return output_unit, factor * (1.0 if full_scale is None else full_scale)


def _check_raw(samples: Signal, data: bytes) -> None:
    """Raise InputError for numbers that no program writes as samples. `data`: what they were read from."""
    sizes = np.abs(samples[samples != 0])
    wrong = sizes[~((sizes >= _LEAST) & (sizes <= _MOST))]
    are_few = len(sizes) < _JUDGED_SAMPLES or len(wrong) <= _WRONG_PART * len(sizes)
    if are_few and (wrong < _LEAST).all():
        return
    try:
        StreamHeader.unpack(data)
    except StreamError:
        raise InputError(
            f"standard input holds no 32-bit floats: read as such, a sample is {wrong[0]:.3g}".replace("nan", "NaN"),
            action="send float32, little-endian, and neither text nor integers, or put a WAV header before the samples",
        ) from None
    raise InputError("standard input is a coded stream; play it with `vibrocast play FILE`")


def _read_header(take: Callable[[int], bytes], put_back: Callable[[bytes], None]) -> _Header | None:
    """Return the header at which the input begins; None without one. Raises InputError for other kinds of files."""
    magic = take(12)
    put_back(magic)
    if magic[:4] in (b"RIFF", b"RIFX", b"RF64", b"BW64") and magic[8:] == b"WAVE":
        kind, (head, data_bytes) = "WAV", _wav_head(take)
    elif magic[:4] in (b".snd", b"dns."):
        kind, (head, data_bytes) = "AU", _au_head(take)
    elif magic[:4] == b"caff":
        kind, (head, data_bytes) = "CAF", _caf_head(take)
    else:
        for start, other in _OTHER_KINDS.items():
            if magic.startswith(start):
                raise InputError(f"standard input is {other} file; convert it to WAV first")
        return None
    try:
        with soundfile.SoundFile(io.BytesIO(head)) as file:
            endian = file.endian if file.endian != "FILE" else "LITTLE" if kind == "WAV" else "BIG"
            stated = sound_files.stated_by_comment(file.comment)
            header = _Header(kind, file.samplerate, file.channels, file.subtype, endian, stated, data_bytes)
    except soundfile.SoundFileError as error:
        raise InputError(f"the {kind} header on standard input cannot be read ({error}); send plain PCM") from error
    if header.subtype not in _SAMPLE_BYTES:
        raise InputError(f"the {kind} file on standard input holds {header.subtype}; convert it to plain PCM")
    return header


def _taken(take: Callable[[int], bytes], count: int) -> bytes:
    """Return so many bytes of a header. Raises InputError where there are fewer."""
    data = take(count) if count <= _MAX_HEADER_BYTES else b""
    if len(data) < count:
        raise InputError("standard input ends in the header of its file; check the program that writes to it")
    return data


def _wav_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the header of a WAV file without its length, and the bytes of its samples, None where not known."""
    riff = _taken(take, 12)
    order = ">" if riff.startswith(b"RIFX") else "<"
    head = (b"RIFX" if order == ">" else b"RIFF") + bytes(4) + b"WAVE"
    long_bytes = None
    while True:
        start = _taken(take, 8)
        name, size = struct.unpack(f"{order}4sI", start)
        if name == b"data":
            break
        body = _taken(take, size + size % 2)
        if name == b"ds64" and size >= 16:  # of RF64: EBU Tech 3306
            (long_bytes,) = struct.unpack_from("<Q", body, 8)
        elif len(head) + len(body) < _MAX_HEADER_BYTES:
            head += start + body
    if long_bytes is None and (size == 0 or sound_files.is_unknown_length(size)):
        return head + b"data" + bytes(4), None
    return head + b"data" + bytes(4), long_bytes or size


def _au_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the header of an AU file, and the bytes of its samples, None where not known."""
    start = _taken(take, 12)
    offset, size = struct.unpack(">II" if start.startswith(b".snd") else "<II", start[4:])
    return start + _taken(take, max(24, offset) - 12), None if size >= 2**31 else size


def _caf_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the description in a CAF file, and the bytes of its samples, None where not known."""
    head = _taken(take, 8)
    while True:
        start = _taken(take, 12)
        name, size = struct.unpack(">4sq", start)
        if name == b"data":
            _taken(take, 4)  # how often the file was edited
            return head + struct.pack(">4sq", name, 4) + bytes(4), None if size < 0 else size - 4
        if size < 0:
            raise InputError("the CAF header on standard input is damaged; check the program that writes to it")
        body = _taken(take, size)
        if name == b"desc":
            head += start + body
