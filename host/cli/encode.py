"""The subcommand `encode`: codes a recording or a height profile into a .vct file."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from vibrocast import codec, progress, textures
from vibrocast.codec.encoding import Encoding, encode_recording
from vibrocast.codec.rate_control import Outcome, RateTarget
from vibrocast.codec.stream import Stream
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.describe import describe_felt_error, describe_removed, describe_snr
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, positive, reject_overwriting
from vibrocast.host.cli.options import (
    QualityOptions,
    RecordingOptions,
    grouped,
    hand_speed_option,
    model_option,
    rate_hz_option,
    rate_target,
    snr_db_option,
    stream_rate_option,
    unit_option,
)
from vibrocast.host.cli.sections import CODING, MORE, SectionedCommand, section
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.host.cli.steps import encoded, encoded_profile, files_of
from vibrocast.textures.files import MAX_SKIPPED_LINES


def parsed_setting(ctx: click.Context, param: click.Parameter, values: Sequence[str]) -> dict[str, str]:
    """Return a codec's parameters by name, or raise click.BadParameter."""
    setting: dict[str, str] = {}
    for text in values:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise click.BadParameter(f"{text!r} names no parameter and value; write NAME=VALUE", ctx, param)
        if name in setting:
            raise click.BadParameter(f"{name} is given twice; keep one", ctx, param)
        setting[name] = value
    return setting


def checked_codec(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """Return the name of a codec, or raise click.BadParameter."""
    if value is not None and value not in codec.CODECS:
        raise click.BadParameter(f"no codec {value}; `vibrocast codecs` lists them", ctx, param)
    return value


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast encode examples/oak.wav oak.vct\n"
    "vibrocast encode examples/oak.wav oak.vct --live --rate-bps 6000",
)
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(".vct"))
@section(
    CODING,
    grouped(
        "quality",
        QualityOptions,
        click.option(
            "--codec",
            "codec_name",
            callback=checked_codec,
            metavar="NAME",
            help=f"Codec; `vibrocast codecs` lists them. Default: that of --model, else {codec.DEFAULT_CODEC}.",
        ),
        model_option,
        click.option("--rate-bps", type=positive("bit/s"), help="Highest rate of the whole .vct file."),
        snr_db_option,
        section(
            MORE,
            click.option(
                "--touch",
                type=Number("strength", 0, 1),
                help="Error shaped for touch: 0 = flat, 1 = by the threshold. "
                f"Default: {codec.DEFAULT_TOUCH:g} for physical units, if the codec can.",
            ),
            stream_rate_option,
            click.option(
                "--setting",
                callback=parsed_setting,
                multiple=True,
                metavar="NAME=VALUE",
                help="Parameter that `vibrocast codecs` lists; may be repeated.",
            ),
        ),
    ),
    click.option("--live", is_flag=True, help="Code short packets, and hold --rate-bps over any 2 s."),
)
@section(
    INPUT_SECTION,
    grouped(
        "recording",
        RecordingOptions,
        rate_hz_option,
        unit_option,
        click.option(
            "--columns",
            metavar="NAME,...",
            help="Columns by name or number, as x,z. dft321, or norm:ax,ay,az, reduces three axes.",
        ),
        section(
            MORE,
            click.option("--full-scale", type=positive("VALUE"), help="Value of 1.0 in a WAV file, in --unit."),
            click.option(
                "--sensitivity", metavar="TEXT", help="Sensitivity of the sensor of volts or counts, as 100mV/g."
            ),
            click.option("--resample", is_flag=True, help="Interpolate samples at equal steps from uneven times."),
            click.option(
                "--skip-lines",
                type=Whole("LINES", 0, MAX_SKIPPED_LINES),
                default=0,
                help="Lines of a text file to leave out at its start.",
            ),
            click.option(
                "--key",
                metavar="NAME",
                help="Array, field, stream or topic of the file: trial.acc, group/channel.",
            ),
            hand_speed_option,
        ),
    ),
)
def encode(file: Path, out: Path, live: bool, quality: QualityOptions, recording: RecordingOptions) -> None:
    """Code a recording into a .vct file.

    --rate-bps and --snr-db apply to the file as a whole; give one of them.

    With --live, packets are short, and a link may lose some. --rate-bps counts their frames and holds over any 2 s.
    With --snr-db as well, the stream keeps this SNR, and the rate is a cap.

    A height profile is coded over position, for a hand at any speed. With --hand-speed-mm-s, it is coded over time.
    """
    reject_overwriting([out], [file, *files_of(quality.model)])
    target = rate_target(quality.rate_bps, quality.snr_db) if live else None
    if not live and quality.rate_bps is not None and quality.snr_db is not None:
        raise click.UsageError("--rate-bps and --snr-db exclude each other; give one, or add --live for a capped rate")
    if recording.hand_speed_mm_s is None and textures.is_profile(file):
        if live:
            raise click.UsageError("--live is for a stream over time; drop it, or give --hand-speed-mm-s")
        write_profile_encoding(out, encoded_profile(file, quality, recording))
        return
    loaded = textures.load(file, **recording.facts())
    if target is not None:
        encode_rate_controlled(loaded, out, target, quality, recording.unit)
        return
    speed_mm_s = recording.hand_speed_mm_s
    how = "" if speed_mm_s is None else f", coded over time at {speed_mm_s:g} mm/s"
    write_stream(out, encoded(loaded, quality, recording.unit, live).stream, how)


