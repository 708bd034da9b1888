"""The subcommand `convert`: turns a haptic clip into a recording, or a texture into a clip."""

from dataclasses import asdict
from pathlib import Path

import click

from vibrocast import textures
from vibrocast.codec import clip_export
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.coded_stream import STREAM_SUFFIX
from vibrocast.files import atomic_write
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import INPUT, OutputFile, reject_overwriting
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.textures import clips


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast convert examples/clips/knock.ahap knock.wav\nvibrocast convert examples/taps.wav taps.haptic",
)
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(*textures.SAVED_SUFFIXES, *clips.WRITERS))
def convert(file: Path, out: Path) -> None:
    """Convert a clip into a recording, or a texture into a clip.

    The suffix of OUT chooses. A clip is rendered at 8000 Hz. The answer names the constants that its format leaves
    open, and the parts that are left out.

    A recording or a .vct file becomes one sine, whose amplitude and frequency change over time. The answer states the
    quality that remains.
    """
    reject_overwriting([out], [file])
    coded = file.suffix.lower() == STREAM_SUFFIX
    recording = read_stream(file).recording(file.stem) if coded else textures.load(file)
    if out.suffix.lower() in clips.WRITERS:
        write_clip(out, recording)
        return
    with atomic_write(out) as partial:
        full_scale = textures.save(partial, recording)
    tell(
        f"{out}: {recording.seconds:.3f} s at {recording.rate_hz:g} Hz, 1.0 is {full_scale:g} {recording.unit}",
        out=str(out),
        seconds=recording.seconds,
        rate_hz=recording.rate_hz,
        unit=recording.unit,
        full_scale=full_scale,
        notes=recording.notes,
    )
    for note in recording.notes:
        tell(f"  {note}")


def write_clip(out: Path, recording: textures.Recording) -> None:
    """Write a texture as a clip, and tell what remains of it."""
    with atomic_write(out) as partial:
        export = clip_export.export(partial, recording)
    quality, range_hz = export.quality, clips.WRITERS[out.suffix.lower()].range_hz
    measures = {
        "SNR": quality.snr_db,
        "third-octave distance": quality.third_octave_distance_db,
        "log spectral distance": quality.log_spectral_distance_db,
    }
    tell(
        f"{out}: {recording.seconds:.3f} s, amplitude 1 is {export.full_scale:.3g} {recording.unit}",
        out=str(out),
        **asdict(export),
        unit=recording.unit,
        seconds=recording.seconds,
    )
    tell("  " + ", ".join(f"{name} {value:.1f} dB" for name, value in measures.items() if value is not None))
    limited = f"{100 * export.limited_energy:.1f} % of the energy"
    tell(f"  frequency limited to {range_hz[0]:g} to {range_hz[1]:g} Hz: {limited}")
