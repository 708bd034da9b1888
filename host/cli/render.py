"""The subcommand `render`: writes the drive signal of a texture for an actuator into a WAV file, for any player."""

from dataclasses import asdict, dataclass
from pathlib import Path

import click

from vibrocast import textures
from vibrocast.files import atomic_write
from vibrocast.host import devices
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, reject_overwriting
from vibrocast.host.cli.options import (
    QualityOptions,
    RecordingOptions,
    gain_option,
    grouped,
    hand_speed_option,
    model_option,
    unit_option,
)
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.host.cli.steps import encoded, files_of, reject_coding_options
from vibrocast.host.playback import drive_signal
from vibrocast.host.track_player import TrackOptions, read_source
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS, MAX_FULL_SCALE_VOLTS, MIN_FULL_SCALE_VOLTS


@dataclass(frozen=True)
class DriveOptions:
    """For which actuator, and at which level, the drive signal is made."""

    actuator_name: str
    dac_rate_hz: int
    full_scale_volts: float | None
    gain_db: float


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast render examples/oak.wav drive.wav --actuator lra\n"
    "vibrocast render oak.vct drive.wav --actuator actuator.toml --gain-db 6",
)
@click.argument("file", type=INPUT)
@click.argument("out", type=OutputFile(".wav"))
@grouped("recording", RecordingOptions, unit_option, hand_speed_option)
@grouped("quality", QualityOptions, model_option)
@grouped(
    "drive",
    DriveOptions,
    click.option(
        "--actuator",
        "actuator_name",
        metavar="NAME|FILE",
        required=True,
        help=f"Actuator: {', '.join(ACTUATORS)} or a TOML file.",
    ),
    click.option(
        "--dac-rate-hz",
        type=Whole("Hz", 1000, 384_000),
        default=48_000,
        help="Sample rate of the drive signal.",
    ),
    section(
        MORE,
        click.option(
            "--full-scale-volts",
            type=Number("V", MIN_FULL_SCALE_VOLTS, MAX_FULL_SCALE_VOLTS),
            help="Volts at the actuator for 1.0. Default: its highest.",
        ),
    ),
    gain_option,
)
def render(file: Path, out: Path, drive: DriveOptions, quality: QualityOptions, recording: RecordingOptions) -> None:
    """Write the drive signal of a recording as a WAV file.

    FILE is a recording or a .vct file. The file holds the 16-bit codes that a sound card would play: resampled,
    compensated and limited for the actuator. Play it at full volume, without any other processing.
    """
    reject_overwriting([out], [file, *files_of(quality.model)])
    actuator = devices.on_sound_card(
        actuator_files.find(drive.actuator_name), drive.dac_rate_hz, drive.full_scale_volts
    )
    reject_coding_options(file, quality, recording)
    source = read_source(file, TrackOptions(facts=recording.facts(), model=quality.model))
    if isinstance(source, textures.Recording):
        source = encoded(source, quality, recording.unit, live=True).stream
    stream = source.with_gain(drive.gain_db)
    signal, limited = drive_signal(stream, actuator, str(file))
    volts = actuator.volts / 2
    with atomic_write(out) as partial:
        textures.save(partial, signal, sixteen_bit=True, note=f"drive of {actuator.name}, 1.0 is {volts:g} V")
    tell(
        f"{out}: {signal.seconds:.3f} s at {actuator.dac_rate_hz} Hz, {signal.channels} channel(s), "
        f"1.0 is {volts:g} V at {actuator.name}",
        out=str(out),
        seconds=signal.seconds,
        rate_hz=actuator.dac_rate_hz,
        channels=signal.channels,
        actuator=actuator.name,
        full_scale_volts=volts,
        limited=asdict(limited),
    )
    tell(
        f"clipped {limited.compensation_clipped}, limited by voltage {limited.voltage_limited}, slew "
        f"{limited.slew_limited}, power {limited.power_limited} samples"
    )
