"""Options that several subcommands share, and how they are read."""

import functools
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import DEFAULT_SNR_DB, DEFAULT_STREAM_RATE_HZ
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.device_protocol.messages import ActuatorDescription
from vibrocast.errors import LIMIT_MISSED
from vibrocast.host import devices
from vibrocast.host.cli.answers import wants_json
from vibrocast.host.cli.errors import CommandError
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, positive
from vibrocast.host.cli.sections import CODING, section
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.output import actuator_files
from vibrocast.output.actuator import Actuator

if TYPE_CHECKING:
    from vibrocast.host.bench_file import Bench

_BENCH = "vibrocast.bench"


def command_run() -> str:
    """Return the command as it was given, with an escape in place of each byte that is no character."""
    return shlex.join(["vibrocast", *sys.argv[1:]]).encode(errors="backslashreplace").decode()


def fail_where_missed(missed: Sequence[str]) -> None:
    """Raise CommandError with the lines of `bench_limits.missed`, if there are any."""
    if missed:
        raise CommandError(f"limits missed: {'; '.join(missed)}; see [limits] in the bench file", LIMIT_MISSED)


def chosen_model(ctx: click.Context, param: click.Parameter, value: str | None) -> models.Model | None:
    """Return the model of that name, folder or image file, or raise click.BadParameter with what to do."""
    try:
        return None if value is None else models.find(value)
    except models.ModelError as error:
        raise click.BadParameter(str(error), ctx, param) from error


def parsed_setting(ctx: click.Context, param: click.Parameter, values: Sequence[str]) -> dict[str, str]:
    """Return a codec's parameters by name, or raise click.BadParameter."""
    setting: dict[str, str] = {}
    for text in values:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise click.BadParameter(f"{text!r} names no parameter and value; write NAME=VALUE", ctx, param)
        if name in setting:
            raise click.BadParameter(f"{name} is given twice; keep one", ctx, param)
        setting[name] = value
    return setting


def chosen_bench(ctx: click.Context, param: click.Parameter, value: Path | None) -> "Bench | None":
    """Return the bench of a file, and let `chosen_controller` take the names of its controllers."""
    if value is None:
        return None
    from vibrocast.host.bench_file import read_bench

    # No command with this option starts a sensor's program.
    bench = ctx.meta[_BENCH] = read_bench(value, allow_programs=True)
    return bench


@dataclass(frozen=True)
class Chosen:
    """A controller that --device chooses. `name`: in the bench file; None = not there."""

    address: str
    name: str | None = None


def chosen_controller(ctx: click.Context, param: click.Parameter, value: str) -> Chosen:
    """Return a controller by its name in the bench file or its address, or raise click.BadParameter.

    The first controller of the bench file is the default, and the first one at an address counts.
    """
    if bench := ctx.meta.get(_BENCH):
        if ctx.get_parameter_source(param.name or "") == ParameterSource.DEFAULT:
            return Chosen(bench.first.address, bench.first.name)
        for key in ("name", "address"):
            for each in bench.controllers:
                if getattr(each, key) == value:
                    return Chosen(each.address, each.name)
    return Chosen(checked_address(ctx, param, value))


