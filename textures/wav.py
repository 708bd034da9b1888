"""Reads and writes WAV files, with unit and full scale in the file's comment."""

import re
from pathlib import Path

import numpy as np
import soundfile

from vibrocast.textures.memory import shortage
from vibrocast.textures.recording import UNITS, Contents, Recording, TextureError

# libsndfile's note, in bytes, if a header states more than the file holds: in the data, or in all of an RF64 file.
_CUT_OFF = re.compile(r"(?:data|Riff size) : (\d+) \(should be (\d+)\)")
# Programs that write into a pipe state about 2 or 4 GiB, because they cannot correct the header at the end.
UNKNOWN_LENGTHS_BYTES = (2**31, 2**32)
UNKNOWN_LENGTH_MARGIN_BYTES = 2**16
_COMMENT = re.compile(r"unit=(.+?); full_scale=([^;]+)(; .*)?")


def read(path: Path) -> Contents:
    """Read a WAV file of any sample format, whole. Raises TextureError."""
    try:
        with soundfile.SoundFile(path) as file:
            if file.format not in ("WAV", "WAVEX", "RF64"):
                raise TextureError(f"{path}: {file.format} in a .wav file; convert it to WAV")
            _reject_cut_off(file.extra_info, path)
            if lack := shortage(8 * file.frames * file.channels):
                raise TextureError(f"{path}: {lack}")
            samples = file.read(dtype="float64", always_2d=True)
            rate_hz, comment = float(file.samplerate), file.comment
    except UnicodeEncodeError as error:
        raise TextureError(f"{path}: its name holds bytes that are no characters; rename it") from error
    except soundfile.SoundFileError as error:
        raise TextureError(f"{path}: not a WAV file that can be read; convert it to plain WAV ({error})") from error
    unit, full_scale = _stated_by_comment(comment)
    samples *= full_scale
    return Contents(samples, rate_hz, unit)


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
        file.comment = f"unit={recording.unit}; full_scale={full_scale}" + (f"; {note}" if note else "")
        file.write(samples)
    return full_scale


def _reject_cut_off(notes: str, path: Path) -> None:
    """Raise TextureError if libsndfile's notes on a WAV file say that its end is missing."""
    for stated, held in re.findall(_CUT_OFF, notes):
        missing = int(stated) - int(held)
        unknown = any(abs(int(stated) - length) <= UNKNOWN_LENGTH_MARGIN_BYTES for length in UNKNOWN_LENGTHS_BYTES)
        if missing > 0 and not unknown:
            raise TextureError(
                f"{path}: cut off, the last {missing} of {stated} bytes are missing; get the whole file, or save what "
                "is left as a new WAV file"
            )


def _stated_by_comment(comment: str) -> tuple[str, float]:
    """Return unit and full scale from a comment that `write` wrote, otherwise those of a plain WAV file."""
    if match := _COMMENT.fullmatch(comment):
        try:
            full_scale = float(match[2])
        except ValueError:
            full_scale = 0.0
        if match[1] in UNITS and 0 < full_scale < np.inf:
            return match[1], full_scale
    return "full scale", 1.0
