"""Loads recordings and height profiles from files of every supported kind, and saves WAV files and profiles."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from numpy.typing import ArrayLike

from vibrocast.textures import apart, arguments, arrays, clips, hdf5, laboratory, mat, p1918, wav
from vibrocast.textures.axes import AXES, DFT321, REDUCTIONS, reduced
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import INPUT_UNITS, Contents, Recording, TextureError, unusable
from vibrocast.textures.text import Table, column_names, known_unit, read_table, signal_of, uniform_step, write_table

TEXT_SUFFIXES = (".csv", ".txt", ".tsv")
READERS_APART = {".mat": "mat", ".h5": "hdf5", ".hdf5": "hdf5"} | dict.fromkeys(laboratory.SUFFIXES, "laboratory")
"""Modules that read by a parser of another project, by the suffix of a file."""
KEYED_SUFFIXES = (".npz", *READERS_APART)
SUFFIXES = (*wav.FORMATS, *TEXT_SUFFIXES, ".npy", *KEYED_SUFFIXES, *clips.SUFFIXES)
SAVED_SUFFIXES = (".wav", ".csv", ".npy", ".mat", ".h5")
POSITION_NAME = "position"


@np.errstate(over="ignore", invalid="ignore")  # a Recording rejects what overflows
def load(
    path: str | Path,
    rate_hz: float | None = None,
    unit: str | None = None,
    full_scale: float | None = None,
    axis: str | None = None,
    reduce: str | None = None,
    key: str | None = None,
    hand_speed_mm_s: float | None = None,
) -> Recording:
    """Load a recording from a file of one of SUFFIXES, an IEEE P1918.1.1 folder, or the folder of a bag of ROS 2.

    Give only what the file does not state.

    Args:
        path: The file, or the folder of an IEEE P1918.1.1 trace.
        rate_hz: Sample rate in Hz. A clip is rendered at 8000 Hz, or at this rate.
        unit: Unit of the values, one of INPUT_UNITS, such as "m/s^2" or "um".
        full_scale: Value, in `unit`, of 1.0 in the file, or of the largest number of its type in an array of integers.
            A plain WAV file needs it with every `unit` but "drive".
        axis: Take one of three channels: "X", "Y" or "Z".
        reduce: Make one signal of three channels: "dft321" or "norm"; "none" keeps them. Default: "dft321" for a
            P1918.1.1 folder only.
        key: Name of the array, group, stream or topic in a file of one of KEYED_SUFFIXES.
        hand_speed_mm_s: Speed of the hand over a height profile, in mm/s.

    Returns:
        The recording, in one of UNITS.

    Raises:
        TextureError: The file cannot be read or used; the message says what to do.
    """
    path = arguments.file_path("path", path)
    rate_hz = arguments.optional_number("rate_hz", rate_hz)
    full_scale = arguments.optional_number("full_scale", full_scale)
    hand_speed_mm_s = arguments.optional_number("hand_speed_mm_s", hand_speed_mm_s)
    for name, text in (("unit", unit), ("axis", axis), ("reduce", reduce), ("key", key)):
        arguments.of_type(name, text, str, "text")
    if axis is not None and axis.upper() not in AXES:
        raise TextureError(
            f"`axis`={axis}",
            f"not one of {', '.join(AXES)}",
            "for one signal of all three give `reduce`",
            parameter=("axis", "reduce"),
        )
    if reduce is not None and reduce not in REDUCTIONS:
        raise TextureError(f"`reduce`={reduce}", f"not one of {', '.join(REDUCTIONS)}", parameter="reduce")
    if axis is not None and reduce is not None:
        raise TextureError(f"`axis`={axis} and `reduce`={reduce}: give only one of them", parameter=("axis", "reduce"))
    if key is not None and path.suffix.lower() not in KEYED_SUFFIXES and not laboratory.is_ros_folder(path):
        raise unusable(
            path, f"`key` chooses an array of a {', '.join(KEYED_SUFFIXES)} file", "leave it out here", "key"
        )
    try:
        contents = read_contents(path, rate_hz, axis and axis.upper(), reduce, key)
    except OSError as error:
        raise TextureError(
            f"{path}: cannot be read: {error.strerror or error}; check the name and your permissions"
        ) from error
    except MemoryError as error:
        raise TextureError(f"{path}: too large for the memory of this machine; cut it into parts") from error
    if isinstance(contents, Profile):
        if hand_speed_mm_s is None:
            raise unusable(
                path, "a height profile", "give `hand_speed_mm_s`, the speed of the hand over it", "hand_speed_mm_s"
            )
        if any(option is not None for option in (rate_hz, unit, full_scale, axis, reduce)):
            raise TextureError(
                f"{path}: a height profile in um; it takes `hand_speed_mm_s` and no other option",
                parameter="hand_speed_mm_s",
            )
        return contents.recording(hand_speed_mm_s)
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
    output_unit, scale = _scale(contents, unit, full_scale, path)
    samples = contents.samples
    if scale != 1:
        samples *= scale
    drive = (unit or contents.unit) == "drive"
    # An error in the samples names the path; the recording has the file's name.
    checked = Recording(samples, rate_hz, output_unit, str(path), contents.axes, drive, contents.notes)
    return replace(checked, name=path.stem if path.is_file() else path.name)


def load_for_actuators(path: str | Path, reduce: str | None = None, **options: Any) -> Recording:
    """Load a recording as `load` does, where each channel gets its own actuator.

    Raises TextureError also if the channels are the axes of one texture, unless `reduce` is "none".
    """
    recording = load(path, reduce=reduce, **options)
    if recording.axes and reduce is None:
        raise unusable(
            path,
            "three axes of one texture",
            "pass `reduce` dft321, norm or none (one actuator for each axis), or choose one axis with `axis`",
            "axis",
            "reduce",
        )
    return recording


def from_array(
    samples: ArrayLike, rate_hz: float, unit: str, full_scale: float | None = None, name: str = "samples"
) -> Recording:
    """Return samples (n,) or (n, channels), integers or floats of any size, as a recording.

    `rate_hz`, `unit` (one of INPUT_UNITS), `full_scale`: as for an NPY file in `load`. Raises TextureError.
    """
    try:
        array = np.asarray(samples)
    except ValueError as error:
        raise TextureError(f"{name}: no array of numbers ({error}); pass shape (n,) or (n, channels)") from error
    contents = arrays.contents_of(array, Path(name))
    output_unit, scale = _scale(contents, unit, full_scale, Path(name))
    return Recording(contents.samples * scale, rate_hz, output_unit, name)


def load_profile(path: str | Path) -> Profile:
    """Load a height profile from a CSV or TXT file with columns such as position_um and height_um.

    Raises:
        TextureError: The file cannot be read or used; the message says what to do.
    """
    path = arguments.file_path("path", path)
    if path.suffix.lower() not in TEXT_SUFFIXES:
        raise TextureError(f"{path}: a height profile is saved as {', '.join(TEXT_SUFFIXES)}")
    try:
        return _profile_of(read_table(path), path)
    except OSError as error:
        raise TextureError(
            f"{path}: cannot be read: {error.strerror or error}; check the name and your permissions"
        ) from error


def is_profile(path: Path) -> bool:
    """Return whether a file names a column of positions, as a height profile does. Raises TextureError, OSError."""
    return path.suffix.lower() in TEXT_SUFFIXES and path.is_file() and POSITION_NAME in column_names(path)


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
            return wav.write(path, recording, sixteen_bit, note)
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
    path: Path, rate_hz: float | None, axis: str | None, reduce: str | None, key: str | None
) -> Contents | Profile:
    """Read the contents of a file, or of a P1918.1.1 recording; options as for `load`. Raises TextureError."""
    if laboratory.is_ros_folder(path):
        return reduced(apart.read("laboratory", path, key, rate_hz), axis, reduce, path)
    if path.is_dir() or not path.exists():
        contents = p1918.read_folder(path, axis, rate_hz)
        return contents if axis else reduced(contents, None, reduce or DFT321, path)
    if not path.is_file():
        raise TextureError(f"{path}: not a file; give a recording")
    suffix = path.suffix.lower()
    if suffix not in TEXT_SUFFIXES:
        return reduced(_read_binary(path, suffix, rate_hz, key), axis, reduce, path)
    table = read_table(path)
    if POSITION_NAME in table.names:
        return _profile_of(table, path)
    contents = p1918.with_known_rate(signal_of(table, path, rate_hz), path)
    own_axis = p1918.axis_of(path)
    if own_axis is None:
        return reduced(contents, axis, reduce, path)
    if axis in (None, own_axis) and reduce is None:
        return contents
    choice = f"`axis`={axis}" if axis else f"`reduce`={reduce}"
    raise unusable(
        path, f"holds axis {own_axis}", f"for {choice} give {path.with_name(path.stem[:-2])}", "axis", "reduce"
    )


def _read_binary(path: Path, suffix: str, rate_hz: float | None, key: str | None) -> Contents:
    if suffix in wav.FORMATS:
        return wav.read(path)
    if suffix in clips.SUFFIXES:
        return clips.read(path, rate_hz)
    if suffix in READERS_APART:
        return apart.read(READERS_APART[suffix], path, key, rate_hz)
    if suffix in SUFFIXES:
        return arrays.read(path, key, rate_hz)
    raise TextureError(f"{path}: unknown kind of file; known are {', '.join(SUFFIXES)}")


def _scale(contents: Contents, unit: str | None, full_scale: float | None, path: Path) -> tuple[str, float]:
    """Return the unit of UNITS, and the factor that turns the file's numbers into it."""
    given = None if unit is None else known_unit(unit, "`unit`")
    relative = ("full scale", "drive")
    if full_scale is not None and not (np.isfinite(full_scale) and full_scale > 0):
        raise TextureError(f"`full_scale`={full_scale}", "not positive", "give a number above 0", "full_scale")
    if contents.unit not in (None, *relative) and (given not in (None, contents.unit) or full_scale is not None):
        raise unusable(
            path, f"states its unit, {contents.unit}", "leave out `unit` and `full_scale`", "unit", "full_scale"
        )
    if contents.unit in relative and given not in (None, *relative) and full_scale is None:
        raise unusable(
            path, "is relative to full scale", f"give `full_scale` too, the value of 1.0 in {given}", "full_scale"
        )
    chosen = given or contents.unit
    if chosen is None:
        raise unusable(path, "does not state its unit", f"give `unit`, one of {', '.join(INPUT_UNITS)}", "unit")
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
