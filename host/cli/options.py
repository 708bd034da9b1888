"""Options that several subcommands share, and how they are read."""

import functools
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import DEFAULT_SNR_DB, DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.stream import MAX_GAIN_DB
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.device_protocol.model_image import ACTUATOR_IDENTIFIER, ModelImage
from vibrocast.host import devices
from vibrocast.host.bench_file import Bench, BenchController, read_bench
from vibrocast.host.cli.answers import wants_json
from vibrocast.host.cli.errors import CommandError
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, positive
from vibrocast.host.figures import BenchLimits, Finding, Value, exit_code_of, judged, missed
from vibrocast.output import actuator_constants, actuator_files
from vibrocast.output.actuator import Actuator

_BENCH = "vibrocast.bench"


def command_run() -> str:
    """Return the command as it was given, with an escape in place of each byte that is no character."""
    return shlex.join(["vibrocast", *sys.argv[1:]]).encode(errors="backslashreplace").decode()


def fail(found: Sequence[Finding]) -> None:
    """Raise CommandError with all that was found, a line for each, and the exit code of the worst; nothing: none."""
    if found:
        raise CommandError("\nerror: ".join(map(str, found)), exit_code_of(found))


def judge(bench: Bench | None, figures: Sequence[Value], texture: str = "") -> None:
    """Raise CommandError with all that is wrong with figures: bits that differ, and limits of the bench that they miss.

    Without a bench, known figures are judged by the default limits. `texture`: as of `Bench.missed`.
    """
    if bench is not None:
        fail(judged(figures, bench.missed(figures, texture)))
    else:
        misses = missed(BenchLimits(), [figure for figure in figures if figure.value is not None])
        fail(judged(figures, misses, "state others under [limits] in a bench file, for --bench"))


def chosen_image(ctx: click.Context, param: click.Parameter, value: str | None) -> models.Model | None:
    """Return the model of that name, folder or image file, or the image of an actuator in a TOML file.

    Raises click.BadParameter with what to do, and InputError.
    """
    if value is not None and Path(value).suffix == ".toml":
        actuator = actuator_files.find(value)
        return models.Model(actuator.name, Path(value), actuator_constants.image(actuator))
    try:
        return None if value is None else models.find(value)
    except models.ModelError as error:
        raise click.BadParameter(str(error), ctx, param) from error


def chosen_model(ctx: click.Context, param: click.Parameter, value: str | None) -> models.Model | None:
    """Return what `chosen_image` does, unless that is an actuator."""
    model = chosen_image(ctx, param, value)
    if model is not None and ModelImage.unpack(model.image).codec_identifier == ACTUATOR_IDENTIFIER:
        raise click.BadParameter(f"{value} holds an actuator and no model; upload it", ctx, param)
    return model


def chosen_bench(ctx: click.Context, param: click.Parameter, value: Path | None) -> Bench | None:
    """Return the bench of a file, and let `chosen_controller` take the names of its controllers."""
    if value is None:
        return None
    # No command with this option starts a sensor's program.
    bench = ctx.meta[_BENCH] = read_bench(value, allow_programs=True)
    return bench


def chosen_controller(ctx: click.Context, param: click.Parameter, value: str) -> BenchController:
    """Return a controller by its name in the bench file or its address, or raise click.BadParameter.

    The first controller of the bench file is the default, and the first one at an address counts. One that is not
    there has no name.
    """
    bench: Bench | None = ctx.meta.get(_BENCH)
    if bench is not None:
        if ctx.get_parameter_source(param.name or "") == ParameterSource.DEFAULT:
            return bench.first
        for key in ("name", "address"):
            for each in bench.controllers:
                if getattr(each, key) == value:
                    return each
    return BenchController("", checked_address(ctx, param, value))


def chosen_controllers(
    ctx: click.Context, param: click.Parameter, values: tuple[str, ...]
) -> tuple[BenchController, ...]:
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
            f"no device {value}; `vibrocast devices` lists those that are here, and others are {devices.FORMS}",
            ctx,
            param,
        )
    return value


