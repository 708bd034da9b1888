"""The `vibrocast` command: finds the subcommand, loads it, and turns each error into one line and an exit code."""

import contextlib
import importlib
import logging
import shlex
import sys
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import click

from vibrocast import extras
from vibrocast.host.cli import exit_codes
from vibrocast.host.cli.answers import begin, print_answer, with_json
from vibrocast.host.cli.errors import explained, option_names
from vibrocast.host.cli.failure_trace import keep_trace
from vibrocast.host.cli.option_types import OutputFile, reject_overwriting
from vibrocast.host.printable import plain

LOG_LEVELS = ("debug", "info", "warning", "error")


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

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the options before the subcommand; see whether the answer is to be JSON first."""
        begin(ctx, args)
        try:
            rest = super().parse_args(ctx, args)
            # Of the subcommand, only the arguments are known yet; each may be a file that it reads or writes.
            files = [Path(each.partition("=")[2] if each.startswith("--") else each) for each in rest]
            reject_overwriting([ctx.params["trace_path"], ctx.params["log_path"]], files)
            return rest
        except click.ClickException as error:
            print_answer(ctx, error)
            raise

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
            with writing_trace(ctx.params["trace_path"]):
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


def writing_trace(path: Path | None) -> AbstractContextManager[None]:
    """Return what writes the frames of a block into a file; None = nowhere."""
    if path is None:
        return contextlib.nullcontext()
    from vibrocast.host.tracing import tracer

    return tracer.writing(path)


def trace_file(ctx: click.Context, param: click.Parameter, value: str | None) -> Path | None:
    """Return the file of a trace, or raise click.BadParameter where it cannot be written."""
    if value is None:
        return None
    from vibrocast.device_protocol.trace import SUFFIXES

    return OutputFile(*SUFFIXES).convert(value, param, ctx)


class LogFile(logging.FileHandler):
    """The file of a log, which raises what keeps it from being written."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Raise the error that is being handled, and write no more."""
        error = sys.exc_info()[1]
        if not isinstance(error, OSError):
            super().handleError(record)
            return
        logging.getLogger("vibrocast").removeHandler(self)
        with contextlib.suppress(OSError):
            self.close()
        raise OSError(error.errno, error.strerror, self.baseFilename) from error


def keep_log(path: Path, level: str) -> None:
    """Append the log of this program to a file. `level`: one of LOG_LEVELS. Raises OSError, then or later."""
    handler = LogFile(path, encoding="utf-8")
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    logger = logging.getLogger("vibrocast")
    for earlier in [each for each in logger.handlers if isinstance(each, logging.FileHandler)]:
        logger.removeHandler(earlier)
    logger.addHandler(handler)
    logger.setLevel(level.upper())


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr, whatever it quotes, and exit."""
    line = plain(" ".join(message.split()))
    with contextlib.suppress(OSError):  # of a full log
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
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
