"""Subcommands of the evaluation."""

from vibrocast.host.cli.commands import Subcommand

CLI = "vibrocast.evaluation.cli"
COMMANDS = (
    Subcommand(
        "bench",
        "Measure and compare",
        f"{CLI}.bench:bench",
        "Measure codecs and trained models on a folder of recordings.",
        "bench",
    ),
    Subcommand(
        "stability",
        "Measure and compare",
        f"{CLI}.stability:stability",
        "Map where each codec holds and where it fails.",
        "bench",
    ),
)
