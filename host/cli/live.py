"""The subcommand `live`: streams raw samples from standard input, or a generated texture, with the least delay."""

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models, progress, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, chosen_codec
from vibrocast.codec.live_format import live_format
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.device_protocol.messages import Status
from vibrocast.errors import InputError
from vibrocast.host import devices, playback, uploader
from vibrocast.host import live as streaming
from vibrocast.host.bench_limits import BenchLimits, missed
from vibrocast.host.cli.answers import add, tell
from vibrocast.host.cli.option_types import Number, Whole, positive
from vibrocast.host.cli.options import (
    Chosen,
    actuator_option,
    bench_actuator,
    bench_device_option,
    bench_option,
    check_bench_actuator,
    fail_where_missed,
    grouped,
    model_option,
    own_actuator,
    rate_target,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, INPUT, SectionedCommand, section
from vibrocast.host.cli.steps import ANSWERS, describe_card, describe_skin, warn_of_underruns
from vibrocast.host.controller import ControllerError
from vibrocast.host.live_watch import CodedSignal, LiveQuality, Timing, Watch, judged
from vibrocast.host.report import SCHEMA, Provenance
from vibrocast.textures.recording import MAX_CHANNELS

if TYPE_CHECKING:
    from vibrocast.host.bench_file import Bench

STANDARD_INPUT = "-"
RAW = np.dtype("<f4")
"""The type of raw samples."""


@dataclass(frozen=True)
class SampleOptions:
    """The samples of the source. `seconds` is for a texture; all below it are for raw samples."""

    rate_hz: int | None
    seconds: float
    channels: int
    unit: str | None
    full_scale: float


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
    def playout_delay_s(self) -> float | None:
        """The playout delay; None = the stream's default."""
        if self.playout_delay_ms is not None:
            return self.playout_delay_ms / 1e3
        return streaming.LOW_DELAY_PLAYOUT_S if self.low_delay else None


@click.command(cls=SectionedCommand)
@click.argument("source", type=click.Choice((STANDARD_INPUT, *sorted(textures.GENERATORS))))
@section(
    INPUT,
    grouped(
        "samples",
        SampleOptions,
        click.option("--seconds", type=positive("s"), default=10.0, show_default=True, help="Generate this duration."),
        click.option(
            "--rate-hz",
            type=Whole("Hz", 1, MAX_RATE_HZ),
            help=f"Set the sample rate of the source. Default: {DEFAULT_STREAM_RATE_HZ}, "
            f"or {streaming.LOW_DELAY_RATE_HZ} with --low-delay.",
        ),
        click.option(
            "--channels",
            type=Whole("NUMBER", 1, MAX_CHANNELS),
            default=1,
            show_default=True,
            help="Set the channels of raw samples.",
        ),
        click.option(
            "--unit",
            type=click.Choice(list(textures.INPUT_UNITS)),
            help="Give the unit of raw samples.",
        ),
        click.option(
            "--full-scale",
            type=positive("VALUE"),
            default=1.0,
            show_default=True,
            help="Give the value of 1.0 in raw samples, in --unit.",
        ),
    ),
)
@section(
    CODING,
    grouped(
        "coding",
        CodingOptions,
        model_option,
        click.option("--rate-bps", type=positive("bit/s"), help="Hold this rate; with --snr-db, do not exceed it."),
        click.option("--snr-db", type=Number("dB"), help="Keep this signal-to-noise ratio, up to --rate-bps."),
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
        click.option(
            "--playout-delay-ms",
            type=Number("ms", 0, 10_000),
            help="Delay the output to bear late packets. "
            f"Default: {1e3 * streaming.PLAYOUT_DELAY_S:g}, or a quarter packet if longer; more on a slow link.",
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
    bench: "Bench | None",
    chosen: Chosen,
    actuator_name: str | None,
    samples: SampleOptions,
    delay: DelayOptions,
    coding: CodingOptions,
) -> None:
    """Stream a generated texture or standard input to a controller.

    SOURCE is the name of a texture, or - for raw samples from standard input. Raw samples are 32-bit floats,
    little-endian, with interleaved channels.

    A rate counts packets and their frames. If the link becomes slower, the stream lowers its rate.

    With --bench, --device may be a name in the file. The exit code is 4 if a limit is missed; without --bench, at most
    1 % of the packets may be lost.
    """
    target = rate_target(coding.rate_bps, coding.snr_db)
    if target is None and coding.snr_db is not None:
        raise click.UsageError("--snr-db needs a rate that the stream does not exceed; add --rate-bps")
    if target is not None and delay.low_delay:
        raise click.UsageError("--low-delay sends each block at once, at any rate; drop it, or --rate-bps")
    default_rate_hz = streaming.LOW_DELAY_RATE_HZ if delay.low_delay else DEFAULT_STREAM_RATE_HZ
    rate_hz = samples.rate_hz or default_rate_hz
    texture = (
        None if source == STANDARD_INPUT else textures.GENERATORS[source](seconds=samples.seconds, rate_hz=rate_hz)
    )
    signal_format = raw_format(samples, rate_hz) if texture is None else texture_format(texture)
    highpass_hz = textures.highpass_of(samples.unit, textures.HIGHPASS_HZ)
    model = coding.model
    live_codec = chosen_codec(None, model)
    address = chosen.address
    given = own_actuator(address, actuator_name)
    actuator = bench_actuator(bench, chosen) if given is None else given
    with devices.connect(address, actuator=actuator) as controller, progress.bar("streaming") as update:
        check_bench_actuator(bench, chosen, controller.description.actuator)
        if model is not None:
            uploader.provide(controller, address, model.image)
        shortest = live_codec.block_setting(live_codec.blocks[0]) if delay.low_delay and live_codec.blocks else {}
        live_coding = streaming.LiveCoding(live_codec.name, shortest, model)
        if target is not None:
            live_coding = replace(
                live_coding,
                policy=target.policy(signal_format),
                packet_samples=target.framing(rate_hz).packet_samples,
            )
        stream = streaming.LiveStream(
            controller, signal_format, coding=live_coding, playout_delay_s=delay.playout_delay_s
        )
        watch, coded = Watch(stream), CodedSignal(stream)
        total_s = None if texture is None else texture.seconds
        blocks = (
            raw_blocks(samples, streaming.block_samples(stream)) if texture is None else watch.blocks(texture.samples)
        )
        if highpass_hz is not None and textures.is_vibration(signal_format.unit):
            blocks = map(textures.LiveHighPass(rate_hz, highpass_hz), blocks)

        def show(now: Status) -> None:
            watch.note(now)
            part = None if total_s is None else min(1.0, stream.seconds / total_s)
            length = "" if total_s is None else f" of {total_s:.1f}"
            rate_bps = 8 * stream.payload_bytes / stream.seconds if stream.seconds else 0.0
            update(part, f"{stream.seconds:.1f}{length} s  {rate_bps / 1000:.2f} kbit/s  underruns {stream.underruns}")

        quality, timing = LiveQuality(), Timing()
        try:
            result = streaming.play(stream, coded.blocks(blocks), progress=show)
            if not result.packets:
                raise InputError("standard input ended before its first sample; check the program that writes to it")
            member = playback.member(controller, address, actuator)
            quality = coded.quality(member, model, result)
            timing = watch.timing(member)
        finally:
            # Of a stream that was cut, too, but then at once.
            watch.close()
            add(figures(stream.result(), stream, watch, bench, quality, timing))
    tell_stream(result, stream, watch, quality, timing)
    if quality.differs:
        raise ControllerError(
            "the controller played something else than was sent, though no packet was lost: its memory, its firmware "
            "or its actuator differs; flash the firmware again, and check --bench and --actuator"
        )
    fail_where_missed(missed(BenchLimits() if bench is None else bench.limits, judged(result, quality, timing)))


def texture_format(texture: textures.Recording) -> codec.SignalFormat:
    """Return the format of a texture that is known as a whole."""
    peaks, rms = np.max(np.abs(texture.samples), axis=0), np.sqrt(np.mean(np.square(texture.samples), axis=0))
    return live_format(round(texture.rate_hz), texture.unit, peaks.tolist(), rms.tolist())


def raw_format(samples: SampleOptions, rate_hz: int) -> codec.SignalFormat:
    """Return the format of raw samples. Raises InputError without standard input, click.UsageError without a unit."""
    if sys.stdin is None:
        raise InputError("standard input is closed; pipe samples into it, or name a texture")
    if samples.unit is None:
        raise click.UsageError("missing --unit; state the unit of the samples, or drive for a drive signal")
    unit, factor = textures.INPUT_UNITS[samples.unit]
    return live_format(rate_hz, unit, [samples.full_scale * factor] * samples.channels)


def raw_blocks(samples: SampleOptions, block_samples: int) -> Iterator[NDArray[np.float64]]:
    """Yield blocks of standard input, float64 (n, channels), each as soon as it is there, up to its end."""
    assert samples.unit is not None, "raw samples have a unit"
    one = samples.full_scale * textures.INPUT_UNITS[samples.unit][1]
    sample_bytes = RAW.itemsize * samples.channels
    while data := sys.stdin.buffer.read(block_samples * sample_bytes):
        whole = np.frombuffer(data[: len(data) // sample_bytes * sample_bytes], RAW)
        yield whole.reshape(-1, samples.channels) * np.float64(one)


def tell_stream(
    result: streaming.LiveResult, stream: streaming.LiveStream, watch: Watch, quality: LiveQuality, timing: Timing
) -> None:
    """Print how a stream went: rate, losses, quality and times; warn of the wire, the computer and the sound card."""
    delay_ms = 1000 * stream.playout_delay_s
    if stream.policy is not None:
        tell(
            f"packets {result.payload_bps:.0f} bit/s, with frames {result.wire_bps:.0f} bit/s "
            f"(+{100 * result.wire_adds:.1f} %); packets of {1000 * stream.packet_s:.1f} ms, playout delay "
            f"{delay_ms:.0f} ms; {result.dropped_packets} packets not sent, because too late"
        )
    restarts = f", restarts {result.streams - 1}" if result.streams > 1 else ""
    tell(
        f"underruns {result.underruns}, lost packets {result.lost_packets} of {result.packets}{restarts}, "
        f"damaged frames {result.bad_frames} there, {result.bad_frames_back} back"
    )
    skin = f"; at the skin, by models, {describe_skin(quality.skin, quality.skin_note)}" if quality.skin else ""
    tell(f"SNR {'unknown' if quality.snr_db is None else f'{quality.snr_db:.2f} dB'}{skin}")
    tell(
        f"decoded as sent {ANSWERS[quality.decoded_equals_offline]}, DAC as computed "
        f"{ANSWERS[quality.dac_equals_offline]}"
    )
    if timing.latency_ms is not None:
        tell(f"latency to the DAC {timing.latency_ms:.1f} ms, jitter of arrivals {timing.jitter_ms:.1f} ms")
    if card := stream.controller.sound_card:
        tell(f"sound card {describe_card(card)}")
        warn_of_underruns(card)
    for minute in watch.minutes:
        if minute.cause is not None:
            late = "" if minute.host_late_ms is None else f", host up to {minute.host_late_ms:.0f} ms late"
            lost = f"underruns {minute.underruns}, lost packets {minute.lost_packets}, restarts {minute.restarts}"
            tell(f"from {minute.from_s:.0f} s: {lost}{late}; cause: {minute.cause}")
    if result.bad_frames or result.bad_frames_back:
        click.echo("warning: frames were damaged on the wire; check cable, connectors and baud rate", err=True)
    elif result.lost_packets or result.dropped_packets:
        click.echo(
            "warning: packets were late or lost: the computer or the link was too busy; pass a --playout-delay-ms "
            f"above {delay_ms:.0f}",
            err=True,
        )


def figures(
    result: streaming.LiveResult,
    stream: streaming.LiveStream,
    watch: Watch,
    bench: "Bench | None",
    quality: LiveQuality,
    timing: Timing,
) -> dict[str, Any]:
    """Return the report of a live stream, ready for JSON; docs/reference/report.md explains each figure."""
    card, hello = stream.controller.sound_card, stream.controller.description
    return {
        "schema": SCHEMA,
        "run": asdict(Provenance(None if bench is None else bench.sha256)),
        "version": version("vibrocast"),
        "codec": codec.codec_by_identifier(stream.header.codec_identifier, stream.header.configuration).name,
        "channels": stream.format.channels,
        "stream_rate_hz": stream.format.rate_hz,
        "seconds": result.seconds,
        "packet_ms": 1000 * stream.packet_s,
        "playout_delay_ms": 1000 * stream.playout_delay_s,
        "payload_bits_per_second": result.payload_bps,
        "wire_bits_per_second": result.wire_bps,
        "wire_adds": result.wire_adds,
        **asdict(quality),
        **asdict(timing),
        "underruns": result.underruns,
        "packets": result.packets,
        "lost_packets": result.lost_packets,
        "dropped_packets": result.dropped_packets,
        "bad_frames": result.bad_frames,
        "bad_frames_back": result.bad_frames_back,
        "streams": result.streams,
        "device": {"build": hello.build, "hardware": hello.hardware, "serial_number": hello.serial_number},
        "sound_card": None if card is None else asdict(card),
        "minutes": [asdict(minute) for minute in watch.minutes],
    }
