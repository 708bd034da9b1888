"""The subcommand `play`: plays a recording or a .vct file on a controller, and reports how it went."""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import click

from vibrocast import extras, progress, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.device_protocol.coded_stream import StreamError, packet_sequence
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import FAILED, InputError
from vibrocast.host import devices, player
from vibrocast.host.bench_limits import Judged, missed
from vibrocast.host.cli.answers import add, answer, wants_json
from vibrocast.host.cli.errors import CommandError, explained
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import INPUT, OutputFile, positive, reject_overwriting
from vibrocast.host.cli.options import (
    Chosen,
    QualityOptions,
    RecordingOptions,
    bench_actuator,
    bench_option,
    check_bench_actuator,
    devices_option,
    fail_where_missed,
    gain_option,
    grouped,
    hand_speed_option,
    loop_option,
    model_option,
    own_actuator,
    rate_hz_option,
    snr_db_option,
    unit_option,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, OUTPUT, PLAYBACK, SectionedCommand, section
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.host.cli.steps import (
    ANSWERS,
    describe_actuator,
    describe_card,
    describe_felt_error,
    describe_limits,
    describe_quality,
    encoded,
    encoded_profile,
    files_of,
    show,
    warn_of_underruns,
)
from vibrocast.host.controller import ControllerError
from vibrocast.host.limits import check_limits, playable
from vibrocast.host.report import SCHEMA, Provenance, Report, Touch, UnfinishedReport, write_json
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS, Actuator

if TYPE_CHECKING:
    from vibrocast.host import hand_playback, playback
    from vibrocast.host.bench_file import Bench

SILENT_DB = -200.0
"""Re detection threshold: below it the output is at rest."""


def chosen_hand(ctx: click.Context, param: click.Parameter, value: str | None) -> float | Path | None:
    """Return the length of a stroke in mm, or the file of a movement, or raise click.BadParameter."""
    if value is None:
        return None
    try:
        number = float(value)
    except ValueError:
        return Path(value)
    return positive("mm").convert(number, param, ctx)


@dataclass(frozen=True)
class PlaybackOptions:
    """How a texture is played. `hand`: the length of its stroke in mm, or the file of its movement."""

    loops: int
    gain_db: float
    actuator_name: str | None
    hand: float | Path | None


@dataclass(frozen=True)
class OutputOptions:
    """Files to write."""

    report_path: Path | None
    plot_path: Path | None


@click.command(cls=SectionedCommand)
@click.argument("file", type=INPUT)
@section(INPUT_SECTION, grouped("recording", RecordingOptions, rate_hz_option, unit_option, hand_speed_option))
@section(CODING, grouped("quality", QualityOptions, model_option, snr_db_option))
@section(CONTROLLER, bench_option, devices_option)
@grouped(
    "options",
    PlaybackOptions,
    section(
        CONTROLLER,
        click.option(
            "--actuator",
            "actuator_name",
            metavar="NAME|FILE",
            help=f"Model the actuator: {', '.join(ACTUATORS)} or a TOML file. Default: as the controller states.",
        ),
    ),
    section(
        PLAYBACK,
        loop_option,
        gain_option,
        click.option(
            "--hand",
            callback=chosen_hand,
            metavar="MM|FILE",
            help="Stroke a height profile, or follow a CSV file of time_s,position_mm.",
        ),
    ),
)
@section(
    OUTPUT,
    grouped(
        "outputs",
        OutputOptions,
        click.option("--report", "report_path", type=OutputFile(".json"), help="Write the figures as JSON."),
        click.option("--plot", "plot_path", type=OutputFile(".png", ".svg", ".pdf"), help="Draw the signals."),
    ),
)
def play(
    file: Path,
    bench: "Bench | None",
    chosen: tuple[Chosen, ...],
    options: PlaybackOptions,
    outputs: OutputOptions,
    quality: QualityOptions,
    recording: RecordingOptions,
) -> None:
    """Play a recording or a .vct file on one or several controllers.

    A recording is coded for a link that may lose packets: packets are short, and one in 0.25 s can be decoded alone.
    At the same rate, `vibrocast encode` reaches a higher SNR, and it has more options. Its .vct file plays as it is.

    With several --device, a controller that fails does not stop the others. The command prints a line for each.

    A height profile is played over time if you give --hand-speed-mm-s alone. It is played by the position of a hand if
    you give --hand: the length of its stroke, --loop times, or a file of its movement. --hand-speed-mm-s is the highest
    speed of the stroke.

    With --bench, --device may be a name in the file, and the exit code is 4 if a limit is missed.
    """
    if outputs.plot_path is not None:
        extras.require("plot")
    reject_overwriting([outputs.report_path, outputs.plot_path], [file, *files_of(quality.model)])
    given = None if options.actuator_name is None else actuator_files.find(options.actuator_name)
    names = dict(zip(devices.unique_names([each.address for each in chosen]), chosen, strict=True))
    actuators = {name: given or bench_actuator(bench, each) for name, each in names.items()}
    run = Run(file.name, names, actuators, bench, outputs)
    if len(chosen) > 1 and (options.hand or outputs.plot_path):
        raise click.UsageError("--hand and --plot are for one controller; give one --device")
    if options.hand is None:
        figures = play_over_time(run, file, quality, recording, options)
    else:
        figures = play_under_hand(run, file, quality, recording, options)
    fail_where_missed([] if bench is None else missed(bench.limits, figures))


def play_under_hand(
    run: "Run", file: Path, quality: QualityOptions, recording: RecordingOptions, options: PlaybackOptions
) -> Iterable[Judged]:
    """Play a height profile by the position of a hand on one controller, print how it went, and return the figures."""
    from vibrocast.host import hand_playback, playback

    if options.gain_db:
        raise click.UsageError("a profile under a hand has its own level; drop --gain-db")
    assert options.hand is not None, "a hand moves"
    ((name, chosen),) = run.names.items()
    own_actuator(chosen.address, options.actuator_name)
    movement = hand_playback.chosen_movement(options.hand, recording.hand_speed_mm_s, options.loops)
    stream, texture = spatial_stream(file, quality, replace(recording, hand_speed_mm_s=None))
    actuator = run.actuators[name]
    with (
        run.reported_where_cut(),
        devices.connect(chosen.address, actuator=actuator) as controller,
        progress.bar("playing") as update,
    ):
        check_bench_actuator(run.bench, chosen, controller.description.actuator)
        member = playback.member(controller, chosen.address, actuator)
        sha256 = run.provenance.bench_sha256
        stroke = hand_playback.play_and_compare(member, file.name, stream, movement, texture, sha256, update)
    tell_stroke(stroke, run.outputs)
    return stroke.report.judged()


def play_over_time(
    run: "Run", file: Path, quality: QualityOptions, recording: RecordingOptions, options: PlaybackOptions
) -> Iterable[Judged]:
    """Play a recording or a stream on all controllers, print how it went, and return the figures."""
    from vibrocast.host import playback

    source = read_source(file, quality, recording)
    channels, rate_hz = (
        (source.header.channels, source.header.rate_hz)
        if isinstance(source, Stream)
        else (source.channels, quality.stream_rate_hz)
    )
    with run.reported_where_cut():
        sessions = {
            name: devices.connect(each.address, actuator=run.actuators[name]) for name, each in run.names.items()
        }
        with devices.open_all(sessions) as (controllers, failures):
            members: dict[str, playback.Member] = {}
            for name, controller in controllers.items():
                check_bench_actuator(run.bench, run.names[name], controller.description.actuator)
                try:
                    # A stream that the controller cannot play need not be encoded first.
                    check_limits(controller, channels, rate_hz)
                except StreamError as error:
                    failures[name] = error
                else:
                    members[name] = playback.member(controller, run.names[name].address, run.actuators[name])
            outcomes: dict[str, playback.Outcome | Exception] = {}
            if members:
                if isinstance(source, Stream):
                    stream, encoding = source, None
                else:
                    encoding = encoded(source, quality, recording.unit, live=True)
                    stream = encoding.stream
                stream = stream.with_gain(options.gain_db)
                with progress.bar("playing") as update:
                    tell = playing(update, stream.bits_per_second, run.latest)
                    outcomes = playback.play_together(members, file.name, stream, encoding, options.loops, tell)
        outcomes = {name: run.traced((outcomes | failures)[name]) for name in run.names}
        (outcome, *others) = outcomes.values()
        if isinstance(outcome, Exception) and not others:
            raise outcome
    if others or isinstance(outcome, Exception):
        report_each(run, outcomes)
    else:
        tell_outcome(run, outcome, stream)
    reports = [each.report for each in outcomes.values() if not isinstance(each, Exception)]
    return [figure for report in reports for figure in report.judged()]


@dataclass(frozen=True)
class Run:
    """The playback of a file on controllers: by name those that are chosen, and how far each has played.

    Its reports are written and added to the answer where it does not come to its end, too; its last frames are kept.
    """

    file: str
    names: Mapping[str, Chosen]
    actuators: Mapping[str, Actuator | None]
    bench: "Bench | None"
    outputs: OutputOptions
    latest: dict[str, player.Progress] = field(default_factory=dict)

    def __post_init__(self) -> None:
        report_path = self.outputs.report_path
        trace_failure(report_path and report_path.with_suffix(".pcapng"))

    @cached_property
    def provenance(self) -> Provenance:
        """The origin of the reports."""
        return Provenance(None if self.bench is None else self.bench.sha256)

    def traced(self, outcome: "playback.Outcome | Exception") -> "playback.Outcome | Exception":
        """Return an outcome whose report names the bench file."""
        if isinstance(outcome, Exception):
            return outcome
        return replace(outcome, report=replace(outcome.report, run=self.provenance))

    def unfinished(self, name: str, error: BaseException) -> UnfinishedReport:
        """Return the report of a controller that has not played all."""
        now = self.latest.get(name)
        return UnfinishedReport(
            schema=SCHEMA,
            run=self.provenance,
            version=version("vibrocast"),
            file=self.file,
            device={"address": self.names[name].address},
            played_s=None if now is None else now.position_s,
            underruns=None if now is None else now.status.underruns,
            lost_packets=None if now is None else now.status.lost_packets,
            error=str(error) or "interrupted",
        )

    @contextlib.contextmanager
    def reported_where_cut(self) -> Iterator[None]:
        """Tell the reports where the block is interrupted, or a controller fails."""
        try:
            yield
        except (ControllerError, TransportError, MessageError, KeyboardInterrupt) as error:
            self.tell_reports([self.unfinished(name, error) for name in self.names])
            raise

    def tell_reports(self, reports: Sequence[Report | UnfinishedReport]) -> None:
        """Write the reports, and make them the answer in JSON; of several controllers, as a list. Raises OSError."""
        documents = [asdict(each) for each in reports]
        document = documents if len(documents) > 1 else documents[0]
        if self.outputs.report_path:
            write_json(self.outputs.report_path, document)
        answer(document)


def tell_outcome(run: Run, outcome: "playback.Outcome", given: Stream) -> None:
    """Print what one controller played, write it and draw it; `given`: the stream before it was fitted.

    Raises ControllerError if it played something else than was sent.
    """
    from vibrocast.host import picture

    report = outcome.report
    run.tell_reports([report])
    if run.outputs.plot_path:
        picture.draw(
            run.outputs.plot_path, f"{report.file} on {report.device.address}", outcome.caption, outcome.traces
        )
    if not wants_json():
        show(summary(outcome, given))
    if report.touch.level_db <= 0:
        click.echo("warning: nobody would feel this; raise --gain-db, or encode it with the right --unit", err=True)
    if report.sound_card:
        warn_of_underruns(report.sound_card)
    if report.differs:
        raise ControllerError(
            "the controller played something else than was sent: the lines above count underruns and lost packets; if "
            "there are any, use a shorter cable or a less busy machine, else flash the firmware again"
        )


def read_source(file: Path, quality: QualityOptions, recording: RecordingOptions) -> Stream | textures.Recording:
    """Return a .vct file, or a recording that is to be coded. Raises InputError, CodecError and TextureError."""
    from vibrocast.host import playback

    source: Stream | textures.Recording
    if file.suffix.lower() == ".vct":
        coded = coded_already(file, quality, replace(recording, unit=None) if recording.unit == "drive" else recording)
        if coded.header.spatial:
            raise InputError(f"{file}: coded over position; give --hand, and --hand-speed-mm-s for a stroke")
        source = playable(coded)
    else:
        source = textures.load(file, **recording.facts())
        if source.axes:
            raise InputError(
                f"{file}: three axes of one texture; encode it with --axis x, y or z, dft321 or norm, or none for one "
                "actuator for each axis; then play the .vct file"
            )
    playback.check_unit(source.header.unit if isinstance(source, Stream) else source.unit, recording.unit)
    return source


def report_each(run: Run, outcomes: "Mapping[str, playback.Outcome | Exception]") -> None:
    """Print a line for each of several controllers, and tell their reports.

    If one failed, or played something else than was sent, raises CommandError, with the exit code of all
    that failed; FAILED where theirs differ.
    """
    run.tell_reports(
        [run.unfinished(name, each) if isinstance(each, Exception) else each.report for name, each in outcomes.items()]
    )
    lines: dict[str, str] = {}
    failed: dict[str, int] = {}
    for name, each in outcomes.items():
        if isinstance(each, Exception):
            lines[name] = f"FAILED: {each}"
            failed[name] = explained(each, {}).exit_code
            continue
        report = each.report
        lines[name] = (
            f"played {report.loops} time(s), underruns {report.underruns}, lost packets {report.lost_packets}, "
            f"reconnects {report.reconnects}, decoded as sent {ANSWERS[report.decoded_equals_offline]}, "
            f"DAC as computed {ANSWERS[report.dac_equals_offline]}"
        )
        if report.differs:
            failed[name] = FAILED
    if not wants_json():
        show(lines)
    if failed:
        codes = set(failed.values())
        raise CommandError(
            f"{len(failed)} of {len(outcomes)} controllers failed: {', '.join(failed)}; the line of each says why",
            codes.pop() if len(codes) == 1 else FAILED,
        )


def spatial_stream(
    file: Path, quality: QualityOptions, recording: RecordingOptions
) -> tuple[Stream, textures.Recording | None]:
    """Return a height profile, or a .vct file of one, as a stream over position, and what was coded, where known.

    Raises InputError for any other.
    """
    if file.suffix.lower() == ".vct":
        stream, texture = coded_already(file, quality, recording), None
    else:
        encoding = encoded_profile(file, quality, recording)
        stream, texture = encoding.stream, encoding.recording
    if not stream.header.spatial:
        raise InputError(f"{file}: coded over time, not over position; encode the profile without --hand-speed-mm-s")
    return stream, texture


def tell_stroke(stroke: "hand_playback.Stroke", outputs: OutputOptions) -> None:
    """Print what was played under a hand, write it and draw it. Raises ControllerError where it is not as computed."""
    from vibrocast.host import hand_playback, picture

    report, played = stroke.report, stroke.played
    if outputs.report_path:
        report.write(outputs.report_path)
    if outputs.plot_path:
        pictured = hand_playback.pictured(played, stroke.expected, stroke.actuator)
        picture.draw(outputs.plot_path, f"{report.file} on {report.device.address}", *pictured)
    if wants_json():
        add(asdict(report))
    else:
        show(
            {
                "actuator": describe_actuator(report, None),
                "played": f"{report.file}, {report.length_mm:.2f} mm, under a hand at up to "
                f"{report.fastest_mm_s:.0f} mm/s for {report.seconds:.2f} s",
                "stream": f"{report.stream_bytes} bytes, {report.bits_per_mm:.0f} bit/mm, codec {report.codec}",
                "limits": describe_limits(report.actuator),
                "positions": f"{report.positions} sent, {report.underruns} came too late, damaged frames "
                f"{report.bad_frames} there, {report.bad_frames_back} back",
                **({"sound card": describe_card(report.sound_card)} if report.sound_card else {}),
                "DAC as computed": ANSWERS[report.dac_equals_offline],
            }
        )
    if report.dac_equals_offline is False:
        raise ControllerError(
            "the controller played something else than the positions ask for: one was lost on the way, or it renders "
            "wrongly; use a shorter cable or a less busy machine, then play again"
        )


def coded_already(file: Path, quality: QualityOptions, recording: RecordingOptions) -> Stream:
    """Read a .vct file to play, to which no option of the two groups applies but the model."""
    values = vars(replace(quality, model=None)) | vars(recording)
    given = [name for name, value in values.items() if value not in (None, {}, False, DEFAULT_STREAM_RATE_HZ)]
    if given:
        option = given[0].removesuffix("_name").replace("_", "-")
        raise click.UsageError(f"{file} is coded already; drop --{option}")
    return read_stream(file, quality.model.image if quality.model else None)


def playing(
    update: progress.Update, bits_per_second: float, latest: dict[str, player.Progress]
) -> Callable[[str, player.Progress], None]:
    """Return what tells `update` of a playback on named controllers: mean position, rate, least buffer, underruns.

    `latest`: is filled with the progress of each.
    """

    def tell(name: str, now: player.Progress) -> None:
        latest[name] = now
        position_s = sum(each.position_s for each in latest.values()) / len(latest)
        duration_s = now.duration_s or math.inf
        details = (
            f"{position_s:.1f} of {duration_s:.1f} s  {bits_per_second / 1000:.2f} kbit/s  "
            f"buffer {1000 * min(each.buffered_s for each in latest.values()):.0f} ms  "
            f"underruns {sum(each.status.underruns for each in latest.values())}"
        )
        update(position_s / duration_s, details)

    return tell


def describe_touch(touch: Touch) -> str:
    """Return how far the skin's vibration exceeds the detection threshold, in words."""
    if touch.level_db > 0:
        return f"peak {touch.level_db:+.0f} dB re detection threshold at {touch.frequency_hz:.0f} Hz"
    level = f"peak {touch.level_db:.0f} dB at {touch.frequency_hz:.0f} Hz" if touch.level_db > SILENT_DB else "silence"
    return f"nothing exceeds the detection threshold ({level})"


def describe_packets(stream: Stream, given: Stream) -> str:
    """Return how long the packets of a stream are, and how often one can be decoded alone, in words.

    `given`: the stream before its packets were split for the controller.
    """
    packet_samples = stream.decoder().packet_samples
    packet_s = packet_samples / stream.header.rate_hz
    alone = [number for number, packet in enumerate(stream.packets) if packet_sequence(packet)[1]]
    often = f"one in {packet_s * (alone[1] - alone[0]):.2f} s" if len(alone) > 1 else "only the first"
    longer = given.decoder().packet_samples / packet_samples
    split = f", split from {1000 * packet_s * longer:.1f} ms for this controller" if longer > 1 else ""
    return f"{1000 * packet_s:.1f} ms each, {often} can be decoded alone{split}"


def describe_comparison(equal: bool | None, report: Report) -> str:
    """Return whether what was read back is as computed, or why that is not known."""
    return f"{ANSWERS[equal]}: {report.comparison_note}" if equal is None and report.comparison_note else ANSWERS[equal]


def summary(outcome: "playback.Outcome", given: Stream) -> dict[str, object]:
    """Return the lines that `play` prints at its end; `given`: the stream before it was fitted to the controller."""
    report = outcome.report
    latency = report.latency_ms
    return {
        "coded": describe_quality(report),
        "felt error": describe_felt_error(report.felt_error),
        "actuator": describe_actuator(report, report.skin_note),
        "played": f"{report.file}, {report.seconds:.2f} s, {report.channels} channel(s), {report.loops} time(s)",
        "stream": f"{report.stream_bytes} bytes, {report.bits_per_second:.0f} bit/s, "
        f"{report.bits_per_sample:.2f} bit/sample, codec {report.codec}"
        + (f", model {report.model}" if report.model else ""),
        "packets": describe_packets(outcome.stream, given),
        "wire": f"{report.wire_bytes} bytes sent, {report.wire_bytes_back} received, damaged frames "
        f"{report.bad_frames} there, {report.bad_frames_back} back",
        "latency": f"{latency.algorithmic:.1f} ms codec + {latency.buffered:.1f} ms buffer, "
        f"{latency.end_to_end:.1f} ms to the skin",
        "underruns": f"{report.underruns}, lost packets {report.lost_packets}, reconnects {report.reconnects}",
        **({"sound card": describe_card(report.sound_card)} if report.sound_card else {}),
        "limits": describe_limits(report.actuator),
        "touch": describe_touch(report.touch),
        "decoded as sent": describe_comparison(report.decoded_equals_offline, report),
        "DAC as computed": describe_comparison(report.dac_equals_offline, report),
    }