def write_profile_encoding(out: Path, encoding: Encoding) -> None:
    """Write a .vct file of a height profile over position, and print its size."""
    encoding.stream.save(out)
    facts = encoding.stream.facts()
    tell(
        f"{out}: {facts['size_bytes']} bytes, coded over position: {facts['length_mm']:.3f} mm, "
        f"{facts['samples_per_metre']} samples per metre, {facts['bits_per_mm']:.0f} bit/mm",
        out=str(out),
        **facts,
    )


def write_stream(out: Path, stream: Stream, how: str = "", **facts: Any) -> None:
    """Write a .vct file, and print its size and quality. `how`: it was coded, in words; `facts`: more, for JSON."""
    stream.save(out)
    quality = stream.quality
    assert quality is not None, "it has just been coded"
    model = f", model {stream.model_name}" if stream.image else ""
    lines = [
        f"{out}: {stream.size_bytes} bytes, {stream.bits_per_second:.0f} bit/s{how}{model}, {describe_snr(quality)}"
    ]
    if removed := describe_removed(quality):
        lines.append(f"removed: {removed}")
    if quality.felt_error is not None:
        lines.append(f"felt error: {describe_felt_error(quality.felt_error)}")
    tell(
        "\n".join(lines),
        out=str(out),
        **stream.facts(),
        quality=asdict(quality),
        **facts,
    )


def encode_rate_controlled(
    recording: textures.Recording,
    out: Path,
    target: RateTarget,
    options: QualityOptions,
    unit: str | None,
) -> None:
    """Code a recording as a live stream into a .vct file, and print the rate and quality reached."""
    arguments = options.arguments(unit)
    del arguments["rate_bps"], arguments["snr_db"]  # they are in the target
    with progress.bar("encoding") as update:
        encoding = encode_recording(recording, target=target, progress=update, **arguments)
    outcome = encoding.outcome
    assert outcome is not None, "there is a target of rate control"
    write_stream(out, encoding.stream, rate_control=asdict(outcome))
    tell(f"rate: {describe_rate(target, outcome)}")
    tell(
        f"framing: packets {outcome.packets_bps:.0f} bit/s, frames add {100 * outcome.frames_add:.1f} %, "
        f"padding {100 * outcome.padding:.1f} %"
    )
    tell(f"packets: {1000 * outcome.packet_s:.1f} ms each, {describe_packets(outcome)}")


def describe_rate(target: RateTarget, outcome: Outcome) -> str:
    """Return the rate with its frames, and how a target was held, in words."""
    mean = f"{outcome.sent_bps:.0f} bit/s"
    if target.constant_rate_bps is None:
        peak = "" if outcome.peak_bps is None else f", at most {outcome.peak_bps:.0f} over 2 s"
        return f"{mean} on average{peak}; limit {target.capped_rate_bps:g}"
    off = "" if outcome.furthest is None else f", at most {100 * abs(outcome.furthest):.2f} % off over 2 s"
    return f"{mean} of {target.constant_rate_bps:g}{off}"


def describe_packets(outcome: Outcome) -> str:
    """Return the SNR of the packets in words."""
    if math.isnan(outcome.snr_db):
        return "no SNR: the recording is silent"
    low_db, high_db = outcome.snr_range_db
    return f"SNR {outcome.snr_db:.2f} dB, 90 % within {low_db:.1f} to {high_db:.1f} dB"
