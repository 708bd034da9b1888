"""What the arguments of several subcommands have in common: their types, groups of options, the error of bad input."""

import functools
import math
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import click

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import DEFAULT_SNR_DB, DEFAULT_STREAM_RATE_HZ
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.device_protocol.model_image import ModelImageError
from vibrocast.host import devices
from vibrocast.host.cli.exit_codes import BAD_INPUT


def command_run() -> str:
    """Return the command as it was given, with an escape in place of each byte that is no character."""
    return shlex.join(["vibrocast", *sys.argv[1:]]).encode(errors="backslashreplace").decode()


class BadInput(click.ClickException):
    """What was given cannot be used."""

    exit_code = BAD_INPUT


class OutputFile(click.Path):
    """A file to write: rejected before any work is done when it cannot be written."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)
        self.suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path, or raise click.BadParameter with what to do."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if not path.parent.is_dir():
            self.fail(f"{path}: the folder {path.parent} does not exist; make it first", param, ctx)
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            self.fail(f"{path}: the name must end in {' or '.join(self.suffixes)}", param, ctx)
        return path


class Finite(click.FloatRange):
    """A number in a range, infinity and NaN rejected."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, or raise click.BadParameter."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


def chosen_model(ctx: click.Context, param: click.Parameter, value: str | None) -> models.Model | None:
    """Return the model of that name, folder or image file, or raise click.BadParameter with what to do."""
    try:
        return None if value is None else models.find(value)
    except (models.ModelError, ModelImageError) as error:
        raise click.BadParameter(str(error), ctx, param) from error


def parsed_setting(ctx: click.Context, param: click.Parameter, values: Sequence[str]) -> dict[str, str]:
    """Return a codec's parameters by name, or raise click.BadParameter."""
    setting: dict[str, str] = {}
    for text in values:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise click.BadParameter(f"{text!r} is not of the form NAME=VALUE.", ctx, param)
        if name in setting:
            raise click.BadParameter(f"{name} is given twice.", ctx, param)
        setting[name] = value
    return setting


