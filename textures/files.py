"""Loads recordings and height profiles from files of every supported kind, and saves WAV files and profiles."""

import csv
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from numpy.typing import ArrayLike

from vibrocast.textures import apart, arguments, arrays, clips, hdf5, laboratory, mat, p1918, sound_files
from vibrocast.textures.axes import DFT321, REDUCTIONS, reduced
from vibrocast.textures.columns import Table, select, signal_of, table_of_frame
from vibrocast.textures.doubts import doubts_of
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import (
    FILE_UNITS,
    INPUT_UNITS,
    VOLTS,
    Contents,
    Recording,
    TextureError,
    known_unit,
    unusable,
)
from vibrocast.textures.sensitivity import EXAMPLES, parse
from vibrocast.textures.text import column_names, read_table, write_table
from vibrocast.textures.times import uniform_step

_log = logging.getLogger(__name__)

TEXT_SUFFIXES = (".csv", ".txt", ".tsv")
READERS_APART = {".mat": "mat", ".h5": "hdf5", ".hdf5": "hdf5"} | dict.fromkeys(laboratory.SUFFIXES, "laboratory")
"""Modules that read by a parser of another project, by the suffix of a file."""
KEYED_SUFFIXES = (".npz", *READERS_APART)
SUFFIXES = (*sound_files.FORMATS, *TEXT_SUFFIXES, ".npy", *KEYED_SUFFIXES, *clips.SUFFIXES)
SAVED_SUFFIXES = (".wav", ".csv", ".npy", ".mat", ".h5")
POSITION_NAME = "position"
MAX_SKIPPED_LINES = 1_000_000


@np.errstate(over="ignore", invalid="ignore")  # a Recording rejects what overflows
def load(  # noqa: PLR0913 - each is a fact that a file may not state
    path: str | Path,
    rate_hz: float | None = None,
    unit: str | None = None,
    full_scale: float | None = None,
    columns: str | int | Sequence[str | int] | None = None,
    reduce: str | None = None,
    key: str | None = None,
    hand_speed_mm_s: float | None = None,
    sensitivity: str | None = None,
    skip_lines: int = 0,
    resample: bool = False,
) -> Recording:
    """Load a recording from a file of one of SUFFIXES, an IEEE P1918.1.1 folder, or the folder of a bag of ROS 2.

    Give only what the file does not state.

    Args:
        path: The file, or the folder of an IEEE P1918.1.1 trace.
        rate_hz: Sample rate in Hz. A clip is rendered at 8000 Hz, or at this rate.
        unit: Unit of the values, one of INPUT_UNITS, such as "m/s^2" or "um".
        full_scale: Value, in `unit`, of 1.0 in the file, or of the largest number of its type in an array of integers.
            A plain WAV file needs it with every `unit` but "drive".
        columns: Names or numbers, from 1, of the channels to take: "x,z", or ["left", 3]. Three channels without names
            are "x", "y" and "z". Default: all channels; in a text file, the axes X, Y and Z, or else all columns that
            state a unit.
        reduce: Make one signal of three channels: "dft321" or "norm"; "none" keeps them. Default: "dft321" for a
            P1918.1.1 folder only.
        key: Name of the array, group, stream or topic in a file of one of KEYED_SUFFIXES.
        hand_speed_mm_s: Speed of the hand over a height profile, in mm/s.
        sensitivity: What the sensor gives for one unit of acceleration or length, such as "100mV/g" for a file in
            volts, or "256/g" for one in counts.
        skip_lines: How many lines at the start of a text file to pass over.
        resample: Whether to interpolate samples at equal steps from the uneven times of a text file, over gaps of up to
            a second too.

    Returns:
        The recording, in one of UNITS.

    Raises:
        TextureError: The file cannot be read or used; the message says what to do.
    """
    path = arguments.file_path("path", path)
    rate_hz = arguments.optional_number("rate_hz", rate_hz)
    full_scale = arguments.optional_number("full_scale", full_scale)
    hand_speed_mm_s = arguments.optional_number("hand_speed_mm_s", hand_speed_mm_s)
    chosen = names_of(columns)
    lines = arguments.whole_number("skip_lines", skip_lines, 0, MAX_SKIPPED_LINES)
    for name, text in (("unit", unit), ("reduce", reduce), ("key", key), ("sensitivity", sensitivity)):
        arguments.of_type(name, text, str, "text")
    with _errors_of_system(path):
        contents = read_contents(path, rate_hz, chosen, reduce, key, lines, resample)
    if isinstance(contents, Profile):
        given = any(option is not None for option in (rate_hz, unit, full_scale, columns, reduce))
        return _under_a_hand(contents, hand_speed_mm_s, given, path)
    if hand_speed_mm_s is not None:
        raise unusable(
            path, "no height profile (columns position_um, height_um)", "leave out `hand_speed_mm_s`", "hand_speed_mm_s"
        )
    if rate_hz is None:
        rate_hz = contents.rate_hz
    elif contents.rate_hz not in (None, rate_hz):
        raise unusable(path, f"states {contents.rate_hz:g} Hz", f"leave out `rate_hz`={rate_hz:g}", "rate_hz")
    if rate_hz is None:
        raise unusable(path, "does not state its sample rate", "give `rate_hz`", "rate_hz")
    output_unit, scale = _scale(contents, unit, full_scale, path, sensitivity)
    samples = contents.samples
    if scale != 1:
        samples *= scale
    drive = (unit or contents.unit) == "drive"
    # An error in the samples names the path; the recording has the file's name.
    checked = Recording(samples, rate_hz, output_unit, str(path), contents.axes, drive)
    notes = contents.notes if drive else (*contents.notes, *doubts_of(checked))
    for note in () if path.suffix.lower() in clips.SUFFIXES else notes:  # `convert` prints those of a clip
        _log.warning(note)
    return replace(checked, name=path.stem if path.is_file() else path.name, notes=notes)


