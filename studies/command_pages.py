"""A hook of the documentation site: a page for each command, and their list on the page of the command line."""

import html
import inspect
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import groupby
from typing import Any

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from vibrocast.host.cli.command_line import main
from vibrocast.host.cli.commands import subcommands

LIST = "reference/cli/index.md"


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


def option_tables(context: click.Context) -> Iterator[str]:
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
            described = html.escape(" ".join(text.split()), quote=False).replace("*", r"\*").replace("[", r"\[")
            breakable = option.replace("|", "|\u200b")  # a long list of choices may wrap
            yield f"| `{breakable}` | {described} |"
        yield ""


def described(context: click.Context, heading: str) -> Iterator[str]:
    """Yield the lines of Markdown of a command, and of its subcommands below it."""
    command = context.command
    yield from (f"{heading} {context.command_path}", "", inspect.cleandoc(command.help or ""), "")
    yield from ("```text", command.get_usage(context).removeprefix("Usage: "), "```", "")
    if command.epilog:
        yield from ("```console", *(f"$ {line}" for line in command.epilog.splitlines()), "```", "")
    yield from option_tables(context)
    for name, inner in command.commands.items() if isinstance(command, click.Group) else ():
        yield from described(click.Context(inner, context, name), f"{heading}#")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each command, and list it below that of the command line."""
    whole = click.Context(main, info_name="vibrocast")
    pages: list[Any] = [LIST]
    for name in subcommands():
        command = main.get_command(whole, name)
        assert command is not None
        page = f"reference/cli/{name}.md"
        files.append(
            File.generated(config, page, content="\n".join(described(click.Context(command, whole, name), "#")))
        )
        pages.append({name: page})
    (reference,) = (each["Reference"] for each in config.nav or () if "Reference" in each)
    reference[reference.index({"Command line": LIST})] = {"Command line": pages}
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Add the list of commands, and the options that come before a command, to the page of the command line."""
    if page.file.src_uri != LIST:
        return markdown
    lines = [markdown, ""]
    for title, rows in groupby(subcommands().values(), lambda row: row.section):
        lines += [f"## {title}", "", "| command | purpose |", "|---|---|"]
        lines += [f"| [{row.name}]({row.name}.md) | {row.summary} |" for row in rows] + [""]
    return "\n".join([*lines, "## Before the command", "", *option_tables(click.Context(main, info_name="vibrocast"))])
