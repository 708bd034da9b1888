"""The subcommand `play`: plays a recording or a .vct file on a controller, and reports how it went."""

import contextlib
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
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import BAD_INPUT, FAILED, InputError
from vibrocast.files import plain
from vibrocast.host import devices
from vibrocast.host.cli.answers import answer, tell, wants_json
from vibrocast.host.cli.controls import Control, keys
from vibrocast.host.cli.describe import ANSWERS, describe_packets, tell_report
from vibrocast.host.cli.errors import CommandError, controllers_failed, explained, option_names
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, positive, reject_overwriting
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
    model_option,
    opened,
    own_actuator,
    rate_hz_option,
    snr_db_option,
    unit_option,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, OUTPUT, PLAYBACK, SectionedCommand, section
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.host.cli.steps import encoded_profile, files_of, show
from vibrocast.host.controller import ControllerError
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.report import Provenance, UnfinishedReport, write_json
from vibrocast.host.tracks import STREAM_SUFFIX, TrackOptions, tracks_of
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS

_DB_A_BLOCK, _BLOCKS = 4.0, 10

if TYPE_CHECKING:
    from vibrocast.host import playback
    from vibrocast.host.bench_file import Bench
    from vibrocast.host.session import Session
    from vibrocast.host.track_player import Event, PlayedList

    Outcomes = dict[str, playback.Playback | Exception]
    Played = dict[str, PlayedList | Exception]


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
    """How tracks are played. `hand`: the length of its stroke in mm, or the file of its movement."""

    loops: int
    gain_db: float
    actuator_name: str | None
    hand: float | Path | None
    from_s: float
    to_s: float | None
    shuffle: bool
    control_path: Path | None
    reconnect_s: float


@dataclass(frozen=True)
class OutputOptions:
    """Files to write."""

    report_path: Path | None
    plot_path: Path | None


@click.command(cls=SectionedCommand)
@click.argument("files", type=INPUT, nargs=-1, required=True)
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
        click.option(
            "--loop",
            "loops",
            type=Whole("PASSES", 0, 65_535),
            default=1,
            show_default=True,
            help="Repeat the track or the list; 0: without end.",
        ),
        gain_option,
        click.option("--from", "from_s", type=Number("S", 0), default=0.0, help="Begin each track later."),
        click.option("--to", "to_s", type=positive("S"), help="End each track there."),
        click.option("--shuffle", is_flag=True, help="Play the list in random order."),
        click.option(
            "--control",
            "control_path",
            type=OutputFile(),
            metavar="SOCKET",
            help="Take commands from a Unix socket, one a line.",
        ),
        click.option(
            "--reconnect",
            "reconnect_s",
            type=Number("S", 0),
            default=RECONNECT_S,
            show_default=True,
            help="Open a lost connection again for so long; 0: end.",
        ),
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
    files: tuple[Path, ...],
    bench: "Bench | None",
    chosen: tuple[Chosen, ...],
    options: PlaybackOptions,
    outputs: OutputOptions,
    quality: QualityOptions,
    recording: RecordingOptions,
) -> None:
    """Play recordings, .vct files, folders and .m3u lists of them.

    A recording plays at once, and is coded meanwhile for a link that may lose packets: packets are short, and one in
    0.25 s can be decoded alone. At the same rate, `vibrocast encode` reaches a higher SNR, and it has more options. Its
    .vct file plays as it is.

    In a terminal, space pauses, left and right move by 1 s, up and down change the level by 1 dB, n and p change the
    track, l repeats the list, q ends. A track that cannot be played is named, and the list goes on. The report compares
    a single track with the same computed here. Several --device begin each track at one time.

    A height profile is played over time if you give --hand-speed-mm-s alone. It is played by the position of a hand if
    you give --hand: the length of its stroke, --loop times, or a file of its movement. --hand-speed-mm-s is the highest
    speed of the stroke.

    With --bench, --device may be a name in the file. The exit code is 4 if a limit is missed; without --bench, at most
    1 % of the packets may be lost.
    """
    if outputs.plot_path is not None:
        extras.require("plot")
    tracks = tracks_of(files)
    written = [outputs.report_path, outputs.plot_path, options.control_path]
    reject_overwriting(written, [*tracks, *files_of(quality.model)])
    names = dict(zip(devices.unique_names([each.address for each in chosen]), chosen, strict=True))
    reject_several(len(names), len(tracks), options, outputs)
    run = Run(tracks[0].name, names, bench, options, outputs)
    if options.hand is not None:
        report(run, play_under_hand(run, tracks[0], quality, recording), 0)
    elif len(tracks) == 1:
        report_track(run, play_over_time(run, tracks, quality, recording))
    else:
        report_list(play_over_time(run, tracks, quality, recording))


