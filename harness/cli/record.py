"""The subcommand `record`: records a sensor on a sound card or a serial port."""

from pathlib import Path

import click

from vibrocast import progress
from vibrocast.errors import InputError
from vibrocast.files import plain
from vibrocast.harness import recorder
from vibrocast.host import sources
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import OutputFile, Whole, positive
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.textures import sidecar
from vibrocast.textures.sensitivity import EXAMPLES, Sensitivity, parse


def parsed_sensitivity(ctx: click.Context, param: click.Parameter, value: str | None) -> Sensitivity | None:
    """Return the sensitivity of a sensor, or raise click.BadParameter."""
    try:
        return None if value is None else parse(value)
    except InputError as error:
        raise click.BadParameter(str(error), ctx, param) from error


def checked_axes(ctx: click.Context, param: click.Parameter, value: str | None) -> str:
    """Return the axes in small letters, or raise click.BadParameter."""
    axes = (value or "").lower()
    if not sidecar.is_axes("".join(sorted(axes))):
        raise click.BadParameter(f"{value!r} are no axes; give letters of xyz, one for each channel", ctx, param)
    return axes


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast record oak.wav --input serial:/dev/ttyACM0 --seconds 4\n"
    "vibrocast record oak.wav --input audio:default --sensitivity 10.2mV/g --volts-full-scale 1.4",
)
@click.argument("out", type=OutputFile(".wav"))
@click.option("--input", "address", metavar="INPUT", required=True, help=f"Sensor: {sources.FORMS}.")
@click.option(
    "--sensitivity",
    callback=parsed_sensitivity,
    metavar="VALUE/UNIT",
    help=f"Sensitivity of the sensor: {EXAMPLES}.",
)
@click.option("--volts-full-scale", type=positive("V"), help="Volts at the input that are digital full scale.")
@section(MORE, click.option("--axes", callback=checked_axes, metavar="XYZ", help="Axis of each channel, such as xyz."))
@click.option("--rate-hz", type=Whole("Hz", 20, 10**6), help="Sample rate. Default: that of the input.")
@click.option("--seconds", type=positive("s"), help="Seconds to record. Default: until Ctrl-C.")
@section(MORE, click.option("--keep-dc", is_flag=True, help=f"Keep offset and drift below {recorder.DRIFT_HZ:g} Hz."))
def record(
    out: Path,
    address: str,
    sensitivity: Sensitivity | None,
    volts_full_scale: float | None,
    axes: str,
    rate_hz: int | None,
    seconds: float | None,
    keep_dc: bool,
) -> None:
    """Record an accelerometer or a displacement sensor into a WAV file.

    The file holds 32-bit floats in m/s^2 or um. A JSON file of the same name next to it states sensor, losses and
    clipping. Ctrl-C ends a recording and keeps it.
    """
    beside = sidecar.path_of(out)
    if beside.exists() and not sidecar.is_one(beside):
        raise click.UsageError(f"{beside} is another file than a sidecar; give OUT another name")
    click.echo(plain(f"listening to {address}"), err=True)
    opened = sources.open_source(address, sensitivity, volts_full_scale, axes=axes, rate_hz=rate_hz)
    with opened as source, progress.bar("recording", details_only=True) as update:
        for line in source.introduction():
            click.echo(plain(line), err=True)
        recorded = recorder.record(
            source,
            out,
            seconds=seconds,
            highpass_hz=None if keep_dc else recorder.DRIFT_HZ,
            progress=update,
        )
    for warning in recorded.warnings:
        click.echo(f"warning: {warning}", err=True)
    named = f" ({', '.join(source.axes)})" if source.axes else ""
    peaks = ", ".join(f"{peak:.3g}" for peak in recorded.peaks)
    tell(
        f"{out}: {recorded.seconds:.3f} s at {source.rate_hz} Hz, {source.channels} channel(s){named}, "
        f"peak {peaks} {source.unit}",
        out=str(out),
        seconds=recorded.seconds,
        rate_hz=source.rate_hz,
        channels=source.channels,
        unit=source.unit,
        peaks=list(recorded.peaks),
        warnings=list(recorded.warnings),
    )
