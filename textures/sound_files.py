"""Reads sound files of every common kind, and writes WAV files, with unit and full scale in the file's comment."""

import io
import os
import re
import struct
from pathlib import Path

import numpy as np
import soundfile

from vibrocast.memory import shortage
from vibrocast.textures import sidecar
from vibrocast.textures.axes import AXES
from vibrocast.textures.recording import UNITS, Contents, Recording, Signal, TextureError

FORMATS = {
    ".wav": ("WAV", "WAVEX", "RF64"),
    ".aif": ("AIFF",),
    ".aiff": ("AIFF",),
    ".au": ("AU",),
    ".caf": ("CAF",),
    ".flac": ("FLAC",),
    ".ogg": ("OGG",),
    ".w64": ("W64",),
}
"""By suffix of a file: the formats of libsndfile that it may have."""

# libsndfile's note, in bytes, if a header states more than the file holds: in the samples, or in all of an RF64 or W64.
_CUT_OFF = re.compile(r"(?:data|Data Size|SSND|Riff size|riff) *: (\d+) \(should be (\d+)\)")
# Programs that write into a pipe state about 2 or 4 GiB, because they cannot correct the header at the end.
UNKNOWN_LENGTHS_BYTES = (2**31, 2**32)
UNKNOWN_LENGTH_MARGIN_BYTES = 2**16
_COMMENT = re.compile(r"unit=(.+?); full_scale=([^;]+)(?:; axes=([xyz]+))?(; .*)?")
MAX_BYTES = 2**32 - 2**16
"""Most bytes of samples in a WAV file, whose header states its size in 32 bits."""
_RIFF_BYTES = 12
_LEFT_OUT = 0.01  # of the stated samples; fewer bytes are a chunk behind an odd number of bytes without padding
_PRINTABLE = (0x20, 0x7E)  # the characters of a chunk's name
_FLOAT_FORMAT = 3  # WAVE_FORMAT_IEEE_FLOAT: Microsoft, Multimedia Registration Kit, 1994


def read(path: Path) -> Contents:
    """Read a sound file of any sample format, whole. Raises TextureError."""
    suffix = path.suffix.lower()
    try:
        with soundfile.SoundFile(path) as file:
            if file.format not in FORMATS[suffix]:
                raise TextureError(f"{path}: {file.format} in a {suffix} file; correct its suffix, or convert it")
            _reject_cut_off(file.extra_info, path)
            if lack := shortage(8 * file.frames * file.channels):
                raise TextureError(f"{path}: {lack}")
            samples = file.read(dtype="float64", always_2d=True)
            rate_hz, comment, is_float = float(file.samplerate), file.comment, file.subtype in ("FLOAT", "DOUBLE")
    except UnicodeEncodeError as error:
        raise TextureError(f"{path}: its name holds bytes that are no characters; rename it") from error
    except soundfile.SoundFileError as error:
        raise TextureError(
            f"{path}: not a {suffix} file that can be read; convert it to plain WAV ({error})"
        ) from error
    if suffix == ".wav" and (more := _unstated_bytes(path)):
        raise TextureError(
            f"{path}: its header is unfinished: {more} bytes follow the samples that it states; end the program that "
            "recorded it, or repair the header, as `sox --ignore-length` does"
        )
    commented = stated_by_comment(comment)
    beside = sidecar.read(path)
    if beside is not None:
        _check_sidecar(path, beside, rate_hz, samples.shape[1], commented)
        if commented is None and not is_float:
            raise TextureError(
                f"{path}: another program has stored it as integers, which no longer say how many {beside.unit} 1.0 "
                f"is; save it as 32-bit float, or delete {sidecar.path_of(path).name} and state its unit"
            )
        commented = commented or (beside.unit, 1.0, beside.axes)
    unit, full_scale, axes = commented or ("full scale", 1.0, "")
    samples *= full_scale
    # Only three axes can be reduced; one or two are channels.
    names = tuple(axes) if len(axes) == samples.shape[1] else ()
    return Contents(samples, rate_hz, unit, axes=AXES if len(names) == len(AXES) else (), names=names)


def write(path: Path, recording: Recording, sixteen_bit: bool, note: str = "") -> float:
    """Write a WAV file; return its full scale: the value, in the recording's unit, of 1.0 in the file.

    With 16 bits, full scale is the largest magnitude, or 1 for a signal in "full scale" that fits. With 32-bit floats
    the file holds the values themselves, and full scale is 1. `note` goes into the file's comment, for people. Raises
    TextureError when the rate is not a whole number, OSError or soundfile.SoundFileError when it cannot be written.
    """
    if recording.rate_hz != int(recording.rate_hz):
        raise TextureError(f"{path}: a WAV file needs a whole number of hertz, not {recording.rate_hz}; resample first")
    full_scale, samples = 1.0, recording.samples
    if sixteen_bit:
        peak = float(np.max(np.abs(samples)))
        if peak > 0 and not (recording.unit == "full scale" and peak <= 1):
            full_scale = peak
        # 16 bits reach from -32768 to 32767, one short of full scale.
        samples = np.minimum(np.rint(samples / full_scale * 32768), 32767).astype(np.int16)
    with soundfile.SoundFile(
        path,
        "w",
        samplerate=int(recording.rate_hz),
        channels=recording.channels,
        subtype="PCM_16" if sixteen_bit else "FLOAT",
        format="WAV",
    ) as file:
        axes = "".join(recording.axes).lower()
        file.comment = _comment(recording.unit, full_scale, axes) + (f"; {note}" if note else "")
        file.write(samples)
    return full_scale


