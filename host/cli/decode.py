"""The subcommands that read .vct files: `decode` and `info`."""

from dataclasses import replace
from pathlib import Path

import click

from vibrocast import models, progress, textures
from vibrocast.codec.stream import read_stream, write_profile, write_recording
from vibrocast.host.cli.answers import tell, tell_profile
from vibrocast.host.cli.option_types import INPUT, OutputFile, reject_overwriting
from vibrocast.host.cli.options import model_option, runtime_option
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.cli.steps import files_of, show


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast decode oak.vct oak.wav\nvibrocast decode oak.vct oak.csv",
)
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(*textures.SAVED_SUFFIXES))
@model_option
@runtime_option
def decode(file: Path, out: Path, model: models.Model | None, runtime: str | None) -> None:
    """Decode a .vct file into a WAV, CSV, NPY or MAT file.

    The suffix of OUT chooses the format. The file holds physical values, exactly as decoded. WAV, CSV and MAT files
    state rate and unit, and vibrocast reads both again.

    A height profile becomes a CSV file.
    """
    reject_overwriting([out], [file, *files_of(model)])
    stream = replace(read_stream(file, model.image if model else None), runtime=runtime)
    if stream.header.spatial and out.suffix.lower() == ".csv":
        with progress.bar("decoding") as update:
            profile = write_profile(out, stream, progress=update)
        tell_profile(out, profile)
        return
    with progress.bar("decoding") as update:
        full_scale = write_recording(out, stream, progress=update)
    header = stream.header
    unit = f"1.0 is {full_scale:g} {header.unit}" if out.suffix.lower() == ".wav" else f"in {header.unit}"
    tell(
        f"{out}: {stream.seconds:.3f} s at {header.rate_hz} Hz, {unit}",
        out=str(out),
        seconds=stream.seconds,
        rate_hz=header.rate_hz,
        unit=header.unit,
        full_scale=full_scale,
    )


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast info oak.vct\nvibrocast info oak.vct --json",
)
@click.argument("file", type=INPUT)
@model_option
def info(file: Path, model: models.Model | None) -> None:
    """Show the codec, rate and content of a .vct file."""
    show(read_stream(file, model.image if model else None).facts())