def load_for_actuators(
    path: str | Path, reduce: str | None = None, columns: str | Sequence[str | int] | None = None, **options: Any
) -> Recording:
    """Load a recording as `load` does, where each channel gets its own actuator.

    Raises TextureError also if the channels are the axes of one texture, unless `reduce` or `columns` say so.
    """
    recording = load(path, reduce=reduce, columns=columns, **options)
    if recording.axes and reduce is None and columns is None:
        raise unusable(
            path,
            "three axes of one texture",
            "pass `reduce` dft321 or norm, or choose `columns`, such as z, or x,y,z for an actuator for each axis",
            "columns",
            "reduce",
        )
    return recording


def from_array(
    samples: ArrayLike,
    rate_hz: float | None,
    unit: str | None,
    name: str = "samples",
    columns: str | int | Sequence[str | int] | None = None,
) -> Recording:
    """Return samples (n,) or (n, channels), integers or floats of any size, as a recording.

    A DataFrame of pandas or Polars is a table with column names, as a text file is. `rate_hz`, `unit` (one of
    INPUT_UNITS), `columns`: as for a file in `load`; without a unit, the samples are in "full scale".
    Raises TextureError.
    """
    chosen, path = names_of(columns), Path(name)
    table = None
    try:
        if hasattr(samples, "columns"):
            table = table_of_frame(samples)
        else:
            array = np.asarray(samples)
    except ValueError as error:
        raise TextureError(f"{name}: no array of numbers ({error}); pass shape (n,) or (n, channels)") from error
    contents = signal_of(table, path, rate_hz, chosen) if table else arrays.contents_of(array, path)
    if chosen and not table:
        contents = select(contents, chosen, path)
    rate_hz = rate_hz or contents.rate_hz
    if rate_hz is None:
        raise TextureError("`rate_hz` is missing", action="pass the sample rate of the samples", parameter="rate_hz")
    if unit is None and contents.unit is None:
        unit = "full scale"
    output_unit, scale = _scale(contents, unit, None, path)
    return Recording(contents.samples * scale, rate_hz, output_unit, name, contents.axes, notes=contents.notes)


def load_profile(path: str | Path) -> Profile:
    """Load a height profile from a CSV or TXT file with columns such as position_um and height_um.

    Raises:
        TextureError: The file cannot be read or used; the message says what to do.
    """
    path = arguments.file_path("path", path)
    if path.suffix.lower() not in TEXT_SUFFIXES:
        raise TextureError(f"{path}: a height profile is saved as {', '.join(TEXT_SUFFIXES)}")
    with _errors_of_system(path):
        return _profile_of(read_table(path), path)


def is_profile(path: Path) -> bool:
    """Return whether a file names a column of positions, as a height profile does. Raises TextureError, OSError."""
    return path.suffix.lower() in TEXT_SUFFIXES and path.is_file() and POSITION_NAME in (column_names(path) or ())


def save_profile(path: str | Path, profile: Profile) -> None:
    """Save a height profile as CSV of position_um and height_um, to a nanometre of height. Raises OSError."""
    positions_um = profile.spacing_um * np.arange(len(profile.heights_um))
    columns = np.column_stack([positions_um, profile.heights_um])
    names = "position_um,height_um"
    np.savetxt(path, columns, fmt=("%.10g", "%.3f"), delimiter=",", header=names, comments="")


