"""The `vibrocast` command: finds the subcommand, loads it, and turns each error into one line and an exit code."""

import errno
import importlib
import logging
import re
import shlex
import sys
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import click

from vibrocast import extras
from vibrocast.host.cli import exit_codes
from vibrocast.host.cli.answers import print_answer, with_json
from vibrocast.host.cli.failure_trace import keep_trace
from vibrocast.host.cli.option_types import OutputFile
from vibrocast.host.printable import plain

LOG_LEVELS = ("debug", "info", "warning", "error")
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Subcommand(NamedTuple):
    """Where a subcommand is, and its summary in `vibrocast --help`: the first paragraph of its docstring."""

    module: str
    attribute: str
    summary: str


# Help and version load none of these modules; a subcommand loads its own.
SECTIONS: Mapping[str, Mapping[str, Subcommand]] = {
    "Compress": {
        "record": Subcommand("record", "record", "Record an accelerometer or a displacement sensor into a WAV file."),
        "generate": Subcommand("generate", "generate", "Generate a texture (.wav) or its height profile (.csv)."),
        "encode": Subcommand("encode", "encode", "Code a recording into a .vct file."),
        "decode": Subcommand("decode", "decode", "Decode a .vct file into a WAV, CSV, NPY or MAT file."),
        "info": Subcommand("decode", "info", "Show the codec, rate and content of a .vct file."),
        "codecs": Subcommand("codecs", "codecs", "List the codecs and their parameters."),
    },
    "Play": {
        "play": Subcommand("play", "play", "Play a recording or a .vct file on one or several controllers."),
        "live": Subcommand("live", "live", "Stream a generated texture or standard input to a controller."),
        "render": Subcommand("render", "render", "Write the drive signal of a recording as a WAV file."),
        "plan": Subcommand("plan", "plan", "Choose the cheapest codec settings that meet your requirements."),
    },
    "Controllers": {
        "devices": Subcommand("devices", "list_devices", "List addresses: simulated, serial, USB and sound cards."),
        "status": Subcommand("devices", "status", "Show the properties and state of a controller."),
        "flash": Subcommand("devices", "flash", "Upload a trained model to a controller."),
        "keys": Subcommand("keys", "keys", "Make keys, sign model images and check signatures."),
        "simulate": Subcommand("devices", "simulate", "Run a simulated controller until Ctrl-C."),
    },
    "See and break the wire": {
        "monitor": Subcommand("wire", "monitor", "Show the frames between a host and a controller as they pass."),
        "replay": Subcommand("wire", "replay", "Show the frames of a trace, decode them, or send them again."),
        "proxy": Subcommand("wire", "proxy", "Put a wire with faults between a host and a controller."),
    },
    "Measure and compare": {
        "bench": Subcommand("bench", "bench", "Measure codecs and trained models on a folder of recordings."),
        "stability": Subcommand("stability", "stability", "Map where each codec holds and where it fails."),
        "measure": Subcommand(
            "measure", "measure", "Measure the latency, load, fidelity and response of a controller."
        ),
        "conformance": Subcommand("conformance", "conformance", "Test a controller against the protocol."),
    },
    "Studies": {
        "study": Subcommand("study", "study", "Check, run, simulate and report listening studies."),
    },
    "Learned codecs": {
        "models": Subcommand("codecs", "list_models", "List the shipped models, with rate and quality."),
        "train": Subcommand("train", "train", "Train a model from a TOML configuration."),
        "export": Subcommand("export", "export", "Export a checkpoint: ONNX graphs, model image and card."),
    },
}
SUBCOMMANDS = {name: each for section in SECTIONS.values() for name, each in section.items()}
_LONGEST = max(map(len, SUBCOMMANDS))


class DeviceFailure(click.ClickException):
    """The device, or this program, failed."""

    exit_code = exit_codes.FAILED


class NoDevice(click.ClickException):
    """No controller answers at the address, or the connection was lost for good."""

    exit_code = exit_codes.NO_DEVICE


