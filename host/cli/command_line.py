"""The `vibrocast` command: finds the subcommand, loads it, and turns each error into one line and an exit code."""

import contextlib
import logging
import shlex
import sys
import time
from contextlib import AbstractContextManager
from functools import wraps
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any, NoReturn

import click

from vibrocast import extras
from vibrocast.files import plain
from vibrocast.host.cli import interruption
from vibrocast.host.cli.answers import begin, finished, print_answer
from vibrocast.host.cli.commands import subcommands
from vibrocast.host.cli.errors import explained, option_names
from vibrocast.host.cli.failure_trace import keep_trace
from vibrocast.host.cli.option_types import OutputFile, reject_overwriting
from vibrocast.progress import notes


class VibrocastCommand(click.Group):
    """A group whose errors, expected or not, are one line on stderr and an exit code."""

    def main(self, *arguments: Any, **extra: Any) -> NoReturn:
        """Run the command line, and exit with one of the codes of `vibrocast.errors`."""
        extra["standalone_mode"] = False
        try:
            sys.exit(super().main(*arguments, **extra))
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx else "vibrocast"
            fail(f"{error.format_message().rstrip('.')}. See `{command} --help`.", error.exit_code)
        except click.ClickException as error:
            fail(error.format_message(), error.exit_code)
        except click.Abort:
            fail("interrupted", interruption.exit_code_of(interruption.signalled))

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
        return list(subcommands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load a subcommand; None where there is none of that name."""
        row = subcommands().get(cmd_name)
        return None if row is None else finished(with_extra(row.load(), row.extra))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the names and summaries of the subcommands by section, without loading them."""
        rows = subcommands().values()
        longest = max(len(row.name) for row in rows)
        for title, section in groupby(rows, lambda row: row.section):
            with formatter.section(title):
                formatter.write_dl([(f"{row.name:{longest}}", row.summary) for row in section])

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
            if isinstance(error, ImportError) and interruption.signalled is not None:
                # A library that was being loaded has caught the interruption.
                aborted = click.Abort()
                print_answer(ctx, aborted)
                raise aborted from error
            if isinstance(error, ModuleNotFoundError):
                error = extras.explained(error) or error
            command = self.get_command(ctx, ctx.invoked_subcommand or "")
            told = explained(error, option_names(command))
            print_answer(ctx, told)
            raise told from error
        print_answer(ctx)
        return result


def with_extra(command: click.Command, extra: str | None) -> click.Command:
    """Return a command that names the extra that it lacks before it does anything; its help needs none."""
    run = command.callback
    if extra is None or run is None:
        return command

    @wraps(run)
    def checked(*arguments: Any, **options: Any) -> Any:
        extras.require(extra)
        return run(*arguments, **options)

    command.callback = checked
    return command


def writing_trace(path: Path | None) -> AbstractContextManager[None]:
    """Return what writes the frames of a block into a file; None = nowhere."""
    if path is None:
        return contextlib.nullcontext()
    from vibrocast.device_protocol.trace import tracer

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


class NotesHandler(logging.Handler):
    """Prints what a person should know of recordings, and while work goes on."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one line on stderr, whatever it quotes; above a bar where one is shown."""
        print(f"note: {plain(record.getMessage())}", file=sys.stderr)


logging.getLogger("vibrocast.textures").addHandler(NotesHandler(logging.WARNING))
notes.addHandler(NotesHandler())


def keep_log(path: Path) -> None:
    """Append the log of this program to a file. Raises OSError, then or later."""
    handler = LogFile(path, encoding="utf-8")
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    logger = logging.getLogger("vibrocast")
    for earlier in [each for each in logger.handlers if isinstance(each, logging.FileHandler)]:
        logger.removeHandler(earlier)
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)


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
    help="File for all frames: .pcapng or .jsonl.",
)
@click.option(
    "--log", "log_path", type=OutputFile(), metavar="FILE", help="File to which a log with times in UTC is appended."
)
@click.pass_context
def main(ctx: click.Context, debug: bool, trace_path: Path | None, log_path: Path | None) -> None:
    """Compress vibrotactile textures and play them in real time on an actuator."""
    if log_path is not None:
        keep_log(log_path)
        logging.getLogger(__name__).info("vibrocast %s: %s", version("vibrocast"), shlex.join(sys.argv[1:]))
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
