"""The answer of a subcommand: lines for a person, or with --json one value for a program."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vibrocast.host.cli import interruption, json_option

if TYPE_CHECKING:
    from vibrocast.textures import Profile

_KEY = "vibrocast.answer"
_SO_FAR = "vibrocast.figures_so_far"


def begin(ctx: click.Context, arguments: Sequence[str]) -> None:
    """Let the command with these arguments answer in JSON if they ask for it, whatever is wrong with the others."""
    if json_option.is_given(arguments):
        ctx.meta[_KEY] = None


def finished(command: click.Command) -> click.Command:
    """Return a command whose help shows defaults; each of its subcommands, or itself, has the option --json."""
    for parameter in command.params:
        if isinstance(parameter, click.Option) and parameter.show_default is None:
            parameter.show_default = True
    if isinstance(command, click.Group):
        for inner in command.commands.values():
            finished(inner)
    elif not any(json_option.OPTION in parameter.opts for parameter in command.params):
        command.params.append(click.Option([json_option.OPTION], is_flag=True, expose_value=False, help="Print JSON."))
    return command


def wants_json() -> bool:
    """Return whether the command under way answers in JSON."""
    ctx = click.get_current_context(silent=True)
    return ctx is not None and _KEY in ctx.meta


def tell(text: str, **facts: Any) -> None:
    """Print a line; in JSON, add these facts to the answer instead."""
    if wants_json():
        add(facts)
    else:
        click.echo(text)


def tell_profile(out: Path, profile: "Profile") -> None:
    """Tell which height profile a file holds now."""
    tell(
        f"{out}: {profile.length_mm:g} mm, a height every {profile.spacing_um:g} um",
        out=str(out),
        length_mm=profile.length_mm,
        spacing_um=profile.spacing_um,
    )


def add(facts: Mapping[str, Any]) -> None:
    """Add facts to an answer in JSON."""
    if wants_json():
        meta = click.get_current_context().meta
        meta[_KEY] = {**(meta[_KEY] or {}), **facts}


def answer(document: Any) -> None:
    """Make a value that is ready for JSON the whole answer in JSON."""
    if wants_json():
        click.get_current_context().meta[_KEY] = document


def figures_so_far(read: Callable[[], Mapping[str, Any] | None]) -> None:
    """Add what `read` returns to the answer in JSON if the command under way is interrupted."""
    click.get_current_context().meta[_SO_FAR] = read


def print_answer(ctx: click.Context, error: BaseException | None = None) -> None:
    """Print the answer in JSON, if that is wanted, with the error that ended the command, if any."""
    if _KEY not in ctx.meta:
        return
    document = ctx.meta.pop(_KEY)
    if isinstance(error, click.ClickException):
        document = _failed(document, error.format_message(), error.exit_code)
    elif isinstance(error, (click.Abort, KeyboardInterrupt)):
        if _SO_FAR in ctx.meta:
            document = {**(document or {}), **(ctx.meta[_SO_FAR]() or {})}
        document = _failed(document, "interrupted", interruption.exit_code_of(interruption.signalled))
    if document is not None:  # else the command has printed lines of its own, such as JSON, one object each
        alone = isinstance(document, dict) and document.keys() == {"error", "exit_code"}
        click.echo(json.dumps(document, indent=None if alone else 2, allow_nan=False, default=str))


def _failed(document: Any, error: str, exit_code: int) -> dict[str, Any]:
    """Return an answer with the error that ended the command; a list stands in it as `results`."""
    facts = {"results": document} if isinstance(document, list) else document or {}
    return {**facts, "error": error, "exit_code": exit_code}
