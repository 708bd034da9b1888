"""Subcommands of the test harness."""

from vibrocast.host.cli.commands import Subcommand

CLI = "vibrocast.harness.cli"
COMMANDS = (
    Subcommand(
        "record",
        "Compress",
        f"{CLI}.record:record",
        "Record an accelerometer or a displacement sensor into a WAV file.",
    ),
    Subcommand(
        "monitor",
        "See and break the wire",
        f"{CLI}.wire:monitor",
        "Show the frames between a host and a controller as they pass.",
    ),
    Subcommand(
        "replay",
        "See and break the wire",
        f"{CLI}.wire:replay",
        "Show, sum up, decode or send again the frames of a trace.",
    ),
    Subcommand(
        "proxy",
        "See and break the wire",
        f"{CLI}.wire:proxy",
        "Put a wire with faults between a host and a controller.",
    ),
    Subcommand(
        "measure",
        "Measure and compare",
        f"{CLI}.measure:measure",
        "Measure the latency, load, fidelity and response of a controller.",
        "bench",
    ),
    Subcommand(
        "conformance",
        "Measure and compare",
        f"{CLI}.conformance:conformance",
        "Test a controller against the protocol.",
        "bench",
    ),
)
