"""The table of subcommands: the core's own, and those that products add by the entry points `vibrocast.commands`."""

import importlib
from functools import cache
from importlib.metadata import entry_points
from typing import NamedTuple

import click

GROUP = "vibrocast.commands"
SECTIONS = (
    "Compress",
    "Play",
    "Controllers",
    "See and break the wire",
    "Measure and compare",
    "Studies",
    "Learned codecs",
)
"""The headings of `vibrocast --help`, in their order."""


class Subcommand(NamedTuple):
    """A row of the table.

    `section`: one of SECTIONS. `target`: "module:attribute" of its click command, which loads at its first use.
    `summary`: at most 67 characters, the first paragraph of its docstring. `extra`: the extra that it needs, if any.
    """

    name: str
    section: str
    target: str
    summary: str
    extra: str | None = None

    def load(self) -> click.Command:
        """Import the command."""
        module, _, attribute = self.target.partition(":")
        command = getattr(importlib.import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command


CLI = "vibrocast.host.cli"
CORE = (
    Subcommand(
        "generate", "Compress", f"{CLI}.generate:generate", "Generate a texture (.wav) or its height profile (.csv)."
    ),
    Subcommand("encode", "Compress", f"{CLI}.encode:encode", "Code a recording into a .vct file."),
    Subcommand("decode", "Compress", f"{CLI}.decode:decode", "Decode a .vct file into a WAV, CSV, NPY or MAT file."),
    Subcommand(
        "convert", "Compress", f"{CLI}.convert:convert", "Convert a clip into a recording, or a texture into a clip."
    ),
    Subcommand("info", "Compress", f"{CLI}.decode:info", "Show the codec, rate and content of a .vct file."),
    Subcommand("codecs", "Compress", f"{CLI}.codecs:codecs", "List the codecs and their parameters."),
    Subcommand("play", "Play", f"{CLI}.play:play", "Play recordings, .vct files, folders and .m3u lists of them."),
    Subcommand(
        "live", "Play", f"{CLI}.live:live", "Stream a sensor, sound, standard input or a texture to a controller."
    ),
    Subcommand("serve", "Play", f"{CLI}.serve:serve", "Play the files of a folder as OSC messages say.", "lab"),
    Subcommand("render", "Play", f"{CLI}.render:render", "Write the drive signal of a recording as a WAV file."),
    Subcommand(
        "devices",
        "Controllers",
        f"{CLI}.devices:list_devices",
        "List addresses: simulated, serial, USB and sound cards.",
    ),
    Subcommand("status", "Controllers", f"{CLI}.devices:status", "Show the properties and state of a controller."),
    Subcommand("upload", "Controllers", f"{CLI}.devices:upload_model", "Upload a trained model to controllers."),
    Subcommand("flash", "Controllers", f"{CLI}.devices:flash_model", "Upload a trained model to controllers."),
    Subcommand("simulate", "Controllers", f"{CLI}.devices:simulate", "Run a simulated controller until Ctrl-C."),
    Subcommand(
        "actuator",
        "Controllers",
        f"{CLI}.actuator:actuator",
        "Show an actuator, or write its constants for firmware.",
    ),
    Subcommand(
        "models", "Learned codecs", f"{CLI}.codecs:list_models", "List the shipped models, with rate and quality."
    ),
)


@cache
def subcommands() -> dict[str, Subcommand]:
    """Return all subcommands by name. An entry point names a sequence of Subcommand, in a module that loads at once.

    One that cannot be loaded costs only its own commands, and a warning.
    """
    products: list[Subcommand] = []
    for entry in sorted(entry_points(group=GROUP)):
        try:
            products += entry.load()
        except Exception as error:  # of another package's code
            told = f"warning: the commands of {entry.name} cannot be loaded: {error}; repair or remove its package"
            click.echo(told, err=True)
    return {each.name: each for section in SECTIONS for each in (*CORE, *products) if each.section == section}