def save(path: str | Path, recording: Recording, sixteen_bit: bool = False, note: str = "") -> float:
    """Save a recording in the format of the suffix, one of SAVED_SUFFIXES; return its full scale.

    - WAV holds 32-bit floats or, if `sixteen_bit`, 16-bit integers, with the unit in its comment.
    - CSV (rate, unit and axes in its first lines), NPY and MAT (version 5: `samples`, `rate_hz`, `unit`) hold float64
      exactly. `load` finds rate and unit again, except in NPY, which holds only samples (n, channels).

    Full scale is the value of 1.0 in the file, in the recording's unit. It is 1, except with `sixteen_bit`: then it is
    the largest magnitude, or 1 for a signal in "full scale" that fits. `note` goes into the comment of a WAV file, for
    people. Raises TextureError if the format cannot hold the recording, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SAVED_SUFFIXES:
        raise TextureError(f"{path}: recordings are saved as {', '.join(SAVED_SUFFIXES)}; give one of these suffixes")
    if sixteen_bit and suffix != ".wav":
        raise unusable(path, "`sixteen_bit` is for a .wav file", "leave it out here", "sixteen_bit")
    try:
        if suffix == ".wav":
            return sound_files.write(path, recording, sixteen_bit, note)
        if suffix == ".csv":
            write_table(path, recording)
        elif suffix == ".mat":
            mat.write(path, recording)
        elif suffix == ".h5":
            hdf5.write(path, recording)
        else:
            with path.open("wb") as file:
                np.save(file, recording.samples)
    except (OSError, soundfile.SoundFileError) as error:
        # libsndfile does not say what was wrong.
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise TextureError(f"{path}: cannot be written ({reason}); free some space, or write elsewhere") from error
    return 1.0


def read_contents(
    path: Path,
    rate_hz: float | None = None,
    columns: Sequence[str] | None = None,
    reduce: str | None = None,
    key: str | None = None,
    skip_lines: int = 0,
    resample: bool = False,
) -> Contents | Profile:
    """Read the contents of a file, or of a P1918.1.1 recording; options as for `load`. Raises TextureError."""
    is_ros = laboratory.is_ros_folder(path)
    if reduce is not None and reduce not in REDUCTIONS:
        raise TextureError(f"`reduce`={reduce}", f"not one of {', '.join(REDUCTIONS)}", parameter="reduce")
    if key is not None and path.suffix.lower() not in KEYED_SUFFIXES and not is_ros:
        raise unusable(
            path, f"`key` chooses an array of a {', '.join(KEYED_SUFFIXES)} file", "leave it out here", "key"
        )
    if not is_ros and (path.is_dir() or not path.exists()):
        contents = p1918.read_folder(path, columns, rate_hz)
        return reduced(contents, reduce or (None if columns else DFT321), path)
    if not is_ros and not path.is_file():
        raise TextureError(f"{path}: not a file; give a recording")
    suffix = path.suffix.lower()
    if is_ros or suffix not in TEXT_SUFFIXES:
        found = apart.read("laboratory", path, key, rate_hz) if is_ros else _read_binary(path, suffix, rate_hz, key)
        if isinstance(found, Table):
            return reduced(signal_of(found, path, rate_hz, columns, resample), reduce, path)
        return reduced(select(found, columns, path) if columns else found, reduce, path)
    table = read_table(path, skip_lines)
    if POSITION_NAME in table.words:
        return _profile_of(table, path)
    own_axis = p1918.axis_of(path) if len(table.names) == 1 else None
    if own_axis and (reduce or (columns and [each.upper() for each in columns] not in ([own_axis], ["1"]))):
        raise unusable(
            path,
            f"holds axis {own_axis}",
            f"for other `columns`, or `reduce`, give {path.with_name(path.stem[:-2])}",
            "columns",
            "reduce",
        )
    contents = signal_of(table, path, rate_hz, None if own_axis else columns, resample)
    return reduced(p1918.with_known_rate(contents, path), reduce, path)


def names_of(columns: str | int | Sequence[str | int] | None) -> list[str] | None:
    """Return the names or numbers of columns, given as one or as several, as texts. Raises TextureError."""
    if columns is None:
        return None
    if isinstance(columns, str):
        columns = next(csv.reader([columns], skipinitialspace=True), [])
    given = [columns] if isinstance(columns, int) else list(columns)
    if not given or not all(isinstance(each, str | int) and str(each).strip() for each in given):
        raise TextureError("`columns` names none", action='pass names or numbers, such as "x,z"', parameter="columns")
    return [str(each).strip() for each in given]


def _read_binary(path: Path, suffix: str, rate_hz: float | None, key: str | None) -> Contents | Table:
    if suffix in sound_files.FORMATS:
        return sound_files.read(path)
    if suffix in clips.SUFFIXES:
        return clips.read(path, rate_hz)
    if suffix in READERS_APART:
        return apart.read(READERS_APART[suffix], path, key, rate_hz)
    if suffix in SUFFIXES:
        return arrays.read(path, key, rate_hz)
    raise TextureError(f"{path}: unknown kind of file; known are {', '.join(SUFFIXES)}")


@contextmanager
def _errors_of_system(path: Path) -> Iterator[None]:
    """Turn an OSError and a MemoryError into a TextureError."""
    try:
        yield
    except OSError as error:
        raise TextureError(
            f"{path}: cannot be read: {error.strerror or error}; check the name and your permissions"
        ) from error
    except MemoryError as error:
        raise TextureError(f"{path}: too large for the memory of this machine; cut it into parts") from error


def _scale(
    contents: Contents, unit: str | None, full_scale: float | None, path: Path, sensitivity: str | None = None
) -> tuple[str, float]:
    """Return the unit of UNITS, and the factor that turns the file's numbers into it."""
    given = None if unit is None else known_unit(unit, "`unit`", FILE_UNITS)
    relative = ("full scale", "drive")
    if full_scale is not None and not (np.isfinite(full_scale) and full_scale > 0):
        raise TextureError(f"`full_scale`={full_scale}", "not positive", "give a number above 0", "full_scale")
    if contents.unit not in (None, *relative) and (given not in (None, contents.unit) or full_scale is not None):
        instead = ", and give the sensor's `sensitivity`" if contents.unit in VOLTS else ""
        raise unusable(
            path,
            f"states its unit, {contents.unit}",
            f"leave out `unit` and `full_scale`{instead}",
            "unit",
            "full_scale",
            "sensitivity",
        )
    if contents.unit in relative and given not in (None, *relative) and full_scale is None:
        raise unusable(
            path, "is relative to full scale", f"give `full_scale` too, the value of 1.0 in {given}", "full_scale"
        )
    chosen = given or contents.unit
    if sensitivity is not None or chosen in VOLTS:
        unit, factor = _of_sensor(chosen, path, sensitivity)
        return unit, factor if full_scale is None else factor * full_scale / (contents.full_scale or 1.0)
    if chosen is None:
        raise unusable(
            path,
            "does not state its unit",
            f"give `unit`, one of {', '.join(FILE_UNITS)}; for counts of a sensor, `sensitivity`, such as 256/g",
            "unit",
            "sensitivity",
        )
    output_unit, factor = INPUT_UNITS[chosen]
    if output_unit == "full scale" and full_scale is not None:
        raise unusable(
            path, "`full_scale` is a physical value", "give its `unit` too, such as m/s^2", "full_scale", "unit"
        )
    if output_unit != "full scale" and full_scale is None:
        return output_unit, factor
    if contents.full_scale is None:
        raise TextureError(f"{path}: its type of integers states no full scale; store them as int16, int32 or float")
    return output_unit, factor * (full_scale or 1.0) / contents.full_scale


