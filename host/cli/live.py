"""The subcommand `live`: streams a sensor, sound, standard input or a generated texture with the least delay."""

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import TypeAlias

import click
import numpy as np

from vibrocast import codec, models, progress, textures
from vibrocast.codec import Signal
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, chosen_codec
from vibrocast.codec.source import recording_format
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.files import plain
from vibrocast.host import live as streaming
from vibrocast.host import sources, uploader
from vibrocast.host.bench_file import Bench, BenchController, connect
from vibrocast.host.cli.answers import add
from vibrocast.host.cli.describe import tell_report
from vibrocast.host.cli.option_types import Number, Whole, positive
from vibrocast.host.cli.options import (
    actuator_option,
    bench_device_option,
    bench_option,
    grouped,
    judge,
    model_option,
    rate_target,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, INPUT, MORE, SectionedCommand, section
from vibrocast.host.live_playback import LivePlayback
from vibrocast.host.report import Provenance, Report
from vibrocast.host.serial_sensor import SerialSensor
from vibrocast.host.sources import StandardInput
from vibrocast.output import actuator_files
from vibrocast.textures.recording import MAX_CHANNELS

STANDARD_INPUT = "-"
TEXTURE_S = 10.0
Given: TypeAlias = textures.Recording | StandardInput | SerialSensor | sources.AnalogueSensor | sources.SoundInput


@dataclass(frozen=True)
class SampleOptions:
    """The samples of the source. `channels` is for standard input; all below it are for none of the textures."""

    rate_hz: int | None
    seconds: float | None
    channels: int | None
    unit: str | None
    full_scale: float | None


@dataclass(frozen=True)
class CodingOptions:
    """How each packet is coded."""

    model: models.Model | None
    snr_db: float | None
    rate_bps: float | None


@dataclass(frozen=True)
class DelayOptions:
    """How long packets wait at the controller, and whether all else is chosen for the least delay."""

    playout_delay_ms: float | None
    low_delay: bool

    @property
    def seconds(self) -> float | None:
        """The playout delay; None = the stream's default."""
        if self.playout_delay_ms is not None:
            return self.playout_delay_ms / 1e3
        return streaming.LOW_DELAY_PLAYOUT_S if self.low_delay else None


def checked_source(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """Return a source, or raise click.BadParameter."""
    if value in (STANDARD_INPUT, *textures.GENERATORS) or value.startswith(("serial:", "audio:")):
        return value
    raise click.BadParameter(
        f"no texture {value}; `vibrocast generate --help` lists them, and other sources are {sources.FORMS} and -",
        ctx,
        param,
    )


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast live rough --seconds 5\nvibrocast live serial:/dev/ttyACM1 --unit g --device serial:/dev/ttyACM0",
)
@click.argument("source", callback=checked_source)
@section(
    INPUT,
    grouped(
        "samples",
        SampleOptions,
        click.option(
            "--seconds",
            type=positive("s"),
            help=f"Seconds to stream. Default: {TEXTURE_S:g} of a texture, until the end of others.",
        ),
        click.option(
            "--rate-hz",
            type=Whole("Hz", 1, MAX_RATE_HZ),
            help=f"Sample rate of the source. Default: {DEFAULT_STREAM_RATE_HZ}, "
            f"or {streaming.LOW_DELAY_RATE_HZ} with --low-delay.",
        ),
        section(
            MORE,
            click.option(
                "--channels",
                type=Whole("NUMBER", 1, MAX_CHANNELS),
                help="Channels of raw samples. Default: 1.",
            ),
        ),
        click.option(
            "--unit",
            type=click.Choice(list(textures.INPUT_UNITS)),
            help="Unit of the samples, if nothing states it.",
        ),
        section(
            MORE,
            click.option(
                "--full-scale",
                type=positive("VALUE"),
                help="Value of 1.0 in the samples, in --unit. Default: 1.",
            ),
        ),
    ),
)
@section(
    CODING,
    grouped(
        "coding",
        CodingOptions,
        model_option,
        click.option("--rate-bps", type=positive("bit/s"), help="Constant rate; with --snr-db, the highest one."),
        click.option("--snr-db", type=Number("dB"), help="Signal-to-noise ratio, up to --rate-bps."),
    ),
)
@section(
    CONTROLLER,
    bench_option,
    bench_device_option,
    actuator_option,
    grouped(
        "delay",
        DelayOptions,
        section(
            MORE,
            click.option(
                "--playout-delay-ms",
                type=Number("ms", 0, 10_000),
                help="Time that a packet may be late. "
                f"Default: {1e3 * streaming.PLAYOUT_DELAY_S:g}, or a quarter packet if longer; more on a slow link.",
            ),
        ),
        click.option(
            "--low-delay",
            is_flag=True,
            help=f"Send the shortest blocks, with a playout delay of {1e3 * streaming.LOW_DELAY_PLAYOUT_S:g} ms.",
        ),
    ),
)
def live(
    source: str,
    bench: Bench | None,
    chosen: BenchController,
    actuator_name: str | None,
    samples: SampleOptions,
    delay: DelayOptions,
    coding: CodingOptions,
) -> None:
    """Stream a sensor, sound, standard input or a texture to a controller.

    SOURCE is serial:PORT, an accelerometer at a serial port, or the name of a generated texture. It may be audio:CARD,
    the sound of a microphone or of a card's monitor. With --unit, that is a sensor at the card.

    SOURCE - is standard input: a WAV, AU or CAF file, or raw samples. Raw samples are 32-bit floats, little-endian,
    with interleaved channels.

    Where a source pauses, silence is played. Ctrl-C ends a sensor and sound.

    A rate counts packets and their frames. If the link becomes slower, the stream lowers its rate.

    With --bench, --device may be a name in the file. The exit code is 4 if a limit is missed; without --bench, at most
    1 % of the packets may be lost. It is 6 if this machine was too busy to decide.
    """
    reject_contradictions(coding, delay)
    actuator = None if actuator_name is None else actuator_files.find(actuator_name)
    with (
        opened_source(source, samples, delay.low_delay) as given,
        connect(bench, chosen, actuator) as session,
        progress.bar("streaming") as update,
    ):
        if coding.model is not None:
            uploader.provide(session.controller, session.address, coding.model.image)
        how = live_coding(coding, delay, format_of(given))
        stream = streaming.LiveStream(session.controller, format_of(given), coding=how, playout_delay_s=delay.seconds)
        run = Provenance(None if bench is None else bench.sha256)
        playing = LivePlayback(session, stream, source, model=coding.model, provenance=run)
        report = played(playing, samples, given, update)
    tell_report(report)
    judge(bench, list(report.figures()), source)


@contextlib.contextmanager
def opened_source(source: str, samples: SampleOptions, low_delay: bool) -> Iterator[Given]:
    """Open a source, and say on stderr how it is read. `low_delay`: makes the rate higher where it has none."""
    rate_hz = samples.rate_hz or (streaming.LOW_DELAY_RATE_HZ if low_delay else DEFAULT_STREAM_RATE_HZ)
    make = textures.GENERATORS.get(source)
    if make is not None:
        yield make(seconds=samples.seconds or TEXTURE_S, rate_hz=rate_hz)
    elif source == STANDARD_INPUT:
        yield StandardInput(samples.rate_hz, samples.channels, samples.unit, samples.full_scale, rate_hz)
    else:
        if samples.channels is not None:
            raise click.UsageError(
                f"--channels is for raw samples; drop it, or name channels of a card: {sources.FORMS}"
            )
        click.echo(plain(f"listening to {source}"), err=True)
        with sources.open_live(source, samples.unit, samples.full_scale, samples.rate_hz, rate_hz) as given:
            for line in given.introduction():
                click.echo(plain(line), err=True)
            yield given


def format_of(given: Given) -> codec.SignalFormat:
    """Return the format of a live stream from a source."""
    if isinstance(given, textures.Recording):
        return recording_format(given)
    return sources.format_of(given)


def source_blocks(playing: LivePlayback, samples: SampleOptions, given: Given) -> Iterator[Signal]:
    """Return the blocks of a source through the high-pass of its unit; of any but a texture, up to --seconds."""
    signal_format = playing.stream.format
    is_drive = samples.unit == "drive" or isinstance(given, sources.SoundInput)
    highpass: Callable[[Signal], Signal] = np.asarray
    if not is_drive and textures.is_vibration(signal_format.unit):
        highpass = textures.LiveHighPass(signal_format.rate_hz, textures.HIGHPASS_HZ)
    if isinstance(given, textures.Recording):
        return map(highpass, playing.paced(given.samples))
    if not isinstance(given, StandardInput):
        sources.skip_kept(given)
    left = math.inf if samples.seconds is None else round(samples.seconds * signal_format.rate_hz)

    def read(timeout_s: float) -> Signal | None:
        nonlocal left
        block = given.read(timeout_s) if left else None
        if block is None:
            return None
        block = block[: int(min(left, len(block)))]
        left -= len(block)
        return highpass(block)

    return playing.heard(read)


def reject_contradictions(coding: CodingOptions, delay: DelayOptions) -> None:
    """Raise click.UsageError for options that do not go together."""
    if coding.rate_bps is None and coding.snr_db is not None:
        raise click.UsageError("--snr-db needs a rate that the stream does not exceed; add --rate-bps")
    if coding.rate_bps is not None and delay.low_delay:
        raise click.UsageError("--low-delay sends each block at once, at any rate; drop it, or --rate-bps")


def live_coding(coding: CodingOptions, delay: DelayOptions, signal_format: codec.SignalFormat) -> streaming.LiveCoding:
    """Return how a live stream in this format is coded."""
    chosen = chosen_codec(None, coding.model)
    shortest = chosen.block_setting(chosen.blocks[0]) if delay.low_delay and chosen.blocks else {}
    target = rate_target(coding.rate_bps, coding.snr_db)
    if target is None:
        return streaming.LiveCoding(chosen.name, shortest, coding.model)
    return streaming.LiveCoding(
        chosen.name,
        shortest,
        coding.model,
        policy=target.policy(signal_format),
        packet_samples=target.framing(signal_format.rate_hz).packet_samples,
    )


def played(playing: LivePlayback, samples: SampleOptions, given: Given, update: progress.Update) -> Report:
    """Play a source to its end, and return the report, which is added to the answer: of a stream that is cut, too."""
    try:
        blocks = source_blocks(playing, samples, given)
        report = playing.play(blocks, lambda _: update(*so_far(playing.stream, given))).report
    except BaseException as cut:
        report = playing.report()
        # Nothing but Ctrl-C ends a sensor.
        if not isinstance(cut, KeyboardInterrupt) or isinstance(given, (textures.Recording, StandardInput)):
            add(asdict(report))
            raise
    add(asdict(report))
    return report


def so_far(stream: streaming.LiveStream, given: object) -> tuple[float | None, str]:
    """Return the part of a stream that is done, None where it has no end, and the line that says how it goes."""
    whole_s = given.seconds if isinstance(given, textures.Recording) else None
    length = "" if whole_s is None else f" of {whole_s:.1f}"
    rate_bps = 8 * stream.payload_bytes / stream.seconds if stream.seconds else 0.0
    pauses = f"  pauses {stream.pauses}" if stream.pauses else ""
    line = f"{stream.seconds:.1f}{length} s  {rate_bps / 1000:.2f} kbit/s  underruns {stream.underruns}{pauses}"
    return None if whole_s is None else min(1.0, stream.seconds / whole_s), line
