"""The subcommand `play`: plays a recording or a .vct file on a controller, and reports how it went."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import click

from vibrocast import extras, progress, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import FAILED, InputError
from vibrocast.host import devices, player
from vibrocast.host.cli.answers import answer, wants_json
from vibrocast.host.cli.describe import ANSWERS, describe_packets, tell_report
from vibrocast.host.cli.errors import CommandError, explained
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import INPUT, OutputFile, positive, reject_overwriting
from vibrocast.host.cli.options import (
    Chosen,
    QualityOptions,
    RecordingOptions,
    bench_option,
    devices_option,
    gain_option,
    grouped,
    hand_speed_option,
    judge,
    loop_option,
    model_option,
    opened,
    own_actuator,
    rate_hz_option,
    snr_db_option,
    unit_option,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, OUTPUT, PLAYBACK, SectionedCommand, section
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.host.cli.steps import encoded, encoded_profile, files_of, show
from vibrocast.host.controller import ControllerError
from vibrocast.host.limits import check_limits, playable
from vibrocast.host.report import Provenance, UnfinishedReport, write_json
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS

if TYPE_CHECKING:
    from vibrocast.host import playback
    from vibrocast.host.bench_file import Bench
    from vibrocast.host.session import Session

    Outcomes = tuple[dict[str, playback.Playback | Exception], Stream | None]


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

    With --bench, --device may be a name in the file. The exit code is 4 if a limit is missed; without --bench, at most
    1 % of the packets may be lost.
    """
    if outputs.plot_path is not None:
        extras.require("plot")
    reject_overwriting([outputs.report_path, outputs.plot_path], [file, *files_of(quality.model)])
    names = dict(zip(devices.unique_names([each.address for each in chosen]), chosen, strict=True))
    if len(names) > 1 and (options.hand or outputs.plot_path):
        raise click.UsageError("--hand and --plot are for one controller; give one --device")
    run = Run(file.name, names, bench, options, outputs)
    play_it = play_over_time if options.hand is None else play_under_hand
    outcomes, given = play_it(run, file, quality, recording)
    (report_each if len(outcomes) > 1 else report_one)(run, outcomes, given)
    played = [each for each in outcomes.values() if not isinstance(each, Exception)]
    judge(bench, [figure for each in played for figure in each.report.judged()])


def play_under_hand(run: "Run", file: Path, quality: QualityOptions, recording: RecordingOptions) -> "Outcomes":
    """Play a height profile by the position of a hand on one controller; return what it did, and the stream."""
    from vibrocast.host import hand_playback

    options = run.options
    if options.gain_db:
        raise click.UsageError("a profile under a hand has its own level; drop --gain-db")
    assert options.hand is not None, "a hand moves"
    ((name, chosen),) = run.names.items()
    own_actuator(chosen.address, options.actuator_name)
    movement = hand_playback.chosen_movement(options.hand, recording.hand_speed_mm_s, options.loops)
    stream, texture = spatial_stream(file, quality, replace(recording, hand_speed_mm_s=None))
    with run.reported_where_cut(), run.session(name) as session, progress.bar("playing") as update:
        played = hand_playback.play_and_compare(session, file.name, stream, movement, texture, update, run.provenance)
    return {name: played}, stream


def play_over_time(run: "Run", file: Path, quality: QualityOptions, recording: RecordingOptions) -> "Outcomes":
    """Play a recording or a stream on all controllers; return by name what each did, or its error, and the stream."""
    from vibrocast.host import playback

    source = read_source(file, quality, recording)
    channels, rate_hz = (
        (source.header.channels, source.header.rate_hz)
        if isinstance(source, Stream)
        else (source.channels, quality.stream_rate_hz)
    )
    stream = encoding = None
    outcomes: dict[str, playback.Playback | Exception] = {}
    with (
        run.reported_where_cut(),
        devices.open_all({name: run.session(name) for name in run.names}) as (sessions, failures),
    ):
        for name, session in sessions.items():
            try:
                # A stream that the controller cannot play need not be encoded first.
                check_limits(session.controller, channels, rate_hz)
            except StreamError as error:
                failures[name] = error
        able = {name: session for name, session in sessions.items() if name not in failures}
        if able:
            if not isinstance(source, Stream):
                encoding = encoded(source, quality, recording.unit, live=True)
                source = encoding.stream
            stream = source.with_gain(run.options.gain_db)
            with progress.bar("playing") as update:
                tell = playing(update, stream.bits_per_second, run.latest)
                outcomes = playback.play_together(
                    able, file.name, stream, encoding, run.options.loops, tell, run.provenance
                )
    return {name: (outcomes | failures)[name] for name in run.names}, stream


@dataclass(frozen=True)
class Run:
    """The playback of a file on controllers: by name those that are chosen, and how far each has played.

    Its reports are written and added to the answer where it does not come to its end, too; its last frames are kept.
    """

    file: str
    names: Mapping[str, Chosen]
    bench: "Bench | None"
    options: PlaybackOptions
    outputs: OutputOptions
    latest: dict[str, player.Progress] = field(default_factory=dict)

    def __post_init__(self) -> None:
        report_path = self.outputs.report_path
        trace_failure(report_path and report_path.with_suffix(".pcapng"))

    def session(self, name: str) -> "AbstractContextManager[Session]":
        """Return a session with one of the controllers, still closed, behind which is the actuator that was chosen."""
        given = self.options.actuator_name
        return opened(self.bench, self.names[name], None if given is None else actuator_files.find(given))

    @cached_property
    def provenance(self) -> Provenance:
        """The origin of the reports."""
        return Provenance(None if self.bench is None else self.bench.sha256)

    def unfinished(self, name: str, error: BaseException) -> UnfinishedReport:
        """Return the report of a controller that has not played all."""
        now = self.latest.get(name)
        return UnfinishedReport(
            run=self.provenance,
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
            self.tell_reports(dict.fromkeys(self.names, error))
            raise

    def tell_reports(self, outcomes: "Mapping[str, playback.Playback | BaseException]") -> None:
        """Write the reports, and make them the answer in JSON; of several controllers, as a list. Raises OSError."""
        reports = [
            self.unfinished(name, each) if isinstance(each, BaseException) else each.report
            for name, each in outcomes.items()
        ]
        documents = [asdict(each) for each in reports]
        document = documents if len(documents) > 1 else documents[0]
        if self.outputs.report_path:
            write_json(self.outputs.report_path, document)
        answer(document)


def report_one(run: Run, outcomes: "Mapping[str, playback.Playback | Exception]", given: Stream | None) -> None:
    """Print what one controller played, write it and draw it; `given`: the stream before it was fitted.

    Raises the error that it met, and ControllerError if it played something else than was sent.
    """
    from vibrocast.host import picture

    run.tell_reports(outcomes)
    (played,) = outcomes.values()
    if isinstance(played, Exception):
        raise played
    report = played.report
    if run.outputs.plot_path:
        picture.draw(run.outputs.plot_path, f"{report.file} on {report.device.address}", played.caption, played.traces)
    packets = None
    if played.stream is not None and given is not None and report.position is None:
        packets = describe_packets(played.stream, given)
    tell_report(report, packets)


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


def report_each(run: Run, outcomes: "Mapping[str, playback.Playback | Exception]", given: Stream | None) -> None:
    """Print a line for each of several controllers, and tell their reports.

    If one failed, or played something else than was sent, raises CommandError, with the exit code of all
    that failed; FAILED where theirs differ.
    """
    run.tell_reports(outcomes)
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