def reject_several(controllers: int, tracks: int, options: PlaybackOptions, outputs: OutputOptions) -> None:
    """Raise click.UsageError for an option that takes one controller or one track, where there are several."""
    if controllers > 1 and (options.hand or outputs.plot_path):
        raise click.UsageError("--hand and --plot are for one controller; give one --device")
    if tracks > 1 and (options.hand or outputs.plot_path or outputs.report_path):
        raise click.UsageError("--hand, --plot and --report are for one track; give one file")


def play_over_time(run: "Run", tracks: list[Path], quality: QualityOptions, recording: RecordingOptions) -> "Played":
    """Play tracks on all controllers; return by name what each did, or its error."""
    from vibrocast.host.track_player import Remote, play_list

    options = run.options
    if len(tracks) == 1:
        reject_coding_options(tracks[0], quality, recording)
    opening = TrackOptions(
        facts=recording.facts(),
        arguments={key: value for key, value in quality.arguments(recording.unit).items() if key != "rate_bps"},
        model=quality.model,
        from_s=options.from_s,
        to_s=options.to_s,
        gain_db=options.gain_db,
        loops=options.loops,
        shuffle=options.shuffle,
        reconnect_s=options.reconnect_s,
    )
    remote = Remote()
    with contextlib.ExitStack() as stack:
        stack.enter_context(run.reported_where_cut())
        opened_sessions = devices.open_all({name: run.session(name) for name in run.names})
        sessions, failures = stack.enter_context(opened_sessions)
        control = Control(options.control_path, remote) if options.control_path else None
        if control is not None:
            stack.enter_context(contextlib.closing(control))
        stack.enter_context(keys(remote))
        played = play_list(
            sessions,
            tracks,
            opening,
            remote=remote,
            tell=telling(run.latest, stack.enter_context(progress.bar("playing")), control),
            provenance=run.provenance,
        )
    return {name: (played | failures)[name] for name in run.names}


def telling(
    latest: "dict[str, Event]", update: progress.Update, control: Control | None
) -> "Callable[[str, Event], None]":
    """Return what shows where players are, tells the clients of a socket, and notes it for a report.

    A track that cannot be played gets a line. With several controllers it shows the one that told last, the least
    buffer, and the losses of all.
    """

    options = option_names(click.get_current_context().command)

    def tell(name: str, event: "Event") -> None:
        latest[name] = event
        if control is not None:
            control.tell(event)
        if event.error is not None and event.tracks > 1:
            reason = explained(event.error, options).format_message()
            place = "" if event.track in reason else f"{event.track}: "
            click.echo(plain(f"{place}{reason}; the list goes on"), err=True)
        level = "" if event.level_db is None else f"  {event.level_db:+.0f} dB {event.level_of} {meter(event.level_db)}"
        every = latest.values()
        update(
            event.position_s / event.seconds if event.seconds else None,
            f"[{event.number}/{event.tracks}] {plain(event.track)}  {event.position_s:.1f} of {event.seconds:.1f} s"
            f"{level}  buffer {1000 * min(each.buffered_s for each in every):.0f} ms  "
            f"lost {sum(each.lost_packets for each in every)}  underruns {sum(each.underruns for each in every)}",
        )

    return tell


