"""The errors of the `vibrocast` command: what the library raises, in words for a person and with an exit code."""

import errno
from collections.abc import Mapping

import click

from vibrocast.errors import BAD_INPUT, FAILED, VibrocastError
from vibrocast.host.cli.commands import subcommands

FLAGS = {"highpass_hz=None": "keep_dc"}
"""Settings of the library's parameters that a flag of another name makes."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class CommandError(click.ClickException):
    """An error that ends the command with this exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code  # type: ignore[misc]  # of the class in click


def option_names(command: click.Command | None) -> dict[str, str]:
    """Return the options of a subcommand by the parameters of the library that they set.

    A command for one file with some of the options that complete it refers to `encode`, which has all.
    """
    options = [each for each in (command.params if command else ()) if each.opts[0].startswith("--")]
    named = {each.opts[0].removeprefix("--").replace("-", "_"): each.opts[0] for each in options}
    named |= {each.name: each.opts[0] for each in options if each.name}
    named |= {setting: named[flag] for setting, flag in FLAGS.items() if flag in named}
    arguments = [each.name for each in (command.params if command else ()) if isinstance(each, click.Argument)]
    if command is None or command.name == "encode" or "unit" not in named or arguments[0] not in ("file", "files"):
        return named
    coding = subcommands()["encode"].load()
    return {name: f"`vibrocast encode {option}`" for name, option in option_names(coding).items()} | named


def explained(error: Exception, options: Mapping[str, str]) -> CommandError:
    """Return the exception that tells a person what went wrong and what to do, with its exit code.

    `options`: as of `option_names`.
    """
    if isinstance(error, VibrocastError):
        return CommandError(error.told(options), error.exit_code)
    if isinstance(error, MemoryError):
        return CommandError("not enough memory for this recording; cut it into shorter ones", BAD_INPUT)
    if not isinstance(error, OSError):
        text = f"unexpected {type(error).__name__}: {error}; `vibrocast --debug ...` shows where, please report it"
        return CommandError(text, FAILED)
    text = str(error)
    if error.errno in DISK_FULL:
        text = f"{error.filename or 'the output'}: {error.strerror}; free some space, or write elsewhere"
    elif error.filename:
        text = f"{error.filename}: {error.strerror}; check the name and your permissions"
    return CommandError(text, BAD_INPUT)


def controllers_failed(exit_codes: Mapping[str, int], controllers: int) -> CommandError:
    """Return the error where some of several controllers failed: with the exit code that they share, else FAILED."""
    codes = set(exit_codes.values())
    return CommandError(
        f"{len(exit_codes)} of {controllers} controllers failed: {', '.join(exit_codes)}; the line of each says why",
        codes.pop() if len(codes) == 1 else FAILED,
    )
