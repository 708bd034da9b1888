"""The subcommand `generate`: makes a texture, or its height profile, from a physical model."""

from pathlib import Path

import click

from vibrocast import textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.files import atomic_write
from vibrocast.host.cli.answers import tell, tell_profile
from vibrocast.host.cli.option_types import Number, OutputFile, Whole, positive
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.textures.recording import Signal


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast generate wood wood.wav\nvibrocast generate ridges ridges.csv --hand-speed-mm-s 80",
)
@click.argument("kind", type=click.Choice(sorted(textures.GENERATORS)))
@click.argument("out", type=OutputFile(".wav", ".csv"))
@click.option("--seed", type=Whole("NUMBER", 0), default=0, help="Number of the realisation of the texture.")
@click.option("--seconds", type=positive("s"), default=4.0, help="Seconds to generate.")
@click.option(
    "--hand-speed-mm-s",
    type=positive("mm/s"),
    default=50.0,
    help="Mean speed of the hand.",
)
@section(
    MORE,
    click.option(
        "--speed-variation",
        type=Number("FRACTION", 0, 2),
        default=0.0,
        help="Variation of the speed, once a second, as a fraction of its mean.",
    ),
)
def generate(kind: str, out: Path, seed: int, seconds: float, hand_speed_mm_s: float, speed_variation: float) -> None:
    """Generate a texture (.wav) or its height profile (.csv).

    KIND is a physical model of a surface or of taps. The suffix of OUT chooses the format.
    """
    if out.suffix.lower() == ".csv":
        if speed_variation:
            raise click.UsageError("a height profile is the same at any speed; drop --speed-variation")
        profile = textures.surface_profile(kind, seed, seconds, hand_speed_mm_s, DEFAULT_STREAM_RATE_HZ)
        with atomic_write(out) as partial:
            textures.save_profile(partial, profile)
        tell_profile(out, profile)
        return
    speed_mm_s: float | Signal = hand_speed_mm_s
    if speed_variation:
        speed_mm_s = textures.varying_speed(seconds, DEFAULT_STREAM_RATE_HZ, hand_speed_mm_s, speed_variation)
    recording = textures.GENERATORS[kind](seed, seconds, speed_mm_s, DEFAULT_STREAM_RATE_HZ)
    with atomic_write(out) as partial:
        full_scale = textures.save(partial, recording, sixteen_bit=True)
    tell(
        f"{out}: {recording.seconds:.3f} s at {recording.rate_hz:g} Hz, 1.0 is {full_scale:g} {recording.unit}",
        out=str(out),
        seconds=recording.seconds,
        rate_hz=recording.rate_hz,
        unit=recording.unit,
        full_scale=full_scale,
    )