def meter(level_db: float) -> str:
    """Return a bar for a level from 0 to 40 dB."""
    blocks = round(min(max(level_db / _DB_A_BLOCK, 0.0), _BLOCKS))
    return "#" * blocks + "." * (_BLOCKS - blocks)


def report_track(run: "Run", played: "Played") -> None:
    """Report how controllers played a track. Raises the error of one, and CommandError."""
    outcomes: Outcomes = {}
    given_samples = 0
    for name, each in played.items():
        if isinstance(each, Exception):
            outcomes[name] = each
        elif each.playback is not None:
            outcomes[name] = each.playback
            given_samples = each.played[0].track.given_samples
    if outcomes:
        report(run, outcomes, given_samples)
    else:
        tell("stopped before its end")


def report_list(played: "Played") -> None:
    """Print how controllers played a list. Raises CommandError where a controller or a track failed."""
    lines: dict[str, str] = {}
    failed: list[str] = []
    exit_code = BAD_INPUT
    for name, each in played.items():
        if isinstance(each, Exception):
            lines[name] = f"FAILED: {each}"
            failed.append(name)
            exit_code = explained(each, {}).exit_code
            continue
        results = [result for _, result in each.played]
        lines[name] = (
            f"played {len(results)} track(s), underruns {sum(each.underruns for each in results)}, "
            f"lost packets {sum(each.lost_packets for each in results)}, "
            f"reconnects {sum(each.reconnects for each in results)}"
        )
        failed += each.failures
    show(lines, as_words=False)
    if failed:
        named = ", ".join(dict.fromkeys(failed))
        raise CommandError(f"not all was played: {named}; the line of each says why", exit_code)


def report(run: "Run", outcomes: "Outcomes", given_samples: int) -> None:
    """Print and write how controllers played a texture, and judge it. Raises the error of one, and CommandError."""
    if len(outcomes) > 1:
        report_each(run, outcomes)
    else:
        report_one(run, outcomes, given_samples)
    played = [each for each in outcomes.values() if not isinstance(each, Exception)]
    judge(run.bench, [figure for each in played for figure in each.report.figures()])


def play_under_hand(run: "Run", file: Path, quality: QualityOptions, recording: RecordingOptions) -> "Outcomes":
    """Play a height profile by the position of a hand on one controller; return what it did."""
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
    return {name: played}


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
    latest: "dict[str, Event]" = field(default_factory=dict)

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
            underruns=None if now is None else now.underruns,
            lost_packets=None if now is None else now.lost_packets,
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


def report_one(run: Run, outcomes: "Outcomes", given_samples: int) -> None:
    """Print what one controller played, write it and draw it; `given_samples`: as in `Track`.

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
    if played.stream is not None and report.position is None:
        packets = describe_packets(played.stream, given_samples)
    tell_report(report, packets)


def report_each(run: Run, outcomes: "Outcomes") -> None:
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
        show(lines, as_words=False)
    if failed:
        raise controllers_failed(failed, len(outcomes))


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
    reject_coding_options(file, quality, recording)
    return read_stream(file, quality.model.image if quality.model else None)


def reject_coding_options(file: Path, quality: QualityOptions, recording: RecordingOptions) -> None:
    """Raise click.UsageError for an option that does not apply to a file, which is a .vct file."""
    if file.suffix.lower() != STREAM_SUFFIX:
        return
    facts = replace(recording, unit=None) if recording.unit == "drive" else recording
    values = vars(replace(quality, model=None)) | vars(facts)
    given = [name for name, value in values.items() if value not in (None, {}, False, DEFAULT_STREAM_RATE_HZ)]
    if given:
        option = given[0].removesuffix("_name").replace("_", "-")
        raise click.UsageError(f"{file} is coded already; drop --{option}")