def _of_sensor(unit: str | None, path: Path, sensitivity: str | None) -> tuple[str, float]:
    """Return the unit of UNITS, and the factor that turns volts or counts into it."""
    if sensitivity is None:
        raise unusable(path, f"is in {unit}", f"give the sensor's `sensitivity`, such as {EXAMPLES}", "sensitivity")
    sensor = parse(sensitivity)
    volts = sensor.in_volts
    if volts != (unit in VOLTS) or (unit and not volts):
        raise unusable(
            path,
            f"is in {unit or 'an unknown unit'}, and `sensitivity`={sensitivity} in {'volts' if volts else 'counts'}",
            f"give `unit`, one of {', '.join(VOLTS)}" if unit is None else "correct one of them, or leave it out",
            "sensitivity",
            "unit",
        )
    return sensor.unit, VOLTS.get(unit or "", 1.0) / sensor.per_unit


def _under_a_hand(profile: Profile, hand_speed_mm_s: float | None, others_given: bool, path: Path) -> Recording:
    """Return the recording that a hand's speed makes of a profile. `others_given`: whether there are other options."""
    if hand_speed_mm_s is None:
        raise unusable(
            path, "a height profile", "give `hand_speed_mm_s`, the speed of the hand over it", "hand_speed_mm_s"
        )
    if others_given:
        raise unusable(path, "a height profile in um", "give `hand_speed_mm_s` and no other option", "hand_speed_mm_s")
    return profile.recording(hand_speed_mm_s)


def _profile_of(table: Table, path: Path) -> Profile:
    if len(table.names) != 2 or POSITION_NAME not in table.words:
        raise TextureError(f"{path}: a height profile has two columns, such as position_um and height_um")
    position = table.words.index(POSITION_NAME)
    factors = []
    for name, unit in zip(table.names, table.units, strict=True):
        output_unit, factor = INPUT_UNITS.get(unit or "", ("", 0.0))
        if output_unit != "um":
            raise TextureError(f"{path}: column {name!r} must state a length: {name}_nm, {name}_um or {name}_mm")
        factors.append(factor)
    spacing = uniform_step(table.values[:, position], f"{path}: column of positions", table.lines)
    heights_um = table.values[:, 1 - position] * factors[1 - position]
    return Profile(heights_um, spacing * factors[position], path.stem)
