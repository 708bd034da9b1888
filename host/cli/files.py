"""The subcommands on files: `encode`, `decode`, `info`, `codecs` and `generate`."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from vibrocast import codec, models, progress, textures
from vibrocast.codec import rate_controlled
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, Encoding
from vibrocast.codec.stream import read_stream, write_profile, write_recording
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.files import atomic_write
from vibrocast.host import profiles
from vibrocast.host.cli import planned
from vibrocast.host.cli.options import (
    INPUT,
    POSITIVE,
    Finite,
    OutputFile,
    model_option,
    plan_option,
    quality_of,
    quality_options,
    recording_options,
    runtime_option,
)
from vibrocast.host.cli.rate_options import rate_controlled_options, rate_target_of
from vibrocast.host.cli.steps import (
    encoded,
    encoded_profile,
    files_of,
    reject_overwriting,
    show,
    told_quality,
)
from vibrocast.host.plain import plain


@click.command()
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(".vct"))
@click.option("--spatial", is_flag=True, help="Code a height profile to be played by the position of a hand.")
@click.option(
    "--slowest-hand-speed-mm-s",
    type=POSITIVE,
    default=profiles.SLOWEST_MM_S,
    show_default=True,
    help="With --spatial: the pitch is chosen for this speed.",
)
@plan_option
@quality_options
@rate_controlled_options
@recording_options
def encode(
    file: Path, out: Path, spatial: bool, slowest_hand_speed_mm_s: float, plan_path: Path | None, **choices: Any
) -> None:
    """Code a recording, or with --plan the texture that FILE names, into a .vct file."""
    if plan_path is not None:
        tell_encoded(out, planned.read(plan_path, ("file", "out")).texture(str(file)).encode())
        return
    reject_overwriting([out], [file, *files_of(choices["model"])])
    target = rate_target_of(choices)
    quality = quality_of(choices)
    if spatial:
        if target is not None:
            raise click.UsageError("a profile has no time: no rate or quality over time can be kept in it.")
        encoding = encoded_profile(profiles.recording_of(file, **choices), quality, slowest_hand_speed_mm_s)
        facts = encoding.stream.facts()
        click.echo(
            f"{out}: {facts['size_bytes']} bytes, {facts['length_mm']:.3f} mm, {facts['samples_per_metre']} samples "
            f"per metre, {facts['bits_per_mm']:.0f} bit/mm"
        )
        encoding.stream.save(out)
        return
    if target is not None:
        encode_rate_controlled(textures.load(file, **choices), out, target, quality)
        return
    tell_encoded(out, encoded(textures.load(file, **choices), quality, live=False))


def tell_encoded(out: Path, encoding: Encoding) -> None:
    """Write a .vct file, and tell its size and quality."""
    encoding.stream.save(out)
    stream = encoding.stream
    model = f", model {stream.model_name}" if stream.image else ""
    click.echo(
        f"{out}: {stream.size_bytes} bytes, {stream.bits_per_second:.0f} bit/s{model}, {told_quality(encoding.quality)}"
    )


def encode_rate_controlled(
    recording: textures.Recording, out: Path, target: rate_controlled.RateTarget, quality: dict[str, Any]
) -> None:
    """Code a recording as a live stream into a .vct file, and print how rate and quality came out."""
    del quality["rate_bps"], quality["snr_db"]  # they are in the target
    with progress.bar("encoding") as update:
        stream, outcome = rate_controlled.encode(recording, target, progress=update, **quality)
    stream.save(out)
    window = "" if outcome.furthest is None else f", furthest from it over 2 s: {100 * outcome.furthest:+.2f} %"
    asked = "" if target.rate_bps is None else f" of {target.rate_bps:g}{window}"
    low_db, high_db = outcome.snr_range_db
    snr = (
        "silent"
        if math.isnan(outcome.snr_db)
        else f"{outcome.snr_db:.2f} dB, 90 % within {low_db:.1f} to {high_db:.1f}"
    )
    lines = {
        str(out): f"{stream.size_bytes} bytes, codec {stream.codec_name}"
        + (f", model {stream.model_name}" if stream.image else ""),
        "rate": f"{outcome.sent_bps:.0f} bit/s{asked}",
        "of it": f"packets {outcome.packets_bps:.0f} bit/s, to which frames add {100 * outcome.frames_add:.1f} %; "
        f"padding {100 * outcome.padding:.1f} %",
        "packets": f"{1000 * outcome.packet_s:.1f} ms each, SNR {snr}",
    }
    show(lines)


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def codecs(as_json: bool) -> None:
    """List the codecs and the parameters of their settings."""
    facts = {
        known.name: {
            "summary": known.summary,
            "rate control": "yes" if known.controls_rate else "no, all packets are of one quality",
            **{
                name: f"{parameter.meaning}: {parameter.range}; {parameter.default} if not given"
                for name, parameter in known.parameters.items()
            },
        }
        for known in codec.CODECS.values()
    }
    # Parameters are named as --setting takes them.
    lines = {name: [f"{key}: {text}" for key, text in about.items()] for name, about in facts.items()}
    show(facts if as_json else lines, as_json)
    for name, cause in codec.CODECS.failures.items():
        click.echo(
            plain(f"warning: the codec {name} cannot be loaded: {cause}; repair or remove its package"), err=True
        )


@click.command()
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(*textures.SAVED_SUFFIXES))
@click.option(
    "--format",
    "sample_format",
    type=click.Choice(("float", "16-bit")),
    default="float",
    show_default=True,
    help="Choose the samples of a WAV file.",
)
@model_option
@runtime_option
def decode(file: Path, out: Path, sample_format: str, model: models.Model | None, runtime: str | None) -> None:
    """Decode a .vct file into a WAV, CSV, NPY or MAT file, or a height profile into a CSV file.

    The file holds physical values, exactly as decoded; a WAV file of 16 bit is relative to a full scale. All but NPY
    state rate and unit, from which this program knows them again.
    """
    sixteen_bit = sample_format == "16-bit"
    if sixteen_bit and out.suffix.lower() != ".wav":
        raise click.UsageError("--format is for a WAV file; drop it.")
    reject_overwriting([out], [file, *files_of(model)])
    stream = replace(read_stream(file, model.image if model else None), runtime=runtime)
    if stream.header.spatial and out.suffix.lower() == ".csv":
        with progress.bar("decoding") as update:
            profile = write_profile(out, stream, progress=update)
        click.echo(f"{out}: {profile.length_mm:g} mm, a height every {profile.spacing_um:g} um")
        return
    with progress.bar("decoding") as update:
        full_scale = write_recording(out, stream, sixteen_bit, progress=update)
    header = stream.header
    unit = f"1.0 is {full_scale:g} {header.unit}" if out.suffix.lower() == ".wav" else f"in {header.unit}"
    click.echo(f"{out}: {stream.seconds:.3f} s at {header.rate_hz} Hz, {unit}")


@click.command()
@click.argument("file", type=INPUT)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@model_option
def info(file: Path, as_json: bool, model: models.Model | None) -> None:
    """Show what a .vct file holds."""
    show(read_stream(file, model.image if model else None).facts(), as_json)


@click.command()
@click.argument("kind", type=click.Choice(sorted(textures.GENERATORS)))
@click.argument("out", type=OutputFile(".wav", ".csv"))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another texture.")
@click.option("--seconds", type=POSITIVE, default=4.0, show_default=True)
@click.option("--rate-hz", type=click.IntRange(1, MAX_RATE_HZ), default=DEFAULT_STREAM_RATE_HZ, show_default=True)
@click.option("--hand-speed-mm-s", type=POSITIVE, default=50.0, show_default=True, help="Mean speed of the hand.")
@click.option(
    "--speed-variation",
    type=Finite(min=0, max=2),
    default=0.0,
    show_default=True,
    help="How far the speed swings to either side of its mean, in parts of it, once a second; above 1 it turns back.",
)
def generate(kind: str, out: Path, speed_variation: float, **choices: Any) -> None:
    """Make a texture as a WAV file, or its height profile as a CSV file."""
    if out.suffix.lower() == ".csv":
        if speed_variation:
            raise click.UsageError("a height profile is the same at any speed: drop --speed-variation.")
        profile = textures.surface_profile(kind, **choices)
        with atomic_write(out) as partial:
            textures.save_profile(partial, profile)
        click.echo(f"{out}: {profile.length_mm:g} mm, a height every {profile.spacing_um:g} um")
        return
    if speed_variation:
        mean_mm_s = choices["hand_speed_mm_s"]
        choices["hand_speed_mm_s"] = textures.varying_speed(
            choices["seconds"], choices["rate_hz"], mean_mm_s, speed_variation
        )
    recording = textures.GENERATORS[kind](**choices)
    with atomic_write(out) as partial:
        full_scale = textures.save(partial, recording, sixteen_bit=True)
    click.echo(f"{out}: {recording.seconds:.3f} s at {recording.rate_hz:g} Hz, 1.0 is {full_scale:g} {recording.unit}")