def given_once(
    read: Callable[[click.Context, click.Parameter, str], Any],
) -> Callable[[click.Context, click.Parameter, tuple[str, ...]], Any]:
    """Return the callback of a `multiple` option that takes one value, which `read` returns; None without any.

    Of an option that is not `multiple`, click takes the last value and drops the others without a word.
    """

    def read_one(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> Any:
        if len(values) > 1:
            raise click.BadParameter(f"given {len(values)} times, and this command takes one; keep one", ctx, param)
        return read(ctx, param, values[0]) if values else None

    return read_one


def grouped(name: str, kind: type[Any], *decorators: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Return one decorator for a group of options, which the command takes as `name`, a dataclass of this kind."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def with_group(*arguments: Any, **values: Any) -> Any:
            group = kind(**{each.name: values.pop(each.name) for each in fields(kind) if each.name in values})
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
    help="Bench file with controllers, actuators and limits.",
)


def _device_option(
    name: str, callback: Callable[..., Any], more: str = "`vibrocast devices` lists the addresses"
) -> Callable[[Callable[..., Any]], Any]:
    return click.option(
        "--device",
        name,
        callback=callback,
        metavar="ADDRESS",
        multiple=True,
        default=("sim",),
        help=f"Controller; {more}.",
    )


device_option = _device_option("address", given_once(checked_address))
bench_device_option = _device_option("chosen", given_once(chosen_controller))
devices_option = _device_option("chosen", chosen_controllers, "repeat it for several")

lsl_option = click.option("--lsl", "has_markers", is_flag=True, help="Send markers to the Lab Streaming Layer.")

model_option = click.option(
    "--model",
    callback=chosen_model,
    metavar="NAME|FOLDER|FILE",
    help="Trained model; `vibrocast models` lists those that ship.",
)
own_models_option = click.option(
    "--models",
    "model_folders",
    type=INPUT,
    metavar="FOLDER",
    multiple=True,
    help="Model that `vibrocast export` wrote; may be repeated.",
)
actuator_option = click.option(
    "--actuator",
    "actuator_name",
    metavar="NAME|FILE",
    help="Actuator behind the controller. Default: as it states.",
)


def own_actuator(address: str, name: str | None) -> Actuator | None:
    """Return the actuator of `actuator_option` for a controller that takes one. Raises click.UsageError."""
    if name is not None and not devices.takes_actuator(address):
        raise click.UsageError(f"{address} has its actuator compiled in; drop --actuator")
    return None if name is None else actuator_files.find(name)


link_option = click.option(
    "--link", type=OutputFile(), metavar="NAME", help="Name of the port. Default: another one at each start."
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
    """Facts that the file of a recording may not state; None = not given, or no option of the command."""

    rate_hz: float | None = None
    unit: str | None = None
    full_scale: float | None = None
    columns: str | None = None
    key: str | None = None
    hand_speed_mm_s: float | None = None
    sensitivity: str | None = None
    skip_lines: int = 0
    resample: bool = False

    def facts(self) -> dict[str, Any]:
        """Return the arguments of `textures.load`."""
        if self.columns is None:
            return vars(self)
        reduction, _, names = self.columns.partition(":")
        if reduction not in textures.REDUCTIONS:
            return vars(self)
        return {**vars(self), "reduce": reduction, "columns": names or None}


rate_hz_option = click.option("--rate-hz", type=positive("Hz"), help="Sample rate, if the file states none.")
unit_option = click.option(
    "--unit", type=click.Choice(list(textures.FILE_UNITS)), help="Unit, if the file states none."
)
hand_speed_option = click.option(
    "--hand-speed-mm-s", type=positive("mm/s"), help="Speed of the hand over a height profile."
)
snr_db_option = click.option("--snr-db", type=Number("dB"), help=f"Signal-to-noise ratio. Default: {DEFAULT_SNR_DB:g}.")
stream_rate_option = click.option(
    "--stream-rate-hz",
    type=Whole("Hz", 1, MAX_RATE_HZ),
    default=DEFAULT_STREAM_RATE_HZ,
    help="Sample rate of the coded stream.",
)

runtime_option = click.option(
    "--runtime",
    type=click.Choice(codec.RUNTIMES),
    help="Integer core or ONNX Runtime. Default: as the model specifies.",
)
gain_option = click.option(
    "--gain-db",
    type=Number("dB", -MAX_GAIN_DB, MAX_GAIN_DB),
    default=0.0,
    help="Change of the level.",
)


@dataclass(frozen=True)
class QualityOptions:
    """How a recording is coded; None = not given, or no option of the command."""

    codec_name: str | None = None
    rate_bps: float | None = None
    snr_db: float | None = None
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ
    setting: codec.Setting = field(default_factory=dict)
    model: models.Model | None = None
    touch: float | None = None

    def arguments(self, unit: str | None = None) -> dict[str, Any]:
        """Return the arguments of `encode_recording` for a recording in a unit."""
        return {**vars(self), "highpass_hz": textures.highpass_of(unit, textures.HIGHPASS_HZ)}


def rate_target(rate_bps: float | None, snr_db: float | None) -> RateTarget | None:
    """Return what a live stream holds: a rate alone is constant, and one with an SNR is a cap; None without a rate."""
    if rate_bps is None or snr_db is None:
        return None if rate_bps is None else RateTarget(constant_rate_bps=rate_bps)
    return RateTarget(capped_rate_bps=rate_bps, snr_db=snr_db)