def chosen_controllers(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> tuple[Chosen, ...]:
    """Return controllers as `chosen_controller` does; raise click.BadParameter for a port that is given twice."""
    chosen = tuple(chosen_controller(ctx, param, value) for value in values)
    addresses = [each.address for each in chosen]
    for address in addresses:
        if addresses.count(address) > 1 and address not in devices.SIMULATED:
            raise click.BadParameter(f"{address} is given twice, and a port has one controller; keep one", ctx, param)
    return chosen


def checked_address(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """Return a controller's address as `host.devices.connect` takes it, or raise click.BadParameter."""
    if value not in devices.SIMULATED and not devices.ADDRESS.fullmatch(value):
        raise click.BadParameter(
            f"{value!r} is no address; give {', '.join(devices.SIMULATED)}, {devices.FORMS}",
            ctx,
            param,
        )
    return value


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


bench_option = click.option(
    "--bench",
    "bench",
    type=INPUT,
    callback=chosen_bench,
    is_eager=True,
    metavar="FILE",
    help="Take controllers, actuators and limits from a bench file.",
)
device_option = click.option(
    "--device",
    "address",
    callback=checked_address,
    metavar="ADDRESS",
    default="sim",
    show_default=True,
    help="Choose the controller; `vibrocast devices` lists the addresses.",
)
bench_device_option = click.option(
    "--device",
    "chosen",
    callback=chosen_controller,
    metavar="ADDRESS",
    default="sim",
    show_default=True,
    help="Choose the controller; `vibrocast devices` lists the addresses.",
)
devices_option = click.option(
    "--device",
    "chosen",
    callback=chosen_controllers,
    metavar="ADDRESS",
    multiple=True,
    default=("sim",),
    show_default=True,
    help="Choose the controller; repeat it to play on several.",
)

model_option = click.option(
    "--model",
    callback=chosen_model,
    metavar="NAME|FOLDER|FILE",
    help="Use a trained model; `vibrocast models` lists the shipped ones.",
)
own_models_option = click.option(
    "--models",
    "model_folders",
    type=INPUT,
    metavar="FOLDER",
    multiple=True,
    help="Add a model that `vibrocast export` wrote; may be repeated.",
)
codec_option = click.option(
    "--codec",
    "codec_name",
    type=click.Choice(sorted(codec.CODECS)),
    metavar="NAME",
    help=f"Choose a codec that `vibrocast codecs` lists. Default: that of --model, else {codec.DEFAULT_CODEC}.",
)
setting_option = click.option(
    "--setting",
    callback=parsed_setting,
    multiple=True,
    metavar="NAME=VALUE",
    help="Fix a parameter that `vibrocast codecs` lists; may be repeated.",
)

touch_option = click.option(
    "--touch",
    type=Number("strength from 0 to 1", 0, 1),
    help="Shape the error for touch: 0 = flat, 1 = by the threshold. "
    f"Default: {codec.DEFAULT_TOUCH:g} for physical units, if the codec can.",
)

actuator_option = click.option(
    "--actuator",
    "actuator_name",
    metavar="NAME|FILE",
    help="Choose the actuator of sim or of a sound card.",
)


def own_actuator(address: str, name: str | None) -> Actuator | None:
    """Return the actuator of `actuator_option` for a controller that takes one. Raises click.UsageError."""
    if name is not None and not devices.takes_actuator(address):
        raise click.UsageError(f"{address} has its actuator compiled in; drop --actuator")
    return None if name is None else actuator_files.find(name)


def bench_actuator(bench: "Bench | None", chosen: Chosen) -> Actuator | None:
    """Return the actuator that a bench has behind a controller; None = the bench says nothing of it."""
    return None if bench is None or chosen.name is None else bench.actuator(chosen.name)


def check_bench_actuator(bench: "Bench | None", chosen: Chosen, description: ActuatorDescription) -> None:
    """Raise InputError where a controller drives another actuator than the bench has there."""
    if bench is None:
        return
    from vibrocast.host.bench_file import check_actuator

    for each in bench.controllers:
        if each.name == chosen.name:
            check_actuator(bench, each, description)


link_option = click.option(
    "--link", type=OutputFile(), metavar="NAME", help="Name the port. Default: another one at each start."
)


def tell_address(port_name: str, err: bool = False) -> None:
    """Print the address of a port for other programs, at once. `err`: on stderr, where stdout is for something else."""
    address = f"serial:{port_name}"
    click.echo(json.dumps({"address": address}) if wants_json() else address, err=err)
    (sys.stderr if err else sys.stdout).flush()


allow_programs_option = click.option(
    "--allow-programs", is_flag=True, help="Let the file start programs; they can do whatever you can."
)


@dataclass(frozen=True)
class RecordingOptions:
    """Facts that the file of a recording may not state, as `textures.load` takes them; None = not given."""

    rate_hz: float | None
    unit: str | None
    full_scale: float | None
    axis: str | None
    reduce: str | None
    key: str | None
    hand_speed_mm_s: float | None


def recording_options_with(rate_option: str) -> Callable[[Callable[..., Any]], Any]:
    """Return the options of RecordingOptions, where the one of the recording's rate has this name."""
    return section(
        INPUT_SECTION,
        grouped(
            "recording",
            RecordingOptions,
            click.option(
                rate_option, "rate_hz", type=positive("Hz"), help="Give the sample rate of a file that states none."
            ),
            click.option(
                "--unit",
                type=click.Choice(list(textures.INPUT_UNITS)),
                help="Give the unit of a file that states none.",
            ),
            click.option(
                "--full-scale", type=positive("VALUE"), help="Give the value of 1.0 in a WAV file, in --unit."
            ),
            click.option(
                "--axis",
                type=click.Choice(textures.AXES, case_sensitive=False),
                help="Take one axis of a three-axis recording.",
            ),
            click.option(
                "--reduce",
                type=click.Choice(textures.REDUCTIONS),
                help="Reduce three axes to one signal; none keeps them. Default: dft321 for P1918.1.1 recordings only.",
            ),
            click.option("--key", metavar="NAME", help="Choose an array of an NPZ, MAT or HDF5 file."),
            click.option(
                "--hand-speed-mm-s", type=positive("mm/s"), help="Give the speed of the hand over a height profile."
            ),
        ),
    )


recording_options = recording_options_with("--rate-hz")

runtime_option = click.option(
    "--runtime",
    type=click.Choice(codec.RUNTIMES),
    help="Decode by the integer core or by ONNX Runtime. Default: as the model specifies.",
)
keep_dc_option = click.option(
    "--keep-dc", is_flag=True, help=f"Keep the band below {textures.HIGHPASS_HZ:g} Hz: offset, gravity, drift."
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
    touch: float | None

    def arguments(self, unit: str | None = None) -> dict[str, Any]:
        """Return the arguments of `encode_recording` for a recording in a unit. Raises click.UsageError."""
        if self.rate_bps is not None and self.snr_db is not None:
            raise click.UsageError("--rate-bps and --snr-db exclude each other; give one of them")
        arguments = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "keep_dc"}
        return {**arguments, "highpass_hz": chosen_highpass_hz(self.keep_dc, unit)}


quality_options = section(
    CODING,
    grouped(
        "quality",
        QualityOptions,
        codec_option,
        model_option,
        setting_option,
        click.option("--rate-bps", type=positive("bit/s"), help="Set the highest rate of the whole .vct file."),
        click.option(
            "--snr-db",
            type=Number("dB"),
            help=f"Set the signal-to-noise ratio. Default: {DEFAULT_SNR_DB:g} without --rate-bps.",
        ),
        touch_option,
        click.option(
            "--stream-rate-hz",
            type=Whole("Hz", 1, MAX_RATE_HZ),
            default=DEFAULT_STREAM_RATE_HZ,
            show_default=True,
            help="Set the sample rate of the coded stream.",
        ),
        keep_dc_option,
    ),
)


def chosen_highpass_hz(keep_dc: bool, unit: str | None) -> float | None:
    """Return the corner of the high-pass before coding a recording in a unit, None = no high-pass."""
    return textures.highpass_of(unit, None if keep_dc else textures.HIGHPASS_HZ)
