"""The subcommand of listening studies."""

from vibrocast.host.cli.commands import Subcommand

COMMANDS = (
    Subcommand(
        "study", "Studies", "vibrocast.study.cli.study:study", "Check, run, simulate and report listening studies."
    ),
)
