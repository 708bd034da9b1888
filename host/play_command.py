"""The subcommand `play`: plays a recording, a .vct file or a plan on a controller, and tells how it went."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vibrocast import textures
from vibrocast.host import coding, devices, planned_command, player, profiles, progress
from vibrocast.host.command_steps import encoded, encoded_profile, files_of, needed, refuse_overwriting, show
from vibrocast.host.controller import ControllerError
from vibrocast.host.options import (
    INPUT,
    POSITIVE,
    BadInput,
    OutputFile,
    device_option,
    plan_option,
    quality_of,
    quality_options,
    recording_options,
    runtime_option,
)
from vibrocast.host.report import Report

if TYPE_CHECKING:
    from vibrocast.host import hand

ANSWERS = {True: "yes", False: "NO", None: "not compared"}


@click.command()
@click.argument("file", type=INPUT, required=False)
@plan_option
@device_option
@click.option("--loop", "loops", type=click.IntRange(1, 65_535), default=1, show_default=True, help="Passes to play.")
@click.option("--report", "report_path", type=OutputFile(".json"), help="Write the figures as JSON.")
@click.option("--plot", "plot_path", type=OutputFile(".png", ".svg", ".pdf"), help="Draw a picture.")
@runtime_option
@quality_options
@click.option("--positions", "positions_path", type=INPUT, help="CSV file of time_s,position_mm: a hand on a profile.")
@click.option("--stroke-mm", type=POSITIVE, help="A hand that strokes a profile, --loop times there and back.")
@recording_options
def play(
    file: Path | None,
    plan_path: Path | None,
    address: str,
    loops: int,
    positions_path: Path | None,
    stroke_mm: float | None,
    report_path: Path | None,
    plot_path: Path | None,
    runtime: str | None,
    **choices: Any,
) -> None:
    """Play a recording or a .vct file on a controller.

    A height profile is played over time, as --hand-speed-mm-s passes it once, or by the position of a hand:
    --positions, or --stroke-mm with --hand-speed-mm-s as its highest speed.

    With --plan, play the texture that FILE names, or all, live and as planned, on the plan's controllers, or on
    --device where it has one, and hold what is measured against the forecast: what is off by more than 10 % fails.
    """
    from vibrocast.host import end_to_end, picture

    if plan_path is not None:
        plan = planned_command.read(plan_path, ("file", "address", "report_path"))
        planned_command.play(plan, [str(file)] if file else [], report_path)
        return
    file = needed(file, "FILE")
    refuse_overwriting([report_path, plot_path], [file, *files_of(choices["model"])])
    runtime = devices.decoding_runtime(address, runtime)
    if positions_path or stroke_mm:
        if report_path:
            raise click.UsageError("a profile under a hand has no report: drop --report.")
        from vibrocast.host import hand

        movement = hand.chosen_movement(positions_path, stroke_mm, choices.pop("hand_speed_mm_s"), loops)
        play_profile(file, address, movement, plot_path, runtime, choices)
        return
    if file.suffix.lower() == ".vct":
        coded = coded_already(file, choices)
        if coded.header.spatial:
            raise BadInput(f"{file}: coded over position; give --positions, or --stroke-mm and --hand-speed-mm-s")
        source: coding.Stream | textures.Recording = replace(coded, runtime=runtime)
    else:
        quality = quality_of(choices)
        source = textures.load(file, **choices)
    with devices.connect(address, runtime) as controller:
        # What the controller cannot play need not be encoded first.
        if isinstance(source, coding.Stream):
            player.check_limits(controller, source.header.channels, source.header.rate_hz)
            stream, encoding = source, None
        else:
            player.check_limits(controller, source.channels, quality["stream_rate_hz"])
            encoding = encoded(source, {**quality, "runtime": runtime}, live=True)
            stream = encoding.stream
        with progress.shown("playing") as update:
            tell = playing(update, stream.bits_per_second)
            outcome = end_to_end.play(controller, address, file.name, stream, encoding, loops, tell)
    if report_path:
        outcome.report.write(report_path)
    if plot_path:
        picture.draw(plot_path, f"{file.name} on {address}", outcome.caption, outcome.traces)
    show(summary(outcome.report))
    if False in (outcome.report.decoded_equals_offline, outcome.report.dac_equals_offline):
        raise ControllerError(
            "what the controller played is not what was sent: see the underruns and lost packets above, "
            "and try a shorter cable or a less busy machine; or the other --runtime, if the controller decodes by it"
        )


def play_profile(
    file: Path,
    address: str,
    movement: "hand.Movement",
    plot_path: Path | None,
    runtime: str | None,
    choices: dict[str, Any],
) -> None:
    """Play a height profile, or a spatial stream, under a moving hand; tell what was played, and draw it."""
    from vibrocast.host import end_to_end, hand, picture

    if file.suffix.lower() == ".vct":
        stream = coded_already(file, choices)
    else:
        quality = quality_of(choices)
        stream = encoded_profile(profiles.recording_of(file, **choices), quality, profiles.SLOWEST_MM_S).stream
    stream = replace(stream, runtime=runtime)
    if not stream.header.spatial:
        raise BadInput(f"{file}: coded over time, not over position; encode the profile with --spatial")
    with devices.connect(address, runtime) as controller, progress.shown("playing") as update:
        played = hand.play(controller, stream, movement, progress=update)
        actuator = end_to_end.actuator_model(controller.description.actuator)
    expected = hand.computed(stream, played, actuator)
    status, facts = played.status, stream.facts()
    if plot_path:
        picture.draw(plot_path, f"{file.name} on {address}", *hand.pictured(played, expected, actuator))
    show(
        {
            "played": f"{file.name}, {facts['length_mm']:.2f} mm, under a hand at up to "
            f"{movement.fastest_mm_s:.0f} mm/s for {movement.seconds:.2f} s",
            "stream": f"{facts['size_bytes']} bytes, {facts['bits_per_mm']:.0f} bit/mm, codec {facts['codec']}",
            "actuator": f"{actuator.name}, clipped {status.compensation_clipped}, limited by voltage "
            f"{status.voltage_limited}, slew {status.slew_limited}, power {status.power_limited} samples",
            "positions": f"{len(played.positions)} sent, {status.underruns} came too late, frames damaged "
            f"{played.damaged}",
            "DAC as computed": {**ANSWERS, False: "no, as where a position is lost"}[
                hand.as_computed(played, expected, actuator)
            ],
        }
    )


def coded_already(file: Path, choices: dict[str, Any]) -> coding.Stream:
    """Read a .vct file to play, to which no option of the two groups applies but the model."""
    model = choices.pop("model")
    given = [name for name, value in choices.items() if value not in (None, {}, coding.DEFAULT_STREAM_RATE_HZ)]
    if given:
        raise click.UsageError(f"{file} is coded already: drop --{given[0].removesuffix('_name').replace('_', '-')}.")
    return coding.read(file, model.image if model else None)


def playing(update: progress.Update, bits_per_second: float) -> Callable[[player.Progress], None]:
    """Return what tells `update` of a playback: position, rate, buffer, underruns."""

    def tell(now: player.Progress) -> None:
        duration_s = now.duration_s or math.inf
        details = (
            f"{now.position_s:.1f} of {duration_s:.1f} s  {bits_per_second / 1000:.2f} kbit/s  "
            f"buffer {1000 * now.buffered_s:.0f} ms  underruns {now.status.underruns}"
        )
        update(now.position_s / duration_s, details)

    return tell


def summary(report: Report) -> dict[str, object]:
    """Return the lines that `play` prints at its end."""
    latency, limits = report.latency_ms, report.actuator
    return {
        "played": f"{report.file}, {report.seconds:.2f} s, {report.channels} channel(s), {report.loops} time(s)",
        "stream": f"{report.stream_bytes} bytes, {report.bits_per_second:.0f} bit/s, "
        f"{report.bits_per_sample:.2f} bit/sample, codec {report.codec}"
        + (f", model {report.model}" if report.model else ""),
        "SNR": "none" if report.snr_db is None else f"{report.snr_db:.2f} dB",
        "wire": f"{report.wire_bytes} bytes sent, {report.wire_bytes_back} received",
        "latency": f"{latency.algorithmic:.1f} ms codec + {latency.buffered:.1f} ms buffer, "
        f"{latency.end_to_end:.1f} ms to the skin",
        "underruns": f"{report.underruns}, lost packets {report.lost_packets}, reconnects {report.reconnects}",
        "actuator": f"{limits.name}, clipped {limits.clipped_samples}, limited by voltage {limits.voltage_limited}, "
        f"slew {limits.slew_limited}, power {limits.power_limited} samples",
        "decoded as sent": ANSWERS[report.decoded_equals_offline],
        "DAC as computed": ANSWERS[report.dac_equals_offline],
    }
