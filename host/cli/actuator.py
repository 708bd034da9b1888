"""The subcommand `actuator`: what an actuator is, and its constants for firmware."""

from dataclasses import asdict

import click

from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.cli.steps import show
from vibrocast.output import actuator_files
from vibrocast.output.actuator import followed_band_hz
from vibrocast.output.actuator_constants import board_source


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast actuator lra\nvibrocast actuator actuator.toml --c > board_actuator.c",
)
@click.argument("name", metavar="NAME|FILE")
@click.option("--c", "as_c", is_flag=True, help="Print the constants for firmware, as C.")
def actuator(name: str, as_c: bool) -> None:
    """Show an actuator, or write its constants for firmware.

    NAME is piezo-stack, lra or voice-coil. FILE is a TOML file, such as actuator.toml of `vibrocast measure`.
    """
    found = actuator_files.find(name)
    if as_c:
        text = board_source(found)
        tell(text.rstrip("\n"), c=text)
        return
    follows_hz = list(followed_band_hz(found) or ())
    limits = {"code_limit": found.code_limit, "code_step_limit": found.code_step_limit}
    show({**asdict(found), **limits, "band_hz": list(found.band_hz), "follows_hz": follows_hz})
