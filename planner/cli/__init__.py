"""The subcommand of the planner."""

from vibrocast.host.cli.commands import Subcommand

COMMANDS = (
    Subcommand(
        "plan",
        "Play",
        "vibrocast.planner.cli.plan:plan",
        "Choose the cheapest codec settings that meet your requirements.",
        "plan",
    ),
)
