"""Loads recordings and height profiles from files of every supported kind, and saves WAV files and profiles."""

import re
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from numpy.typing import NDArray

from vibrocast.textures import p1918
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import INPUT_UNITS, UNITS, Contents, Recording, TextureError
from vibrocast.textures.text import Table, known_unit, read_table, signal_of, uniform_step

AXES = (*p1918.AXES, p1918.DFT321)
TEXT_SUFFIXES = (".csv", ".txt", ".tsv")
ARRAY_SUFFIXES = (".npy", ".npz")
SAMPLES_KEY, RATE_KEY, UNIT_KEY = "samples", "rate_hz", "unit"
POSITION_NAME = "position"

# What libsndfile notes, in bytes, where a header states more than the file holds: of the data, of all in an RF64 file.
_CUT_OFF = re.compile(r"(?:data|Riff size) : (\d+) \(should be (\d+)\)")
# Programs that write into a pipe state about 2 or 4 GiB, for they cannot go back to the header at the end.
UNKNOWN_LENGTHS_BYTES = (2**31, 2**32)
UNKNOWN_LENGTH_MARGIN_BYTES = 2**16
_WAV_COMMENT = re.compile(r"unit=(.+); full_scale=(.+)")
_ARRAY_ERRORS = (
    EOFError,
    NotImplementedError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


@np.errstate(over="ignore", invalid="ignore")  # a Recording refuses what overflows
def load(
    path: str | Path,
    rate_hz: float | None = None,
    unit: str | None = None,
    full_scale: float | None = None,
    axis: str | None = None,
    key: str | None = None,
    hand_speed_mm_s: float | None = None,
) -> Recording:
    """Load a recording from a WAV, CSV, TXT, NPY or NPZ file, or an IEEE P1918.1.1 trace from its folder.

    What the file does not state must be given; what it states cannot be given otherwise. `unit`: one of INPUT_UNITS,
    turned into one of UNITS. `full_scale`: the value, in `unit`, of 1.0 in the file, or of the largest number of its
    type in an array of integers; a file in "full scale", as every plain WAV is, needs it with any other `unit`.
    `axis`: one of AXES, makes one channel of three; without it only a P1918.1.1 folder is reduced, by DFT321. `key`:
    which array of an NPZ file. `hand_speed_mm_s`: of the sweep over a height profile. Raises TextureError, which says
    what to do, for all that fails.
    """
    path = Path(path)
    if axis is not None and axis not in AXES:
        raise TextureError(f"--axis {axis}: not one of {', '.join(AXES)}")
    if key is not None and path.suffix.lower() != ".npz":
        raise TextureError(f"{path}: --key chooses an array of an NPZ file; leave it out here")
    try:
        contents = _read(path, axis, key)
    except OSError as error:
        raise TextureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise TextureError(f"{path}: too large for the memory of this machine; cut it into parts") from error
    if isinstance(contents, Profile):
        if hand_speed_mm_s is None:
            raise TextureError(f"{path}: a height profile; give the speed of the hand over it: --hand-speed-mm-s")
        if any(option is not None for option in (rate_hz, unit, full_scale, axis)):
            raise TextureError(f"{path}: a height profile in um; it takes --hand-speed-mm-s and no other option")
        return contents.recording(hand_speed_mm_s)
    if hand_speed_mm_s is not None:
        raise TextureError(
            f"{path}: not a height profile (columns position_um, height_um); leave out --hand-speed-mm-s"
        )
    if rate_hz is None:
        rate_hz = contents.rate_hz
    elif contents.rate_hz is not None and abs(contents.rate_hz - rate_hz) > contents.rate_tolerance_hz:
        raise TextureError(f"{path}: states {contents.rate_hz:g} Hz; leave out --rate-hz {rate_hz:g}")
    if rate_hz is None:
        raise TextureError(f"{path}: does not state its sample rate; give --rate-hz")
    output_unit, scale = scale_of(contents, unit, full_scale, path)
    samples = contents.samples
    if scale != 1:
        samples *= scale
    return Recording(samples, rate_hz, output_unit, path.stem if path.is_file() else path.name)


def load_profile(path: str | Path) -> Profile:
    """Load a height profile: CSV or TXT with columns such as position_um and height_um. Raises TextureError."""
    path = Path(path)
    if path.suffix.lower() not in TEXT_SUFFIXES:
        raise TextureError(f"{path}: a height profile is one of {', '.join(TEXT_SUFFIXES)}")
    try:
        return _profile_of(read_table(path), path)
    except OSError as error:
        raise TextureError(f"{path}: cannot be read: {error.strerror or error}") from error


def save_profile(path: str | Path, profile: Profile) -> None:
    """Save a height profile as CSV of position_um and height_um, to a nanometre of height. Raises OSError."""
    positions_um = profile.spacing_um * np.arange(len(profile.heights_um))
    columns = np.column_stack([positions_um, profile.heights_um])
    names = "position_um,height_um"
    np.savetxt(path, columns, fmt=("%.10g", "%.3f"), delimiter=",", header=names, comments="")


def save_wav(path: str | Path, recording: Recording, sixteen_bit: bool = True) -> float:
    """Save a recording as WAV; return its full scale: the value, in the recording's unit, of 1.0 in the file.

    As 16 bit, full scale is the largest magnitude, or 1 for a signal in "full scale" that fits; as 32-bit float the
    file holds the values themselves, and full scale is 1. Unit and full scale are written into the file's comment,
    from which `load` knows them. Raises TextureError when the rate is not a whole number or the file cannot be written.
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
    try:
        with soundfile.SoundFile(
            path,
            "w",
            samplerate=int(recording.rate_hz),
            channels=recording.channels,
            subtype="PCM_16" if sixteen_bit else "FLOAT",
            format="WAV",
        ) as file:
            file.comment = f"unit={recording.unit}; full_scale={full_scale}"
            file.write(samples)
    except (OSError, soundfile.SoundFileError) as error:
        raise TextureError(f"{path}: cannot be written: {error}") from error
    return full_scale


def _read(path: Path, axis: str | None, key: str | None) -> Contents | Profile:
    if path.is_dir() or not path.exists():
        contents = p1918.read_folder(path, None if axis == p1918.DFT321 else axis)
        if contents.samples.shape[1] == 1:
            return contents
        return replace(contents, samples=p1918.dft321(contents.samples))
    if not path.is_file():
        raise TextureError(f"{path}: not a file")
    suffix = path.suffix.lower()
    if suffix == ".wav":
        return _with_axis(_read_wav(path), axis, path)
    if suffix in ARRAY_SUFFIXES:
        return _with_axis(_read_arrays(path, key), axis, path)
    if suffix not in TEXT_SUFFIXES:
        raise TextureError(f"{path}: unknown kind of file; known are .wav, {', '.join(TEXT_SUFFIXES + ARRAY_SUFFIXES)}")
    table = read_table(path)
    if POSITION_NAME in table.names:
        return _profile_of(table, path)
    contents = p1918.with_known_rate(signal_of(table, path), path)
    own_axis = p1918.axis_of(path)
    if own_axis is None or axis in (None, own_axis):
        return contents if own_axis else _with_axis(contents, axis, path)
    raise TextureError(f"{path}: holds axis {own_axis}; for --axis {axis} give {path.with_name(path.stem[:-2])}")


def _with_axis(contents: Contents, axis: str | None, path: Path) -> Contents:
    if axis is None:
        return contents
    channels = contents.samples.shape[1]
    if channels != len(p1918.AXES):
        raise TextureError(f"{path}: --axis needs three channels, X, Y and Z; this file has {channels}")
    if axis == p1918.DFT321:
        return replace(contents, samples=p1918.dft321(contents.samples))
    return replace(contents, samples=contents.samples[:, [p1918.AXES.index(axis)]])


def scale_of(contents: Contents, unit: str | None, full_scale: float | None, path: Path) -> tuple[str, float]:
    """Return the unit of UNITS, and the factor that turns the file's numbers into it."""
    given = None if unit is None else known_unit(unit, "`unit`")
    if full_scale is not None and not (np.isfinite(full_scale) and full_scale > 0):
        raise TextureError(f"--full-scale {full_scale}: it must be positive")
    if contents.unit not in (None, "full scale") and (given not in (None, contents.unit) or full_scale is not None):
        raise TextureError(f"{path}: states its unit, {contents.unit}; leave out --unit and --full-scale")
    if contents.unit == "full scale" and given not in (None, "full scale") and full_scale is None:
        raise TextureError(f"{path}: is relative to full scale; give --full-scale too, the value of 1.0 in {given}")
    chosen = given or contents.unit
    if chosen is None:
        raise TextureError(f"{path}: does not state its unit; give --unit, one of {', '.join(INPUT_UNITS)}")
    output_unit, factor = INPUT_UNITS[chosen]
    if output_unit == "full scale" and full_scale is not None:
        raise TextureError(f"{path}: --full-scale is a physical value; give its --unit too, such as m/s^2")
    if output_unit != "full scale" and full_scale is None:
        return output_unit, factor
    if contents.full_scale is None:
        raise TextureError(f"{path}: its integers do not say what full scale is; store them as int16, int32 or float")
    return output_unit, factor * (full_scale or 1.0) / contents.full_scale


def _read_wav(path: Path) -> Contents:
    try:
        with soundfile.SoundFile(path) as file:
            if file.format not in ("WAV", "WAVEX", "RF64"):
                raise TextureError(f"{path}: {file.format} in a .wav file; convert it to WAV")
            _refuse_cut_off(file.extra_info, path)
            samples = file.read(dtype="float64", always_2d=True)
            rate_hz, comment = float(file.samplerate), file.comment
    except UnicodeEncodeError as error:
        raise TextureError(f"{path}: its name holds bytes that are no characters; rename it") from error
    except soundfile.SoundFileError as error:
        raise TextureError(f"{path}: not a WAV file that can be read; convert it to plain WAV ({error})") from error
    unit, full_scale = _stated_by_comment(comment)
    samples *= full_scale
    return Contents(samples, rate_hz, unit)


def _refuse_cut_off(notes: str, path: Path) -> None:
    """Raise TextureError where libsndfile's notes on a WAV file say that its end is missing."""
    for stated, held in re.findall(_CUT_OFF, notes):
        missing = int(stated) - int(held)
        unknown = any(abs(int(stated) - length) <= UNKNOWN_LENGTH_MARGIN_BYTES for length in UNKNOWN_LENGTHS_BYTES)
        if missing > 0 and not unknown:
            raise TextureError(
                f"{path}: cut off, the last {missing} of {stated} bytes are missing; get the whole file, or save what "
                "is left as a new WAV file"
            )


def _stated_by_comment(comment: str) -> tuple[str, float]:
    """Return unit and full scale as `save_wav` writes them into the comment, otherwise those of a plain WAV file."""
    if match := _WAV_COMMENT.fullmatch(comment):
        try:
            full_scale = float(match[2])
        except ValueError:
            full_scale = 0.0
        if match[1] in UNITS and 0 < full_scale < np.inf:
            return match[1], full_scale
    return "full scale", 1.0


def _read_arrays(path: Path, key: str | None) -> Contents:
    try:
        with path.open("rb") as file:  # closes the file that a lazy NPZ leaves open when it is damaged
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return contents_of(loaded, None, None, path)
            array = loaded[_chosen_key(loaded, key, path)]
            stated = {name: loaded[name] for name in (RATE_KEY, UNIT_KEY) if name in loaded}
            return contents_of(array, stated.get(RATE_KEY), stated.get(UNIT_KEY), path)
    except TextureError:
        raise
    except _ARRAY_ERRORS as error:
        raise TextureError(f"{path}: not an array of numbers in NumPy's format; save it again ({error})") from error


def _chosen_key(arrays: Mapping[str, Any], key: str | None, path: Path) -> str:
    names = [name for name in arrays if name not in (RATE_KEY, UNIT_KEY)]
    if key is None and SAMPLES_KEY in names:
        return SAMPLES_KEY
    if key is None and len(names) == 1:
        return names[0]
    if key is None or key not in names:
        problem = "choose an array with --key" if key is None else f"no array {key!r} to --key"
        more = f" and {len(names) - 10} more" if len(names) > 10 else ""
        raise TextureError(f"{path}: {problem}; there are {', '.join(names[:10]) or 'none'}{more}")
    return key


def contents_of(array: NDArray[Any], rate_hz: Any, unit: Any, path: Path) -> Contents:
    """Return the contents of an array of numbers (n,) or (n, channels), named `path` in errors."""
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2):
        raise TextureError(
            f"{path}: an array of type {array.dtype} and shape {array.shape}; "
            "store integers or floats of shape (samples,) or (samples, channels)"
        )
    full_scale: float | None = 1.0
    if array.dtype.kind != "f":
        # The range of longer or unsigned integers says nothing of the signal's.
        pcm = array.dtype.kind == "i" and array.dtype.itemsize <= 4
        full_scale = float(2 ** (8 * array.dtype.itemsize - 1)) if pcm else None
    samples = array.astype(np.float64, copy=False)
    stated_unit = None if unit is None else known_unit(str(unit), f"{path}: {UNIT_KEY}")
    columns = samples.reshape(-1, 1) if array.ndim == 1 else samples
    return Contents(columns, None if rate_hz is None else float(rate_hz), stated_unit, full_scale)


def _profile_of(table: Table, path: Path) -> Profile:
    if len(table.names) != 2 or POSITION_NAME not in table.names:
        raise TextureError(f"{path}: a height profile has two columns, such as position_um and height_um")
    position = table.names.index(POSITION_NAME)
    factors = []
    for name, unit in zip(table.names, table.units, strict=True):
        output_unit, factor = INPUT_UNITS.get(unit or "", ("", 0.0))
        if output_unit != "um":
            raise TextureError(f"{path}: column {name!r} must state a length: {name}_nm, {name}_um or {name}_mm")
        factors.append(factor)
    spacing = uniform_step(table.values[:, position], f"{path}: column of positions")
    heights_um = table.values[:, 1 - position] * factors[1 - position]
    return Profile(heights_um, spacing * factors[position], path.stem)
