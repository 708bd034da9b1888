"""The help of a command: its options in sections, rare ones last, and examples."""

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import click

from vibrocast.host.cli import json_option

# The titles, in the order in which commands with several of them list them.
INPUT = "Input"
CODING = "Codec and quality"
CONTROLLER = "Controller and actuator"
PLAYBACK = "Playback"
RUN = "Run"
OUTPUT = "Output"
OTHERS = "Options"
MORE = "More options"
"""The last section: options that few people need, and those of every command."""

_titles: WeakKeyDictionary[click.Parameter, str] = WeakKeyDictionary()


def section(title: str, *options: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Return one decorator for options, which the help of a SectionedCommand lists under a title."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        before = len(_parameters(command))
        for option in reversed(options):
            command = option(command)
        for parameter in _parameters(command)[before:]:
            _titles.setdefault(parameter, title)
        return command

    return decorate


def _parameters(command: Callable[..., Any]) -> list[click.Parameter]:
    """Return what click has noted on a function so far, the last option first."""
    return getattr(command, "__click_params__", [])


class SectionedCommand(click.Command):
    """A command whose help has a section for each title of its options. Its `epilog` has an example in each line."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections, in the order of their first options, and MORE at the end."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for option in self.get_params(ctx):
            record = option.get_help_record(ctx)
            if isinstance(option, click.Option) and record is not None:
                of_every_command = option.opts[0] in (json_option.OPTION, *ctx.help_option_names)
                sections.setdefault(_titles.get(option, MORE if of_every_command else OTHERS), []).append(record)
        more = sections.pop(MORE)
        sections[MORE if sections else OTHERS] = more
        for title, records in sections.items():
            with formatter.section(title):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples as they are."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")
