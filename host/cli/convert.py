"""The subcommand `convert`: turns a haptic clip into a recording."""

from pathlib import Path

import click

from vibrocast import textures
from vibrocast.files import atomic_write
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import INPUT, OutputFile, reject_overwriting


@click.command()
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(*textures.SAVED_SUFFIXES))
def convert(file: Path, out: Path) -> None:
    """Convert a haptic clip into a recording.

    The clip is rendered at 8000 Hz. The answer names the constants that its format leaves open, and what was left out.
    """
    reject_overwriting([out], [file])
    recording = textures.load(file)
    with atomic_write(out) as partial:
        full_scale = textures.save(partial, recording)
    facts = {"seconds": recording.seconds, "rate_hz": recording.rate_hz, "unit": recording.unit}
    tell(
        f"{out}: {recording.seconds:.3f} s at {recording.rate_hz:g} Hz, 1.0 is {full_scale:g} {recording.unit}",
        out=str(out),
        **facts,
        full_scale=full_scale,
        notes=recording.notes,
    )
    for note in recording.notes:
        tell(f"  {note}")
