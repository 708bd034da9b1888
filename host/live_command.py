"""The subcommand `live`: streams raw samples from standard input, or a generated texture, with the least delay."""

import sys
from collections.abc import Iterator

import click
import numpy as np
from numpy.typing import NDArray

import codec
import models
import textures
from device_protocol.coded_stream import MAX_RATE_HZ
from device_protocol.messages import Status
from host import coding, devices, flasher, progress
from host import live as streaming
from host.options import POSITIVE, BadInput, Finite, codec_option, device_option, model_option, setting_option
from textures.recording import MAX_CHANNELS

# What 1.0 of full scale is in each.
FORMATS = {"int16": ("<i2", 32768.0), "float32": ("<f4", 1.0)}
STANDARD_INPUT = "-"


@click.command()
@click.argument("source", type=click.Choice((STANDARD_INPUT, *sorted(textures.GENERATORS))))
@device_option
@click.option(
    "--rate-hz", type=click.IntRange(1, MAX_RATE_HZ), default=coding.DEFAULT_STREAM_RATE_HZ, show_default=True
)
@click.option("--seconds", type=POSITIVE, default=10.0, show_default=True, help="Duration of a generated texture.")
@click.option("--format", "sample_format", type=click.Choice(list(FORMATS)), default="int16", show_default=True)
@click.option("--channels", type=click.IntRange(1, MAX_CHANNELS), default=1, show_default=True)
@click.option("--unit", type=click.Choice(textures.UNITS), default="full scale", show_default=True)
@click.option("--full-scale", type=POSITIVE, default=1.0, show_default=True, help="Largest magnitude, in --unit.")
@click.option(
    "--margin-ms",
    type=Finite(min=0, max=10_000),
    default=1e3 * streaming.MARGIN_S,
    show_default=True,
    help="How long a packet lies ready on the controller, and so how late it may be.",
)
@codec_option
@setting_option
@model_option
def live(
    source: str,
    address: str,
    rate_hz: int,
    seconds: float,
    sample_format: str,
    channels: int,
    unit: str,
    full_scale: float,
    margin_ms: float,
    codec_name: str | None,
    setting: codec.Setting,
    model: models.Model | None,
) -> None:
    """Stream a live SOURCE: raw samples from standard input (-), as they come, or a generated texture.

    Raw samples are little-endian, channels interleaved; 32767 in int16 and 1.0 in float32 stand for --full-scale.
    """
    if source != STANDARD_INPUT:
        texture = textures.GENERATORS[source](seconds=seconds, rate_hz=rate_hz)
        peaks, rms = np.max(np.abs(texture.samples), axis=0), np.sqrt(np.mean(np.square(texture.samples), axis=0))
        signal_format = streaming.live_format(rate_hz, texture.unit, peaks.tolist(), rms.tolist())
    elif sys.stdin is None:
        raise BadInput("standard input is closed: pipe samples into it, or name a texture")
    else:
        signal_format = streaming.live_format(rate_hz, unit, [full_scale] * channels)
    chosen = coding.chosen_codec(codec_name, model)
    if chosen.needs_model and model is None:
        model = coding.smallest_first(chosen)[0]
    with devices.connect(address) as controller, progress.shown("streaming") as update:
        if model is not None:
            flasher.provide(controller, address, model.image)
        stream = streaming.LiveStream(
            controller, signal_format, codec_name=chosen.name, setting=setting, model=model, margin_s=margin_ms / 1e3
        )
        blocks: Iterator[NDArray[np.float64]]
        if source != STANDARD_INPUT:
            blocks = (block for _, block in streaming.paced(stream, texture.samples, stream.packet_samples))
        else:
            blocks = raw_blocks(sample_format, channels, full_scale, stream.packet_samples)

        def tell(now: Status) -> None:
            update(0.0, f"{now.position / rate_hz:.1f} s  underruns {now.underruns}")

        try:
            result = streaming.play(stream, blocks, progress=tell)
        except streaming.LiveError as error:
            raise BadInput(str(error)) from error
    anew = f", begun anew {result.streams - 1} times" if result.streams > 1 else ""
    click.echo(f"underruns {result.underruns}, lost packets {result.lost_packets}{anew}")


def raw_blocks(
    sample_format: str, channels: int, full_scale: float, block_samples: int
) -> Iterator[NDArray[np.float64]]:
    """Yield blocks of standard input, float64 (n, channels), each as soon as it is there, up to its end."""
    kind, one = FORMATS[sample_format]
    sample_bytes = np.dtype(kind).itemsize * channels
    while data := sys.stdin.buffer.read(block_samples * sample_bytes):
        whole = np.frombuffer(data[: len(data) // sample_bytes * sample_bytes], kind)
        yield whole.reshape(-1, channels) * (full_scale / one)
