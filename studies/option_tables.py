"""A hook of the documentation site: mkdocs-click writes the options of a command as its help groups and words them.

mkdocs-click has no groups, and prints the internal values of defaults and ranges.
"""

import html
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import click
import mkdocs_click._docs


class Recorder(click.HelpFormatter):
    """Takes the help of a command and keeps its sections. `sections`: rows of (option, text) by heading."""

    def __init__(self) -> None:
        super().__init__()
        self.sections: dict[str, list[tuple[str, str]]] = {}
        self._heading = ""

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Give the rows that follow a heading."""
        outer, self._heading = self._heading, name
        yield
        self._heading = outer

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        """Keep rows."""
        self.sections.setdefault(self._heading, []).extend(rows)


def option_tables(context: click.Context, *_: Any, **__: Any) -> Iterator[str]:
    """Yield the lines of a Markdown table for each group of options in the help of a command."""
    recorder = Recorder()
    command = context.command
    if isinstance(command, click.Group):
        click.Command.format_options(command, context, recorder)  # its subcommands have sections of their own
    else:
        command.format_options(context, recorder)
    for heading, rows in recorder.sections.items():
        yield from (f"| {heading} | |", "|---|---|")
        for option, text in rows:
            if context.parent and option == "-h, --help":
                continue  # every command has it
            described = html.escape(" ".join(text.split()), quote=False).replace("*", r"\*").replace("[", r"\[")
            yield f"| `{option}` | {described} |"
        yield ""


def on_startup(**_: Any) -> None:
    """Put the tables in the place of those of mkdocs-click."""
    if not hasattr(mkdocs_click._docs, "_make_options"):
        raise AttributeError("this release of mkdocs-click writes options elsewhere; adapt studies/option_tables.py")
    mkdocs_click._docs._make_options = option_tables
