"""The subcommand `play`: plays a recording or a .vct file on a controller, and reports how it went."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import click

from vibrocast import extras, progress, textures
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.device_protocol.coded_stream import STREAM_SUFFIX
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import BAD_INPUT, FAILED, InputError
from vibrocast.files import plain
from vibrocast.host import devices, hand_playback, picture
from vibrocast.host.bench_file import Bench, BenchController, connect
from vibrocast.host.cli.answers import answer, tell, wants_json
from vibrocast.host.cli.controls import Control, keys
from vibrocast.host.cli.describe import describe_comparison, describe_dac, describe_packets, tell_report
from vibrocast.host.cli.errors import CommandError, controllers_failed, explained, option_names
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile, Whole, positive, reject_overwriting
from vibrocast.host.cli.options import (
    QualityOptions,
    RecordingOptions,
    bench_option,
    devices_option,
    gain_option,
    grouped,
    hand_speed_option,
    judge,
    lsl_option,
    model_option,
    rate_hz_option,
    snr_db_option,
    unit_option,
)
from vibrocast.host.cli.sections import CODING, CONTROLLER, MORE, OUTPUT, PLAYBACK, SectionedCommand, section
from vibrocast.host.cli.steps import encoded_profile, files_of, lines_of, reject_coding_options, show
from vibrocast.host.controller import ControllerError
from vibrocast.host.devices import Session
from vibrocast.host.lab_network import Markers
from vibrocast.host.playback import Playback
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.report import Provenance, UnfinishedReport, write_json
from vibrocast.host.track_player import Event, PlayedList, Remote, TrackOptions, play_list, tracks_of
from vibrocast.output import actuator_files
from vibrocast.output.actuator import ACTUATORS

_DB_A_BLOCK, _BLOCKS = 4.0, 10


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
class PlayOptions:
    """Where and how tracks are played, and files to write.

    `hand`: the length of its stroke in mm, or the file of its movement.
    """

    actuator_name: str | None
    hand: float | Path | None
    control_path: Path | None
    has_markers: bool
    report_path: Path | None
    plot_path: Path | None


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast play examples/oak.wav --plot oak.png\n"
    "vibrocast play oak.vct --device serial:/dev/ttyACM0 --loop 0",
)
@click.argument("files", type=INPUT, nargs=-1, required=True)
@section(MORE, grouped("recording", RecordingOptions, rate_hz_option, unit_option, hand_speed_option))
@section(CODING, grouped("quality", QualityOptions, model_option, snr_db_option))
@section(CONTROLLER, bench_option, devices_option)
@section(
    PLAYBACK,
    grouped(
        "playing",
        TrackOptions,
        click.option(
            "--loop",
            "loops",
            type=Whole("PASSES", 0, 65_535),
            default=1,
            help="Times to play the track or the list; 0: without end.",
        ),
        gain_option,
        section(
            MORE,
            click.option(
                "--from", "from_s", type=Number("S", 0), default=0.0, help="Second at which each track begins."
            ),
            click.option("--to", "to_s", type=positive("S"), help="Second at which each track ends."),
            click.option("--shuffle", is_flag=True, help="Play the list in random order."),
            click.option(
                "--reconnect",
                "reconnect_s",
                type=Number("S", 0),
                default=RECONNECT_S,
                help="Seconds to open a lost connection again; 0: end.",
            ),
        ),
    ),
)
@grouped(
    "options",
    PlayOptions,
    section(
        CONTROLLER,
        click.option(
            "--actuator",
            "actuator_name",
            metavar="NAME|FILE",
            help=f"Actuator: {', '.join(ACTUATORS)} or a TOML file. Default: as the controller states.",
        ),
    ),
    section(
        MORE,
        click.option(
            "--control",
            "control_path",
            type=OutputFile(),
            metavar="SOCKET",
            help="Unix socket for commands, one a line.",
        ),
        lsl_option,
    ),
    section(
        PLAYBACK,
        click.option(
            "--hand",
            callback=chosen_hand,
            metavar="MM|FILE",
            help="Stroke over a height profile, or a CSV file of time_s,position_mm.",
        ),
    ),
    section(
        OUTPUT,
        click.option("--report", "report_path", type=OutputFile(".json"), help="JSON file for the figures."),
        click.option(
            "--plot",
            "plot_path",
            type=OutputFile(".png", ".svg", ".pdf"),
            help="Picture of the signals: .png, .svg or .pdf.",
        ),
    ),
)
def play(
    files: tuple[Path, ...],
    bench: Bench | None,
    chosen: tuple[BenchController, ...],
    options: PlayOptions,
    playing: TrackOptions,
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
    tracks = tracks_of(files)
    written = [options.report_path, options.plot_path, options.control_path]
    reject_overwriting(written, [*tracks, *files_of(quality.model)])
    names = dict(zip(devices.unique_names([each.address for each in chosen]), chosen, strict=True))
    reject_several(len(names), len(tracks), options)
    run = Run(tracks[0].name, names, bench, options)
    if options.hand is not None:
        report(run, play_under_hand(run, tracks[0], playing, quality, recording))
        return
    played = play_over_time(run, tracks, playing, quality, recording)
    if len(tracks) > 1:
        report_list(played)
    else:
        report(run, {name: each.playback if isinstance(each, PlayedList) else each for name, each in played.items()})


def reject_several(controllers: int, tracks: int, options: PlayOptions) -> None:
    """Raise click.UsageError for an option that takes one controller or one track, where there are several."""
    if controllers > 1 and (options.hand or options.plot_path):
        raise click.UsageError("--hand and --plot are for one controller; give one --device")
    if tracks > 1 and (options.hand or options.plot_path or options.report_path):
        raise click.UsageError("--hand, --plot and --report are for one track; give one file")


def play_over_time(
    run: "Run", tracks: list[Path], playing: TrackOptions, quality: QualityOptions, recording: RecordingOptions
) -> dict[str, PlayedList | Exception]:
    """Play tracks on all controllers; return by name what each did, or its error."""
    if len(tracks) == 1:
        reject_coding_options(tracks[0], quality, recording)
    arguments = quality.arguments(recording.unit)
    del arguments["rate_bps"]
    opening = replace(playing, facts=recording.facts(), arguments=arguments, model=quality.model)
    remote = Remote()
    with contextlib.ExitStack() as stack:
        stack.enter_context(run.reported_where_cut())
        opened_sessions = devices.open_all({name: run.session(name) for name in run.names})
        sessions, failures = stack.enter_context(opened_sessions)
        path = run.options.control_path
        control = stack.enter_context(contextlib.closing(Control(path, remote))) if path else None
        markers = Markers(tracks[0].name) if run.options.has_markers else None
        stack.enter_context(keys(remote))
        played = play_list(
            sessions,
            tracks,
            opening,
            remote=remote,
            tell=telling(run.latest, stack.enter_context(progress.bar("playing")), control, markers),
            provenance=run.provenance,
        )
    return {name: (played | failures)[name] for name in run.names}


def telling(
    latest: dict[str, Event], update: progress.Update, control: Control | None, markers: Markers | None
) -> Callable[[str, Event], None]:
    """Return what shows where players are, tells the clients of a socket, and notes it for a report.

    The markers are those of the first player alone.

    A track that cannot be played gets a line. With several controllers it shows the one that told last, the least
    buffer, and the losses of all.
    """

    options = option_names(click.get_current_context().command)

    def tell(name: str, event: Event) -> None:
        latest[name] = event
        if control is not None:
            control.tell(event)
        if markers is not None and name == next(iter(latest)):
            markers.tell(event)
        if event.error is not None and event.tracks > 1:
            reason = explained(event.error, options).format_message()
            place = "" if event.track in reason else f"{event.track}: "
            print(plain(f"{place}{reason}; the list goes on"), file=sys.stderr)
        level = "" if event.level_db is None else f"  {event.level_db:+.0f} dB {event.level_of} {meter(event.level_db)}"
        every = latest.values()
        update(
            event.position_s / event.seconds if event.seconds else None,
            f"[{event.number}/{event.tracks}] {plain(event.track)}  {event.position_s:.1f} of {event.seconds:.1f} s"
            f"{'  paused' if event.paused else ''}{f'  gain {event.gain_db:+g} dB' if event.gain_db else ''}"
            f"{level}  buffer {1000 * min(each.buffered_s for each in every):.0f} ms  "
            f"lost {sum(each.lost_packets for each in every)}  underruns {sum(each.underruns for each in every)}",
        )

    return tell


def meter(level_db: float) -> str:
    """Return a bar for a level from 0 to 40 dB."""
    blocks = round(min(max(level_db / _DB_A_BLOCK, 0.0), _BLOCKS))
    return "#" * blocks + "." * (_BLOCKS - blocks)


def play_under_hand(
    run: "Run", file: Path, playing: TrackOptions, quality: QualityOptions, recording: RecordingOptions
) -> dict[str, Playback]:
    """Play a height profile by the position of a hand on one controller; return what it did."""
    options = run.options
    if playing.gain_db:
        raise click.UsageError("a profile under a hand has its own level; drop --gain-db")
    assert options.hand is not None, "a hand moves"
    (name,) = run.names
    movement = hand_playback.chosen_movement(options.hand, recording.hand_speed_mm_s, playing.loops)
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
    names: Mapping[str, BenchController]
    bench: Bench | None
    options: PlayOptions
    latest: dict[str, Event] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.options.plot_path is not None:
            extras.require("plot")
        report_path = self.options.report_path
        trace_failure(report_path and report_path.with_suffix(".pcapng"))

    def session(self, name: str) -> AbstractContextManager[Session]:
        """Return a session with one of the controllers, still closed, behind which is the actuator that was chosen."""
        given = self.options.actuator_name
        return connect(self.bench, self.names[name], None if given is None else actuator_files.find(given))

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

    def tell_reports(self, outcomes: Mapping[str, Playback | BaseException]) -> None:
        """Write the reports, and make them the answer in JSON; of several controllers, as a list. Raises OSError."""
        reports = [
            self.unfinished(name, each) if isinstance(each, BaseException) else each.report
            for name, each in outcomes.items()
        ]
        documents = [asdict(each) for each in reports]
        document = documents if len(documents) > 1 else documents[0]
        if self.options.report_path:
            write_json(self.options.report_path, document)
        answer(document)


def report(run: Run, played: Mapping[str, Playback | Exception | None]) -> None:
    """Print and write how controllers played a texture, and judge it. Raises the error of one, and CommandError.

    None stands for one that a person has stopped.
    """
    outcomes = {name: each for name, each in played.items() if each is not None}
    if not outcomes:
        tell("stopped before its end")
        return
    run.tell_reports(outcomes)
    if len(outcomes) > 1:
        report_each(outcomes)
    else:
        report_one(run, *outcomes.values())
    whole = [each for each in outcomes.values() if isinstance(each, Playback)]
    judge(run.bench, [figure for each in whole for figure in each.report.figures()])


def report_one(run: Run, played: Playback | Exception) -> None:
    """Print what one controller played, and draw it.

    Raises the error that it met.
    """
    if isinstance(played, Exception):
        raise played
    report, path = played.report, run.options.plot_path
    if path:
        picture.draw(path, f"{report.file} on {report.device.address}", played.caption, played.traces)
    packets = None
    if played.stream is not None and report.position is None:
        packets = describe_packets(played.stream, played.given_samples)
    tell_report(report, packets)


def report_each(outcomes: Mapping[str, Playback | Exception]) -> None:
    """Print a line for each of several controllers.

    If one failed, or played something else than was sent, raises CommandError, with the exit code of all
    that failed; FAILED where theirs differ.
    """

    def line(played: Playback) -> str:
        report = played.report
        return (
            f"played {report.loops} time(s), underruns {report.underruns}, lost packets {report.lost_packets}, "
            f"reconnects {report.reconnects}, decoded as sent "
            f"{describe_comparison(report.decoded_equals_offline, report)}, DAC as computed {describe_dac(report)}"
        )

    lines, failed = lines_of(outcomes, line)
    failed |= {name: FAILED for name, each in outcomes.items() if isinstance(each, Playback) and each.report.differs}
    if not wants_json():
        show(lines, as_words=False)
    if failed:
        raise controllers_failed(failed, len(outcomes))


def report_list(played: Mapping[str, PlayedList | Exception]) -> None:
    """Print how controllers played a list. Raises CommandError where a controller or a track failed."""

    def line(each: PlayedList) -> str:
        results = [result for _, result in each.played]
        return (
            f"played {len(results)} track(s), underruns {sum(each.underruns for each in results)}, "
            f"lost packets {sum(each.lost_packets for each in results)}, "
            f"reconnects {sum(each.reconnects for each in results)}"
        )

    lines, failed = lines_of(played, line)
    show(lines, as_words=False)
    tracks = [name for each in played.values() if isinstance(each, PlayedList) for name in each.failures]
    if failed or tracks:
        named = ", ".join(dict.fromkeys([*failed, *tracks]))
        exit_code = next(iter(failed.values()), BAD_INPUT)
        raise CommandError(f"not all was played: {named}; the line of each says why", exit_code)


def spatial_stream(
    file: Path, quality: QualityOptions, recording: RecordingOptions
) -> tuple[Stream, textures.Recording | None]:
    """Return a height profile, or a .vct file of one, as a stream over position, and what was coded, where known.

    Raises InputError for any other.
    """
    if file.suffix.lower() == STREAM_SUFFIX:
        reject_coding_options(file, quality, recording)
        stream, texture = read_stream(file, quality.model.image if quality.model else None), None
    else:
        encoding = encoded_profile(file, quality, recording)
        stream, texture = encoding.stream, encoding.recording
    if not stream.header.spatial:
        raise InputError(f"{file}: coded over time, not over position; encode the profile without --hand-speed-mm-s")
    return stream, texture
