"""The `vibrocast` command: finds the subcommand, loads it, and turns each error into one line and an exit code."""

import errno
import importlib
import re
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple, NoReturn

import click

from vibrocast import extras
from vibrocast.host.cli.exit_codes import FAILED, INTERRUPTED
from vibrocast.host.printable import plain

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Subcommand(NamedTuple):
    """Where a subcommand is, and its summary in `vibrocast --help`: the first paragraph of its docstring."""

    module: str
    attribute: str
    summary: str


# Help and version load none of these modules; a subcommand loads its own.
SUBCOMMANDS: Mapping[str, Subcommand] = {
    "bench": Subcommand(
        "bench", "bench", "Measure codecs and trained models on every recording of a folder or a manifest."
    ),
    "codecs": Subcommand("codecs", "codecs", "List the codecs and the parameters of their settings."),
    "conformance": Subcommand("conformance", "conformance", "Test a controller against docs/reference/protocol.md."),
    "decode": Subcommand(
        "decode",
        "decode",
        "Decode a .vct file into a WAV, CSV, NPY or MAT file, or a height profile into a CSV file.",
    ),
    "devices": Subcommand("devices", "list_devices", "List what may be a controller."),
    "encode": Subcommand(
        "encode", "encode", "Code a recording, or with --plan the texture that FILE names, into a .vct file."
    ),
    "export": Subcommand(
        "export", "export", "Write a folder with ONNX graphs, model image and card of a trained model."
    ),
    "flash": Subcommand(
        "devices", "flash", "Upload MODEL, or with --plan every model that the plan needs, to a controller."
    ),
    "generate": Subcommand(
        "generate", "generate", "Make a texture as a WAV file, or its height profile as a CSV file."
    ),
    "info": Subcommand("decode", "info", "Show what a .vct file holds."),
    "live": Subcommand(
        "live", "live", "Stream a live SOURCE: a generated texture, or raw samples from standard input (-)."
    ),
    "measure": Subcommand("measure", "measure", "Measure a controller: latency, load, fidelity, frequency response."),
    "models": Subcommand("codecs", "list_models", "List the trained models that ship, with their rates and quality."),
    "plan": Subcommand("plan", "plan", "Choose how each texture of a scene is coded, with no more than it needs."),
    "play": Subcommand("play", "play", "Play a recording or a .vct file on a controller, or on several at once."),
    "simulate": Subcommand("devices", "simulate", "Run a simulated controller until Ctrl-C."),
    "stability": Subcommand("stability", "stability", "Map where each codec holds and where it fails."),
    "status": Subcommand("devices", "status", "Show the properties and the state of a controller."),
    "train": Subcommand("train", "train", "Train a model as CONFIG describes it."),
}


class DeviceFailure(click.ClickException):
    """The device, or this program, failed."""

    exit_code = FAILED


class VibrocastCommand(click.Group):
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
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the names and summaries of the subcommands, without loading them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, subcommand.summary) for name, subcommand in SUBCOMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a subcommand, its errors turned into click's own; with --debug they pass with their traceback."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except Exception as error:
            if ctx.params["debug"]:
                raise
            if isinstance(error, ModuleNotFoundError):
                error = extras.explained(error) or error
            command = self.get_command(ctx, ctx.invoked_subcommand or "")
            raise explained(error, option_names(command)) from error


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
    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.files import InputFileError
    from vibrocast.firmware.native_core import CoreError
    from vibrocast.host.cli.options import BadInput
    from vibrocast.host.controller import ControllerError

    device_errors = (ControllerError, TransportError, MessageError)
    input_errors = (
        textures.TextureError,
        codec.CodecError,
        InputFileError,
        extras.MissingExtraError,
        StreamError,
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
    return BadInput(text) if bad_input else DeviceFailure(text)


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr, whatever it quotes, and exit."""
    click.echo(f"error: {plain(' '.join(message.split()))}", err=True)
    sys.exit(exit_code)


@click.group(
    cls=VibrocastCommand, context_settings={"help_option_names": ["-h", "--help"]}, invoke_without_command=True
)
@click.version_option(package_name="vibrocast")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.pass_context
def main(ctx: click.Context, debug: bool) -> None:
    """Compress vibrotactile textures and play them in real time on an actuator."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
