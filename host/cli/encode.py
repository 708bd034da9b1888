"""The subcommand `encode`: codes a recording or a height profile into a .vct file."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from vibrocast import progress, textures
from vibrocast.codec import profiles, rate_controlled
from vibrocast.codec.encoding import Encoding
from vibrocast.host.cli.answers import add, tell, wants_json
from vibrocast.host.cli.option_types import INPUT, OutputFile, positive, reject_overwriting
from vibrocast.host.cli.options import (
    QualityOptions,
    RecordingOptions,
    quality_options,
    recording_options,
)
from vibrocast.host.cli.rate_options import RateOptions, rate_controlled_options
from vibrocast.host.cli.sections import SectionedCommand, section
from vibrocast.host.cli.steps import (
    describe_felt_error,
    describe_quality,
    encoded,
    encoded_profile,
    files_of,
    show,
)


@click.command(cls=SectionedCommand)
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(".vct"))
@recording_options
@quality_options
@rate_controlled_options
@section(
    "Height profile under a hand",
    click.option("--spatial", is_flag=True, help="Code a height profile over position, for a moving hand."),
    click.option(
        "--slowest-hand-speed-mm-s",
        type=positive("mm/s"),
        default=profiles.SLOWEST_MM_S,
        show_default=True,
        help="Choose the pitch of heights for this speed, with --spatial.",
    ),
    click.option(
        "--crossfade",
        is_flag=True,
        help="Fade the end of the profile into its beginning, with --spatial. Default: it repeats as it is.",
    ),
)
def encode(
    file: Path,
    out: Path,
    spatial: bool,
    slowest_hand_speed_mm_s: float,
    crossfade: bool,
    quality: QualityOptions,
    rate: RateOptions,
    recording: RecordingOptions,
) -> None:
    """Code a recording into a .vct file.

    --rate-bps and --snr-db apply to the file as a whole. The options of rate control code it as a live stream, and
    hold a target over time.
    """
    reject_overwriting([out], [file, *files_of(quality.model)])
    target = rate.target(quality.snr_db, quality.rate_bps)
    if spatial:
        if target is not None or rate.packet_ms is not None:
            raise click.UsageError(
                "a profile has no time, so nothing can be held over time; drop the options of rate control"
            )
        profile = profiles.recording_of(file, **vars(recording))
        encoding = encoded_profile(profile, quality, slowest_hand_speed_mm_s, crossfade)
        facts = encoding.stream.facts()
        tell(
            f"{out}: {facts['size_bytes']} bytes, {facts['length_mm']:.3f} mm, {facts['samples_per_metre']} samples "
            f"per metre, {facts['bits_per_mm']:.0f} bit/mm",
            out=str(out),
            **facts,
        )
        encoding.stream.save(out)
        return
    loaded = textures.load(file, **vars(recording))
    if target is not None:
        encode_rate_controlled(loaded, out, target, quality.arguments(recording.unit))
        return
    encoding = encoded(loaded, quality, recording.unit, live=False, packet_s=rate.packet_s)
    write_encoding(out, encoding)


def write_encoding(out: Path, encoding: Encoding) -> None:
    """Write a .vct file, and print its size and quality."""
    encoding.stream.save(out)
    stream = encoding.stream
    model = f", model {stream.model_name}" if stream.image else ""
    size = f"{stream.size_bytes} bytes, {stream.bits_per_second:.0f} bit/s{model}"
    felt = encoding.quality.felt_error
    tell(
        f"{out}: {size}, {describe_quality(encoding.quality)}"
        + ("" if felt is None else f"; felt error: {describe_felt_error(felt)}"),
        out=str(out),
        **stream.facts(),
        quality=asdict(encoding.quality),
    )


def encode_rate_controlled(
    recording: textures.Recording, out: Path, target: rate_controlled.RateTarget, arguments: dict[str, Any]
) -> None:
    """Code a recording as a live stream into a .vct file, and print the rate and quality reached."""
    del arguments["rate_bps"], arguments["snr_db"]  # they are in the target
    with progress.bar("encoding") as update:
        stream, outcome = rate_controlled.encode(recording, target, progress=update, **arguments)
    stream.save(out)
    quality = stream.quality
    assert quality is not None, "it has just been coded"
    lines = {
        str(out): f"{stream.size_bytes} bytes, codec {stream.codec_name}"
        + (f", model {stream.model_name}" if stream.image else ""),
        "coded": describe_quality(quality),
        "felt error": describe_felt_error(quality.felt_error),
        "rate": describe_rate(target, outcome),
        "framing": f"packets {outcome.packets_bps:.0f} bit/s, frames add {100 * outcome.frames_add:.1f} %, "
        f"padding {100 * outcome.padding:.1f} %",
        "packets": f"{1000 * outcome.packet_s:.1f} ms each, {describe_packets(outcome)}",
    }
    if wants_json():
        add({"out": str(out), **stream.facts(), "quality": asdict(quality), "rate_control": asdict(outcome)})
    else:
        show(lines)


def describe_rate(target: rate_controlled.RateTarget, outcome: rate_controlled.Outcome) -> str:
    """Return the rate with its frames, and how a target was held, in words."""
    mean = f"{outcome.sent_bps:.0f} bit/s"
    if target.capped_rate_bps is not None and outcome.peak_bps is not None:
        return f"{mean} on average, at most {outcome.peak_bps:.0f} over 2 s; limit {target.capped_rate_bps:g}"
    off = "" if outcome.furthest is None else f", at most {100 * abs(outcome.furthest):.2f} % off over 2 s"
    return f"{mean} of {target.rate_bps:g}{off}"


def describe_packets(outcome: rate_controlled.Outcome) -> str:
    """Return the SNR of the packets in words."""
    if math.isnan(outcome.snr_db):
        return "no SNR: the recording is silent"
    low_db, high_db = outcome.snr_range_db
    return f"SNR {outcome.snr_db:.2f} dB, 90 % within {low_db:.1f} to {high_db:.1f} dB"
