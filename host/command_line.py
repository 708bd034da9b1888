"""The `vibrocast` command: reads arguments, calls the rooms, prints what a person needs; errors are one line."""

import errno
import json
import math
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from vibrocast import codec, models, textures
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, StreamError
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.model_image import ModelImageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import coding, devices, flasher, planned_command, player, profiles, progress, steered
from vibrocast.host.bench_command import bench
from vibrocast.host.conformance_command import conformance
from vibrocast.host.controller import ControllerError
from vibrocast.host.entry import INTERRUPTED
from vibrocast.host.export_command import export
from vibrocast.host.input_files import InputFileError
from vibrocast.host.live_command import live
from vibrocast.host.measure_command import measure
from vibrocast.host.models_command import list_models
from vibrocast.host.options import (
    INPUT,
    POSITIVE,
    BadInput,
    Finite,
    OutputFile,
    chosen_model,
    codec_option,
    device_option,
    model_option,
    options,
    plan_option,
    recording_options,
    setting_option,
)
from vibrocast.host.output_files import whole_file
from vibrocast.host.plain import plain
from vibrocast.host.plan_command import plan
from vibrocast.host.report import Report
from vibrocast.host.stability_command import stability
from vibrocast.host.steered_options import steered_options, wish_of
from vibrocast.host.train_command import train
from vibrocast.simulated_device.actuator import ACTUATORS, PIEZO_STACK

if TYPE_CHECKING:
    from vibrocast.host import hand

INPUT_ERRORS = (
    textures.TextureError,
    codec.CodecError,
    InputFileError,
    StreamError,
    ModelImageError,
    models.ModelError,
    OSError,
    MemoryError,
)
_Argument = TypeVar("_Argument")

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
ANSWERS = {True: "yes", False: "NO", None: "not compared"}
DEVICE_ERRORS = (ControllerError, TransportError, MessageError)


class DeviceFailure(click.ClickException):
    """The device, or this program, failed."""

    exit_code = 1


class OneLineErrors(click.Group):
    """A group whose errors, expected or not, are one line on stderr and an exit code."""

    def main(self, *arguments: Any, **extra: Any) -> NoReturn:
        """Run the command line and exit: 0, 1 device or other failure, 2 bad input, 130 interrupted."""
        extra["standalone_mode"] = False
        try:
            sys.exit(super().main(*arguments, **extra))
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx else "vibrocast"
            fail(f"{error.format_message().rstrip('.')}. See `{command} --help`.", error.exit_code)
        except click.ClickException as error:
            fail(error.format_message(), error.exit_code)
        except click.Abort:
            fail("interrupted", INTERRUPTED)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a subcommand, its errors turned into click's own; with --debug they pass with their traceback."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except Exception as error:
            if ctx.params["debug"]:
                raise
            raise explained(error) from error


def explained(error: Exception) -> click.ClickException:
    """Return the exception that tells a person what went wrong and what to do, with its exit code."""
    text = str(error)
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        text = f"{error.filename or 'the output'}: {error.strerror}; make room, or write elsewhere"
    elif isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}; check the name and your permissions"
    if isinstance(error, MemoryError):
        text = "not enough memory for this recording; cut it into shorter ones"
    if not isinstance(error, (*INPUT_ERRORS, *DEVICE_ERRORS)):
        text = f"unexpected {type(error).__name__}: {text}; `vibrocast --debug ...` shows where, please report it"
    # A TransportError is an OSError too.
    bad_input = isinstance(error, INPUT_ERRORS) and not isinstance(error, DEVICE_ERRORS)
    return BadInput(text) if bad_input else DeviceFailure(text)


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr, whatever it quotes, and exit."""
    click.echo(f"error: {plain(' '.join(message.split()))}", err=True)
    sys.exit(exit_code)


def refuse_overwriting(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Raise click.UsageError where a file to write is also one to read, or two to write are the same."""
    used = [path for path in inputs if path]
    for output in filter(None, outputs):
        for other in used:
            same = os.path.realpath(output) == os.path.realpath(other)
            if same or (output.exists() and other.exists() and output.samefile(other)):
                raise click.UsageError(f"{output} and {other} are the same file: give the output another name.")
        used.append(output)