class VibrocastCommand(click.Group):
    """A group whose errors, expected or not, are one line on stderr and an exit code."""

    def main(self, *arguments: Any, **extra: Any) -> NoReturn:
        """Run the command line, and exit with one of `exit_codes`."""
        extra["standalone_mode"] = False
        try:
            sys.exit(super().main(*arguments, **extra))
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx else "vibrocast"
            fail(f"{error.format_message().rstrip('.')}. See `{command} --help`.", error.exit_code)
        except click.ClickException as error:
            fail(error.format_message(), error.exit_code)
        except click.Abort:
            fail("interrupted", exit_codes.interrupted_by(exit_codes.signalled))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the subcommands."""
        return list(SUBCOMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load a subcommand; None where there is none of that name."""
        if cmd_name not in SUBCOMMANDS:
            return None
        module, attribute, _ = SUBCOMMANDS[cmd_name]
        command = getattr(importlib.import_module(f"vibrocast.host.cli.{module}"), attribute)
        assert isinstance(command, click.Command)
        return with_json(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the names and summaries of the subcommands by section, without loading them."""
        for title, subcommands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{_LONGEST}}", each.summary) for name, each in subcommands.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a subcommand, its errors turned into click's own; with --debug they pass with their traceback."""
        try:
            result = super().invoke(ctx)
        except click.exceptions.Exit:
            print_answer(ctx)
            raise
        except (click.ClickException, click.Abort, KeyboardInterrupt, BrokenPipeError) as error:
            keep_trace(ctx)
            print_answer(ctx, error)
            raise
        except Exception as error:
            keep_trace(ctx)
            if ctx.params["debug"]:
                raise
            if isinstance(error, ImportError) and exit_codes.signalled is not None:
                # A library that was being loaded has caught the interruption.
                interruption = click.Abort()
                print_answer(ctx, interruption)
                raise interruption from error
            if isinstance(error, ModuleNotFoundError):
                error = extras.explained(error) or error
            command = self.get_command(ctx, ctx.invoked_subcommand or "")
            told = explained(error, option_names(command))
            print_answer(ctx, told)
            raise told from error
        print_answer(ctx)
        return result


def trace_file(ctx: click.Context, param: click.Parameter, value: str | None) -> Path | None:
    """Return the file of a trace, or raise click.BadParameter for another suffix."""
    if value is None:
        return None
    from vibrocast.device_protocol.trace import SUFFIXES

    path = Path(value)
    if path.suffix.lower() not in SUFFIXES:
        raise click.BadParameter(f"{value!r} has another suffix than {' or '.join(SUFFIXES)}", ctx, param)
    return path


def keep_log(path: Path, level: str) -> None:
    """Append the log of this program to a file. `level`: one of LOG_LEVELS. Raises OSError."""
    handler = logging.FileHandler(path, encoding="utf-8")
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    logger = logging.getLogger("vibrocast")
    for earlier in [each for each in logger.handlers if isinstance(each, logging.FileHandler)]:
        logger.removeHandler(earlier)
    logger.addHandler(handler)
    logger.setLevel(level.upper())


def option_names(command: click.Command | None) -> dict[str, str]:
    """Return the options of a subcommand by the parameters that the library's errors name."""
    options = [option for parameter in (command.params if command else ()) for option in parameter.opts]
    named = {option.removeprefix("--").replace("-", "_"): option for option in options if option.startswith("--")}
    return {**named, "highpass_hz=None": "--keep-dc"}


def explained(error: Exception, options: Mapping[str, str]) -> click.ClickException:
    """Return the exception that tells a person what went wrong and what to do, with its exit code.

    `options`: as of `option_names`; they take the place of parameters, which the library's errors put in backticks.
    """
    # Only an error needs these modules; a subcommand has loaded most of them.
    from vibrocast import codec, models, textures
    from vibrocast.device_protocol.coded_stream import StreamError
    from vibrocast.device_protocol.messages import MessageError
    from vibrocast.device_protocol.model_image import ModelImageError
    from vibrocast.device_protocol.trace import TraceError
    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.files import InputFileError
    from vibrocast.firmware.native_core import CoreError
    from vibrocast.host.cli.options import BadInput
    from vibrocast.host.controller import ConnectionLost, ControllerError

    device_errors = (ControllerError, TransportError, MessageError)
    input_errors = (
        textures.TextureError,
        codec.CodecError,
        InputFileError,
        extras.MissingExtraError,
        StreamError,
        TraceError,
        ModelImageError,
        models.ModelError,
        OSError,
        MemoryError,
        CoreError,
    )
    text = re.sub("`([a-z_=A-Z]+)`", lambda quoted: options.get(quoted[1], quoted[0]), str(error))
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        text = f"{error.filename or 'the output'}: {error.strerror}; free some space, or write elsewhere"
    elif isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}; check the name and your permissions"
    if isinstance(error, MemoryError):
        text = "not enough memory for this recording; cut it into shorter ones"
    if not isinstance(error, (*input_errors, *device_errors)):
        text = f"unexpected {type(error).__name__}: {text}; `vibrocast --debug ...` shows where, please report it"
    # A TransportError is an OSError too.
    bad_input = isinstance(error, input_errors) and not isinstance(error, device_errors)
    if isinstance(error, (TransportError, ConnectionLost)):
        return NoDevice(text)
    return BadInput(text) if bad_input else DeviceFailure(text)


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr, whatever it quotes, and exit."""
    line = plain(" ".join(message.split()))
    logging.getLogger(__name__).error("%s; exit code %d", line, exit_code)
    click.echo(f"error: {line}", err=True)
    sys.exit(exit_code)


@click.group(
    cls=VibrocastCommand, context_settings={"help_option_names": ["-h", "--help"]}, invoke_without_command=True
)
@click.version_option(package_name="vibrocast")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.option(
    "--trace",
    "trace_path",
    callback=trace_file,
    metavar="FILE",
    help="Write all frames into a .pcapng or .jsonl file.",
)
@click.option(
    "--log", "log_path", type=OutputFile(), metavar="FILE", help="Append what happens to a file, with times in UTC."
)
@click.option(
    "--log-level",
    type=click.Choice(LOG_LEVELS),
    default="info",
    show_default=True,
    help="Choose what --log keeps.",
)
@click.pass_context
def main(ctx: click.Context, debug: bool, trace_path: Path | None, log_path: Path | None, log_level: str) -> None:
    """Compress vibrotactile textures and play them in real time on an actuator."""
    if log_path is not None:
        keep_log(log_path, log_level)
        logging.getLogger(__name__).info("vibrocast %s: %s", version("vibrocast"), shlex.join(sys.argv[1:]))
    if trace_path is not None:
        from vibrocast.host.tracing import tracer

        ctx.with_resource(tracer.writing(trace_path))
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