def checked_address(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """Return a controller's address as `host.devices.connect` takes it, or raise click.BadParameter."""
    if value not in devices.SIMULATED and not devices.ADDRESS.fullmatch(value):
        known = ", ".join(devices.SIMULATED)
        raise click.BadParameter(
            f"{value!r} is none of {known}, serial:PORT and usb:VID:PID (in hexadecimal digits).", ctx, param
        )
    return value


def checked_addresses(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> tuple[str, ...]:
    """Return addresses as `checked_address` does; raise click.BadParameter for a port that is given twice."""
    for value in values:
        if values.count(checked_address(ctx, param, value)) > 1 and value not in devices.SIMULATED:
            raise click.BadParameter(f"{value} is given twice: a port has one controller.", ctx, param)
    return values


def grouped(name: str, kind: type[Any], *decorators: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Return one decorator for a group of options, which the command takes as `name`, a dataclass of this kind."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def with_group(*arguments: Any, **values: Any) -> Any:
            group = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
            return command(*arguments, **values, **{name: group})

        decorated: Callable[..., Any] = with_group
        for decorator in reversed(decorators):
            decorated = decorator(decorated)
        return decorated

    return decorate


POSITIVE = Finite(min=0, min_open=True)
INPUT = click.Path(path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)

_ADDRESSES = f"{', '.join(devices.SIMULATED)}, serial:PORT or usb:VID:PID; `vibrocast devices` lists them."
device_option = click.option(
    "--device", "address", callback=checked_address, default="sim", show_default=True, help=_ADDRESSES
)
devices_option = click.option(
    "--device",
    "addresses",
    callback=checked_addresses,
    multiple=True,
    default=("sim",),
    show_default=True,
    help=f"{_ADDRESSES} Repeat it for several controllers at once.",
)

model_option = click.option(
    "--model",
    callback=chosen_model,
    metavar="NAME|FOLDER|IMAGE",
    help="A trained model that `vibrocast models` lists, a folder that `vibrocast export` wrote, or a model image.",
)
own_models_option = click.option(
    "--models",
    "model_folders",
    type=INPUT,
    multiple=True,
    help="Add a model of your own: a folder that `vibrocast export` wrote; may be repeated.",
)
codec_option = click.option(
    "--codec",
    "codec_name",
    type=click.Choice(sorted(codec.CODECS)),
    help=f"That of --model if not given, else {codec.DEFAULT_CODEC}.",
)
setting_option = click.option(
    "--setting",
    callback=parsed_setting,
    multiple=True,
    metavar="NAME=VALUE",
    help="Parameter of the codec, instead of searching for it; `vibrocast codecs` lists them.",
)

plan_option = click.option(
    "--plan", "plan_path", type=INPUT, help="Plan file, as `vibrocast plan` writes it: it says how, and where."
)


@dataclass(frozen=True)
class RecordingOptions:
    """What the file of a recording leaves open, as `textures.load` takes it; None where it is not given."""

    rate_hz: float | None
    unit: str | None
    full_scale: float | None
    axis: str | None
    reduce: str | None
    key: str | None
    hand_speed_mm_s: float | None


recording_options = grouped(
    "recording",
    RecordingOptions,
    click.option("--rate-hz", type=POSITIVE, help="Give the sample rate, if the file does not state it."),
    click.option(
        "--unit",
        type=click.Choice(list(textures.INPUT_UNITS)),
        help="Give the unit, if the file does not state it; drive: the actuator's drive signal.",
    ),
    click.option("--full-scale", type=POSITIVE, help="Give the value, in --unit, of 1.0 in a WAV file."),
    click.option(
        "--axis",
        type=click.Choice(textures.AXES, case_sensitive=False),
        help="Take one axis of a three-axis recording.",
    ),
    click.option(
        "--reduce",
        type=click.Choice(textures.REDUCTIONS),
        help="Make one signal of three axes, or keep them. Default: dft321 for P1918.1.1 traces only.",
    ),
    click.option("--key", help="Choose an array of an NPZ, MAT or HDF5 file."),
    click.option("--hand-speed-mm-s", type=POSITIVE, help="Give the speed of the hand over a height profile."),
)

runtime_option = click.option(
    "--runtime",
    type=click.Choice(codec.RUNTIMES),
    help="Decode by the integer core or by ONNX Runtime, where the model can be decoded by either; else as it says.",
)
keep_dc_option = click.option(
    "--keep-dc", is_flag=True, help=f"Code the band below {textures.HIGHPASS_HZ:g} Hz too: offset, gravity, drift."
)


@dataclass(frozen=True)
class QualityOptions:
    """How a recording is coded."""

    codec_name: str | None
    rate_bps: float | None
    snr_db: float | None
    stream_rate_hz: int
    keep_dc: bool
    setting: codec.Setting
    model: models.Model | None

    def arguments(self, unit: str | None = None) -> dict[str, Any]:
        """Return the arguments of `encode_recording` for a recording in a unit. Raises click.UsageError."""
        if self.rate_bps is not None and self.snr_db is not None:
            raise click.UsageError("--rate-bps and --snr-db exclude each other: give one of them.")
        arguments = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "keep_dc"}
        return {**arguments, "highpass_hz": chosen_highpass_hz(self.keep_dc, unit)}


quality_options = grouped(
    "quality",
    QualityOptions,
    codec_option,
    click.option("--rate-bps", type=POSITIVE, help="Size of the whole coded file, in bits per second of signal."),
    click.option("--snr-db", type=Finite(), help=f"Signal-to-noise ratio; {DEFAULT_SNR_DB:g} if neither is given."),
    click.option(
        "--stream-rate-hz",
        type=click.IntRange(1, MAX_RATE_HZ),
        default=DEFAULT_STREAM_RATE_HZ,
        show_default=True,
        help="Sample rate of the coded stream.",
    ),
    keep_dc_option,
    setting_option,
    model_option,
)


def chosen_highpass_hz(keep_dc: bool, unit: str | None) -> float | None:
    """Return the corner of the high-pass before coding a recording in a unit, None = no high-pass."""
    return textures.highpass_of(unit, None if keep_dc else textures.HIGHPASS_HZ)