runtime_option = click.option(
    "--runtime",
    type=click.Choice(codec.RUNTIMES),
    help="Decode by the integer core or by ONNX Runtime, where the model can be decoded by either; else as it says.",
)
quality_options = options(
    codec_option,
    click.option("--rate-bps", type=POSITIVE, help="Size of the whole coded file, in bits per second of signal."),
    click.option(
        "--snr-db", type=Finite(), help=f"Signal-to-noise ratio; {coding.DEFAULT_SNR_DB:g} if neither is given."
    ),
    click.option(
        "--stream-rate-hz",
        type=click.IntRange(1, MAX_RATE_HZ),
        default=coding.DEFAULT_STREAM_RATE_HZ,
        show_default=True,
        help="Sample rate of the coded stream.",
    ),
    setting_option,
    model_option,
)


@click.group(cls=OneLineErrors, context_settings={"help_option_names": ["-h", "--help"]}, invoke_without_command=True)
@click.version_option(version("vibrocast"))
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.pass_context
def main(ctx: click.Context, debug: bool) -> None:
    """Record, compress, stream and replay the feel of a surface."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


main.add_command(bench)


@main.command()
@click.argument("file", type=INPUT, required=False)
@plan_option
@device_option
@click.option("--loop", "loops", type=click.IntRange(1, 65_535), default=1, show_default=True, help="Passes to play.")
@click.option("--report", "report_path", type=OutputFile(".json"), help="Write the figures as JSON.")
@click.option("--plot", "plot_path", type=OutputFile(".png", ".svg", ".pdf"), help="Draw a picture.")
@runtime_option
@quality_options
@click.option("--positions", "positions_path", type=INPUT, help="CSV file of time_s,position_mm: a hand on a profile.")
@click.option("--stroke-mm", type=POSITIVE, help="A hand that strokes a profile, --loop times there and back.")
@recording_options
def play(
    file: Path | None,
    plan_path: Path | None,
    address: str,
    loops: int,
    positions_path: Path | None,
    stroke_mm: float | None,
    report_path: Path | None,
    plot_path: Path | None,
    runtime: str | None,
    **choices: Any,
) -> None:
    """Play a recording or a .vct file on a controller.

    A height profile is played over time, as --hand-speed-mm-s passes it once, or by the position of a hand:
    --positions, or --stroke-mm with --hand-speed-mm-s as its highest speed.

    With --plan, play the texture that FILE names, or all, live and as planned, on the plan's controllers, or on
    --device where it has one, and hold what is measured against the forecast: what is off by more than 10 % fails.
    """
    from vibrocast.host import end_to_end, picture

    if plan_path is not None:
        plan = planned_command.read(plan_path, ("file", "address", "report_path"))
        planned_command.play(plan, [str(file)] if file else [], report_path)
        return
    file = needed(file, "FILE")
    refuse_overwriting([report_path, plot_path], [file, *files_of(choices["model"])])
    runtime = devices.decoding_runtime(address, runtime)
    if positions_path or stroke_mm:
        if report_path:
            raise click.UsageError("a profile under a hand has no report: drop --report.")
        from vibrocast.host import hand

        movement = hand.chosen_movement(positions_path, stroke_mm, choices.pop("hand_speed_mm_s"), loops)
        play_profile(file, address, movement, plot_path, runtime, choices)
        return
    if file.suffix.lower() == ".vct":
        coded = coded_already(file, choices)
        if coded.header.spatial:
            raise BadInput(f"{file}: coded over position; give --positions, or --stroke-mm and --hand-speed-mm-s")
        source: coding.Stream | textures.Recording = replace(coded, runtime=runtime)
    else:
        quality = quality_of(choices)
        source = textures.load(file, **choices)
    with devices.connect(address, runtime) as controller:
        # What the controller cannot play need not be encoded first.
        if isinstance(source, coding.Stream):
            player.check_limits(controller, source.header.channels, source.header.rate_hz)
            stream, encoding = source, None
        else:
            player.check_limits(controller, source.channels, quality["stream_rate_hz"])
            encoding = encoded(source, {**quality, "runtime": runtime}, live=True)
            stream = encoding.stream
        with progress.shown("playing") as update:
            tell = playing(update, stream.bits_per_second)
            outcome = end_to_end.play(controller, address, file.name, stream, encoding, loops, tell)
    if report_path:
        outcome.report.write(report_path)
    if plot_path:
        picture.draw(plot_path, f"{file.name} on {address}", outcome.caption, outcome.traces)
    show(summary(outcome.report))
    if False in (outcome.report.decoded_equals_offline, outcome.report.dac_equals_offline):
        raise ControllerError(
            "what the controller played is not what was sent: see the underruns and lost packets above, "
            "and try a shorter cable or a less busy machine; or the other --runtime, if the controller decodes by it"
        )


@main.command()
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(".vct"))
@click.option("--spatial", is_flag=True, help="Code a height profile to be played by the position of a hand.")
@click.option(
    "--slowest-hand-speed-mm-s",
    type=POSITIVE,
    default=profiles.SLOWEST_MM_S,
    show_default=True,
    help="With --spatial: the pitch is chosen for this speed.",
)
@plan_option
@quality_options
@steered_options
@recording_options
def encode(
    file: Path, out: Path, spatial: bool, slowest_hand_speed_mm_s: float, plan_path: Path | None, **choices: Any
) -> None:
    """Code a recording, or with --plan the texture that FILE names, into a .vct file."""
    if plan_path is not None:
        tell_encoded(out, planned_command.read(plan_path, ("file", "out")).texture(str(file)).encode())
        return
    refuse_overwriting([out], [file, *files_of(choices["model"])])
    wish = wish_of(choices)
    quality = quality_of(choices)
    if spatial:
        if wish is not None:
            raise click.UsageError("a profile has no time: no rate or quality over time can be kept in it.")
        encoding = encoded_profile(profiles.recording_of(file, **choices), quality, slowest_hand_speed_mm_s)
        facts = encoding.stream.facts()
        click.echo(
            f"{out}: {facts['size_bytes']} bytes, {facts['length_mm']:.3f} mm, {facts['samples_per_metre']} samples "
            f"per metre, {facts['bits_per_mm']:.0f} bit/mm"
        )
        coding.write(out, encoding.stream)
        return
    if wish is not None:
        encode_steered(textures.load(file, **choices), out, wish, quality)
        return
    tell_encoded(out, encoded(textures.load(file, **choices), quality, live=False))


def tell_encoded(out: Path, encoding: coding.Encoding) -> None:
    """Write a .vct file, and tell its size and quality."""
    coding.write(out, encoding.stream)
    snr = "no SNR (silent)" if encoding.snr_db is None else f"SNR {encoding.snr_db:.2f} dB"
    stream = encoding.stream
    model = f", model {stream.model_name}" if stream.image else ""
    click.echo(f"{out}: {stream.size_bytes} bytes, {stream.bits_per_second:.0f} bit/s, {snr}{model}")


@main.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def codecs(as_json: bool) -> None:
    """List the codecs and the parameters of their settings."""
    facts = {
        known.name: {
            "summary": known.summary,
            "steers": "yes" if known.steers else "no, all packets are of one quality",
            **{
                name: f"{parameter.meaning}: {parameter.range}; {parameter.default} if not given"
                for name, parameter in known.parameters.items()
            },
        }
        for known in codec.CODECS.values()
    }
    # Parameters are named as --setting takes them.
    lines = {name: [f"{key}: {text}" for key, text in about.items()] for name, about in facts.items()}
    show(facts if as_json else lines, as_json)


@main.command()
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(*textures.SAVED_SUFFIXES))
@click.option(
    "--format",
    "sample_format",
    type=click.Choice(("float", "16-bit")),
    default="float",
    show_default=True,
    help="Choose the samples of a WAV file.",
)
@model_option
@runtime_option
def decode(file: Path, out: Path, sample_format: str, model: models.Model | None, runtime: str | None) -> None:
    """Decode a .vct file into a WAV, CSV, NPY or MAT file; a height profile into a CSV file.

    The file holds physical values, exactly as decoded; a WAV file of 16 bit is relative to a full scale. All but NPY
    state rate and unit, from which this program knows them again.
    """
    sixteen_bit = sample_format == "16-bit"
    if sixteen_bit and out.suffix.lower() != ".wav":
        raise click.UsageError("--format is for a WAV file; drop it.")
    refuse_overwriting([out], [file, *files_of(model)])
    stream = replace(coding.read(file, model.image if model else None), runtime=runtime)
    if stream.header.spatial and out.suffix.lower() == ".csv":
        with progress.shown("decoding") as update:
            profile = coding.write_profile(out, stream, progress=update)
        click.echo(f"{out}: {profile.length_mm:g} mm, a height every {profile.spacing_um:g} um")
        return
    with progress.shown("decoding") as update:
        full_scale = coding.write_recording(out, stream, sixteen_bit, progress=update)
    header = stream.header
    unit = f"1.0 is {full_scale:g} {header.unit}" if out.suffix.lower() == ".wav" else f"in {header.unit}"
    click.echo(f"{out}: {stream.seconds:.3f} s at {header.rate_hz} Hz, {unit}")


@main.command()
@click.argument("file", type=INPUT)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@model_option
def info(file: Path, as_json: bool, model: models.Model | None) -> None:
    """Show what a .vct file holds."""
    show(coding.read(file, model.image if model else None).facts(), as_json)


@main.command()
@click.argument("kind", type=click.Choice(sorted(textures.GENERATORS)))
@click.argument("out", type=OutputFile(".wav", ".csv"))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another texture.")
@click.option("--seconds", type=POSITIVE, default=4.0, show_default=True)
@click.option(
    "--rate-hz", type=click.IntRange(1, MAX_RATE_HZ), default=coding.DEFAULT_STREAM_RATE_HZ, show_default=True
)
@click.option("--hand-speed-mm-s", type=POSITIVE, default=50.0, show_default=True, help="Mean speed of the hand.")
@click.option(
    "--speed-variation",
    type=Finite(min=0, max=2),
    default=0.0,
    show_default=True,
    help="How far the speed swings to either side of its mean, in parts of it, once a second; above 1 it turns back.",
)
def generate(kind: str, out: Path, speed_variation: float, **choices: Any) -> None:
    """Make a texture, as a WAV file, or the height profile of its surface, as a CSV file."""
    if out.suffix.lower() == ".csv":
        if speed_variation:
            raise click.UsageError("a height profile is the same at any speed: drop --speed-variation.")
        profile = textures.surface_profile(kind, **choices)
        with whole_file(out) as partial:
            textures.save_profile(partial, profile)
        click.echo(f"{out}: {profile.length_mm:g} mm, a height every {profile.spacing_um:g} um")
        return
    if speed_variation:
        mean_mm_s = choices["hand_speed_mm_s"]
        choices["hand_speed_mm_s"] = textures.varying_speed(
            choices["seconds"], choices["rate_hz"], mean_mm_s, speed_variation
        )
    recording = textures.GENERATORS[kind](**choices)
    with whole_file(out) as partial:
        full_scale = textures.save(partial, recording, sixteen_bit=True)
    click.echo(f"{out}: {recording.seconds:.3f} s at {recording.rate_hz:g} Hz, 1.0 is {full_scale:g} {recording.unit}")


@main.command("devices")
def list_devices() -> None:
    """List what may be a controller."""
    show(devices.available())


@main.command()
@click.argument("model", callback=chosen_model, required=False)
@plan_option
@device_option
def flash(model: models.Model | None, plan_path: Path | None, address: str) -> None:
    """Flash a model into a controller: by its name, from its folder, or a model image; with --plan, what it needs.

    It is transferred, verified by reading it back, started on trial and confirmed. Cut off, the same command goes on
    where it stopped, and the controller keeps running the image before.
    """
    if plan_path is not None:
        for name, planned_address, needed_model in planned_command.needed_models(plan_path):
            click.echo(f"{name}: {flashed(needed_model, planned_address)}")
        return
    click.echo(flashed(needed(model, "MODEL"), address))


def flashed(model: models.Model, address: str) -> str:
    """Flash a model into the controller at an address; return what it runs then."""
    with devices.connect(address) as controller, progress.shown("flashing") as update:
        slot = flasher.flash(controller, model.image, progress=lambda done, total: update(done / total))
    return f"{slot.name} {slot.version} runs from slot {slot.slot}, confirmed"


def needed(argument: _Argument | None, name: str) -> _Argument:
    """Return an argument that only --plan makes up for. Raises click.UsageError."""
    if argument is None:
        raise click.UsageError(f"{name} is missing: give it, or --plan.")
    return argument


@main.command()
@device_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(address: str, as_json: bool) -> None:
    """Show what a controller is and does."""
    with devices.connect(address) as controller:
        facts = devices.facts(controller)
    show(facts, as_json)


@main.command()
@click.option("--actuator", type=click.Choice(sorted(ACTUATORS)), default=PIEZO_STACK.name, show_default=True)
@click.option("--drift-ppm", type=click.IntRange(-10_000, 10_000), default=0, show_default=True, help="Of its clock.")
@click.option("--flash-file", type=OutputFile(), help="Keeps the model images; without it they last until the end.")
@runtime_option
def simulate(actuator: str, drift_ppm: int, flash_file: Path | None, runtime: str | None) -> None:
    """Run a simulated controller until Ctrl-C.

    It is behind a pseudo-terminal, whose address is printed; other programs open it as a serial port.
    """
    from vibrocast.simulated_device.controller import FLASH_BYTES, Settings
    from vibrocast.simulated_device.controller import Controller as SimulatedController
    from vibrocast.simulated_device.flash import FlashMemory
    from vibrocast.simulated_device.pty_port import PtyPort

    if flash_file and flash_file.exists() and not (flash_file.is_file() and flash_file.stat().st_size == FLASH_BYTES):
        raise BadInput(f"{flash_file}: not the {FLASH_BYTES} bytes of this flash memory; give a name for a new file")
    flash_memory = FlashMemory(FLASH_BYTES, path=flash_file)
    settings = Settings(actuator=ACTUATORS[actuator], drift_ppm=drift_ppm, runtime=runtime)
    with PtyPort(SimulatedController(settings, flash_memory)) as port:
        click.echo(f"serial:{port.name}")
        sys.stdout.flush()
        threading.Event().wait()


main.add_command(conformance)
main.add_command(export)
main.add_command(list_models)
main.add_command(live)
main.add_command(measure)
main.add_command(plan)
main.add_command(stability)
main.add_command(train)


def coded_already(file: Path, choices: dict[str, Any]) -> coding.Stream:
    """Read a .vct file to play, to which no option of the two groups applies but the model."""
    model = choices.pop("model")
    given = [name for name, value in choices.items() if value not in (None, {}, coding.DEFAULT_STREAM_RATE_HZ)]
    if given:
        raise click.UsageError(f"{file} is coded already: drop --{given[0].removesuffix('_name').replace('_', '-')}.")
    return coding.read(file, model.image if model else None)


def quality_of(choices: dict[str, Any]) -> dict[str, Any]:
    """Take the options of the quality group out of all choices; return them as `coding.encode` takes them."""
    names = ("codec_name", "rate_bps", "snr_db", "setting", "model", "stream_rate_hz")
    quality = {name: choices.pop(name) for name in names}
    if quality["rate_bps"] is not None and quality["snr_db"] is not None:
        raise click.UsageError("--rate-bps and --snr-db exclude each other: give one of them.")
    return quality


def encode_steered(recording: textures.Recording, out: Path, wish: steered.Wish, quality: dict[str, Any]) -> None:
    """Code a recording as a live stream into a .vct file, and print how rate and quality came out."""
    del quality["rate_bps"], quality["snr_db"]  # they are in the wish
    with progress.shown("encoding") as update:
        stream, outcome = steered.encode(recording, wish, progress=update, **quality)
    coding.write(out, stream)
    window = "" if outcome.furthest is None else f", furthest from it over 2 s: {100 * outcome.furthest:+.2f} %"
    asked = "" if wish.rate_bps is None else f" of {wish.rate_bps:g}{window}"
    low_db, high_db = outcome.snr_range_db
    snr = (
        "silent"
        if math.isnan(outcome.snr_db)
        else f"{outcome.snr_db:.2f} dB, 90 % within {low_db:.1f} to {high_db:.1f}"
    )
    lines = {
        str(out): f"{stream.size_bytes} bytes, codec {stream.codec_name}"
        + (f", model {stream.model_name}" if stream.image else ""),
        "rate": f"{outcome.sent_bps:.0f} bit/s{asked}",
        "of it": f"packets {outcome.packets_bps:.0f} bit/s, to which frames add {100 * outcome.frames_add:.1f} %; "
        f"padding {100 * outcome.padding:.1f} %",
        "packets": f"{1000 * outcome.packet_s:.1f} ms each, SNR {snr}",
    }
    show(lines)


def encoded(recording: textures.Recording, quality: dict[str, Any], live: bool) -> coding.Encoding:
    """Encode a recording, show how far it is, and say what was not met."""
    with progress.shown("encoding") as update:
        encoding = coding.encode(recording, live=live, progress=update, **quality)
    if encoding.note:
        click.echo(f"note: {encoding.note}", err=True)
    return encoding


def encoded_profile(recording: textures.Recording, quality: dict[str, Any], slowest_mm_s: float) -> coding.Encoding:
    """Encode a height profile as a spatial stream, show how far it is, and say what was not met."""
    if quality["rate_bps"] is not None or quality.pop("stream_rate_hz") != coding.DEFAULT_STREAM_RATE_HZ:
        raise click.UsageError("a profile has no time: give --snr-db and --slowest-hand-speed-mm-s instead of rates.")
    with progress.shown("encoding") as update:
        encoding = profiles.encode(recording, slowest_mm_s, progress=update, **quality)
    if encoding.note:
        click.echo(f"note: {encoding.note}", err=True)
    return encoding


def play_profile(
    file: Path,
    address: str,
    movement: "hand.Movement",
    plot_path: Path | None,
    runtime: str | None,
    choices: dict[str, Any],
) -> None:
    """Play a height profile, or a spatial stream, under a moving hand; tell what was played, and draw it."""
    from vibrocast.host import end_to_end, hand, picture

    if file.suffix.lower() == ".vct":
        stream = coded_already(file, choices)
    else:
        quality = quality_of(choices)
        stream = encoded_profile(profiles.recording_of(file, **choices), quality, profiles.SLOWEST_MM_S).stream
    stream = replace(stream, runtime=runtime)
    if not stream.header.spatial:
        raise BadInput(f"{file}: coded over time, not over position; encode the profile with --spatial")
    with devices.connect(address, runtime) as controller, progress.shown("playing") as update:
        played = hand.play(controller, stream, movement, progress=update)
        actuator = end_to_end.actuator_model(controller.description.actuator)
    expected = hand.computed(stream, played, actuator)
    status, facts = played.status, stream.facts()
    if plot_path:
        picture.draw(plot_path, f"{file.name} on {address}", *hand.pictured(played, expected, actuator))
    show(
        {
            "played": f"{file.name}, {facts['length_mm']:.2f} mm, under a hand at up to "
            f"{movement.fastest_mm_s:.0f} mm/s for {movement.seconds:.2f} s",
            "stream": f"{facts['size_bytes']} bytes, {facts['bits_per_mm']:.0f} bit/mm, codec {facts['codec']}",
            "actuator": f"{actuator.name}, clipped {status.compensation_clipped}, limited by voltage "
            f"{status.voltage_limited}, slew {status.slew_limited}, power {status.power_limited} samples",
            "positions": f"{len(played.positions)} sent, {status.underruns} came too late, frames damaged "
            f"{played.damaged}",
            "DAC as computed": {**ANSWERS, False: "no, as where a position is lost"}[
                hand.as_computed(played, expected, actuator)
            ],
        }
    )


def files_of(model: models.Model | None) -> list[Path]:
    """Return the files that a model was read from, as far as another could be written over them."""
    return [model.path] if model else []


def playing(update: progress.Update, bits_per_second: float) -> Callable[[player.Progress], None]:
    """Return what tells `update` of a playback: position, rate, buffer, underruns."""

    def tell(now: player.Progress) -> None:
        duration_s = now.duration_s or math.inf
        details = (
            f"{now.position_s:.1f} of {duration_s:.1f} s  {bits_per_second / 1000:.2f} kbit/s  "
            f"buffer {1000 * now.buffered_s:.0f} ms  underruns {now.status.underruns}"
        )
        update(now.position_s / duration_s, details)

    return tell


def summary(report: Report) -> dict[str, object]:
    """Return the lines that `play` prints at its end."""
    latency, limits = report.latency_ms, report.actuator
    return {
        "played": f"{report.file}, {report.seconds:.2f} s, {report.channels} channel(s), {report.loops} time(s)",
        "stream": f"{report.stream_bytes} bytes, {report.bits_per_second:.0f} bit/s, "
        f"{report.bits_per_sample:.2f} bit/sample, codec {report.codec}"
        + (f", model {report.model}" if report.model else ""),
        "SNR": "none" if report.snr_db is None else f"{report.snr_db:.2f} dB",
        "wire": f"{report.wire_bytes} bytes sent, {report.wire_bytes_back} received",
        "latency": f"{latency.algorithmic:.1f} ms codec + {latency.buffered:.1f} ms buffer, "
        f"{latency.end_to_end:.1f} ms to the skin",
        "underruns": f"{report.underruns}, lost packets {report.lost_packets}, reconnects {report.reconnects}",
        "actuator": f"{limits.name}, clipped {limits.clipped_samples}, limited by voltage {limits.voltage_limited}, "
        f"slew {limits.slew_limited}, power {limits.power_limited} samples",
        "decoded as sent": ANSWERS[report.decoded_equals_offline],
        "DAC as computed": ANSWERS[report.dac_equals_offline],
    }


def show(facts: Mapping[str, object], as_json: bool = False) -> None:
    """Print names and values, one pair a line, a list's items below each other; or all as JSON."""
    if as_json:
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        if isinstance(value, Mapping):
            value = [f"{key.replace('_', ' ')}: {item}" for key, item in value.items()]
        lines = value if isinstance(value, list) else [value]
        for index, line in enumerate(lines or ["none"]):
            click.echo(f"{name.replace('_', ' ') if index == 0 else '':{width}}  {plain(str(line))}")