class Writer:
    """Writes a WAV file of 32-bit floats piece by piece, in the unit itself; what lies on the disk can always be read.

    The first samples open the file: without any, an earlier one stays. `axes`: letters of AXES, one for each channel,
    or none.
    """

    def __init__(self, path: Path, rate_hz: int, channels: int, unit: str, axes: str) -> None:
        self.frames = 0
        self._frame_bytes = 4 * channels
        self.max_frames = MAX_BYTES // self._frame_bytes
        self._path = path
        self._file: io.FileIO | None = None
        comment = _comment(unit, 1.0, axes.lower()).encode("ascii") + b"\0"
        comment += b"\0" * (len(comment) % 2)
        layout = struct.pack(
            "<HHIIHHH", _FLOAT_FORMAT, channels, rate_hz, rate_hz * self._frame_bytes, self._frame_bytes, 32, 0
        )
        chunks = _chunk(b"fmt ", layout) + _chunk(b"LIST", b"INFO" + _chunk(b"ICMT", comment))
        self._fact_at = 12 + len(chunks) + 8
        chunks += _chunk(b"fact", bytes(4))
        self._data_at = 12 + len(chunks) + 8
        self._start = b"RIFF" + bytes(4) + b"WAVE" + chunks + b"data" + bytes(4)

    def write(self, samples: Signal) -> None:
        """Append samples (n, channels), of which the file holds `max_frames` at most. Raises OSError."""
        if self._file is None:
            self._file = self._path.open("wb", buffering=0)
            self._put(self._start)
        self._put(samples.astype("<f4").tobytes())
        self.frames += len(samples)
        self._state_length()

    def shorten(self, frames: int) -> None:
        """Keep only the first `frames`, and nothing of a piece that was written in part."""
        if self._file is None:
            return
        self.frames = min(self.frames, frames)
        self._file.truncate(self._data_at + self._frame_bytes * self.frames)
        self._state_length()

    def close(self) -> None:
        """Put the samples on the disk, and close the file; a disk that took none keeps no file. Raises OSError."""
        if self._file is None:
            return
        os.fsync(self._file.fileno())
        self._file.close()
        if not self.frames:
            self._path.unlink()

    def _put(self, data: bytes) -> None:
        assert self._file is not None
        while data:
            data = data[self._file.write(data) :]

    def _state_length(self) -> None:
        assert self._file is not None
        size = self._frame_bytes * self.frames
        for place, value in ((4, self._data_at + size - 8), (self._fact_at, self.frames), (self._data_at - 4, size)):
            self._file.seek(place)
            self._put(struct.pack("<I", value))
        self._file.seek(self._data_at + size)


def _chunk(name: bytes, content: bytes) -> bytes:
    return name + struct.pack("<I", len(content)) + content


def _comment(unit: str, full_scale: float, axes: str) -> str:
    return f"unit={unit}; full_scale={full_scale}" + (f"; axes={axes}" if axes else "")


def _check_sidecar(
    path: Path, beside: sidecar.Stated, rate_hz: float, channels: int, commented: tuple[str, float, str] | None
) -> None:
    """Raise TextureError if a WAV file and its sidecar contradict each other."""
    pairs: list[tuple[str, object, object]] = [("Hz", rate_hz, beside.rate_hz), ("channels", channels, beside.channels)]
    if commented is not None:
        pairs += [("as unit", commented[0], beside.unit), ("as axes", commented[2] or "none", beside.axes or "none")]
    for name, here, there in pairs:
        if here != there:
            raise TextureError(
                f"{path}: has {here} {name}, and {sidecar.path_of(path).name} says {there}; correct or delete the "
                "wrong one"
            )


def _reject_cut_off(notes: str, path: Path) -> None:
    """Raise TextureError if libsndfile's notes on a file say that its end is missing."""
    for stated, held in re.findall(_CUT_OFF, notes):
        missing = int(stated) - int(held)
        if missing > 0 and not is_unknown_length(int(stated)):
            raise TextureError(
                f"{path}: cut off, the last {missing} of {stated} bytes are missing; get the whole file, or save what "
                "is left as a new file"
            )


def _unstated_bytes(path: Path) -> int:
    """Return how many bytes follow the samples of a RIFF file and are no chunk: samples that its header leaves out."""
    with path.open("rb") as file:
        order = {b"RIFF": "<", b"RIFX": ">"}.get(file.read(_RIFF_BYTES)[:4])
        end = os.fstat(file.fileno()).st_size
        stated = end
        while order and len(start := file.read(8)) == 8:
            name, size = struct.unpack(f"{order}4sI", start)
            if not all(_PRINTABLE[0] <= each <= _PRINTABLE[1] for each in name):
                more = end - file.tell() + 8
                return more if more > stated * _LEFT_OUT else 0
            stated = size if name == b"data" else stated
            file.seek(size + size % 2, os.SEEK_CUR)
    return 0


def is_unknown_length(size: int) -> bool:
    """Return whether a header states this length in bytes because its writer, into a pipe, did not know it."""
    return any(abs(size - length) <= UNKNOWN_LENGTH_MARGIN_BYTES for length in UNKNOWN_LENGTHS_BYTES)


def stated_by_comment(comment: str) -> tuple[str, float, str] | None:
    """Return unit, full scale and axes from a comment that `write` wrote; None for any other."""
    if match := _COMMENT.fullmatch(comment):
        try:
            full_scale = float(match[2])
        except ValueError:
            full_scale = 0.0
        if match[1] in UNITS and 0 < full_scale < np.inf:
            return match[1], full_scale, match[3] or ""
    return None
