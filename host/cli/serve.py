"""The subcommand `serve`: plays the files of a folder as messages of Open Sound Control say."""

from pathlib import Path

import click

from vibrocast.errors import InputError
from vibrocast.host.cli.option_types import INPUT, Number
from vibrocast.host.cli.options import (
    RecordingOptions,
    device_option,
    grouped,
    lsl_option,
    rate_hz_option,
    unit_option,
)
from vibrocast.host.cli.sections import CONTROLLER, MORE, SectionedCommand, section
from vibrocast.host.devices import open_session
from vibrocast.host.lab_network import TIMEOUT_S, Markers, OscServer
from vibrocast.host.track_player import TrackOptions


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast serve textures --osc 9000\n"
    "vibrocast serve textures --osc 0.0.0.0:9000 --device serial:/dev/ttyACM0",
)
@click.argument("folder", type=INPUT)
@section(MORE, grouped("recording", RecordingOptions, rate_hz_option, unit_option))
@section(CONTROLLER, device_option)
@click.option(
    "--osc", "listen_at", required=True, metavar="[HOST:]PORT", help="Where to listen. Default host: 127.0.0.1."
)
@section(
    MORE,
    click.option(
        "--timeout",
        "timeout_s",
        type=Number("S", 0),
        default=TIMEOUT_S,
        show_default=True,
        help="Seconds without a message after which playing stops; 0: never.",
    ),
)
@section(MORE, lsl_option)
def serve(
    folder: Path, address: str, listen_at: str, timeout_s: float, has_markers: bool, recording: RecordingOptions
) -> None:
    """Play the files of a folder as OSC messages say.

    /play NAME plays a file, by its name in the folder; /play NAME LOOPS plays it so often, 0 without end. /gain_db DB
    sets the level. /pause, /resume and /stop do as they say, and /alive keeps a long texture alive. The client gets
    /track NAME, /ended NAME and /error TEXT.
    """
    host, _, port = listen_at.rpartition(":")
    host = host or "127.0.0.1"
    if not port.isdecimal():
        raise InputError(
            f"--osc {listen_at}: no port; give a number such as 9000, or 0.0.0.0:9000 for the whole network"
        )
    with open_session(address) as session:
        tell = Markers(session.address).tell if has_markers else None
        options = TrackOptions(facts=recording.facts())
        server = OscServer(session, folder, (host, int(port)), options, timeout_s=timeout_s, tell=tell)
        click.echo(f"listening at {host}:{server.port}; Ctrl-C ends")
        server.serve()
