"""`vibrocast bench`: measures every codec on a data set and writes figures, charts and a page."""

import datetime
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vibrocast import progress, textures
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.host.cli.answers import tell, wants_json
from vibrocast.host.cli.option_types import FOLDER, INPUT, Whole
from vibrocast.host.cli.options import (
    allow_programs_option,
    command_run,
    grouped,
    own_models_option,
    unit_option,
)
from vibrocast.host.cli.sections import INPUT as INPUT_SECTION
from vibrocast.host.cli.sections import MORE, OUTPUT, RUN, SectionedCommand, section
from vibrocast.textures import dataset

if TYPE_CHECKING:  # modules that measure take a second to load; other commands need not wait for them
    from vibrocast.evaluation.bench import CellCounts, Recordings
    from vibrocast.evaluation.cells import Method
    from vibrocast.evaluation.comparison import Measurements
    from vibrocast.evaluation.points import Failure, Point, Timing

SNRS_DB = (5.0, 10.0, 15.0, 20.0)
SHOWN_FAILURES = 10
MUCH_REMOVED = 0.5
"""Of a recording's energy: a person should know."""


def separate_names(ctx: click.Context, param: click.Parameter, value: str | None) -> list[str]:
    """Return what commas separate."""
    return [name.strip() for name in (value or "").split(",") if name.strip()]


@dataclass(frozen=True)
class CodecOptions:
    """The codecs to measure."""

    names: list[str]
    model_folders: tuple[Path, ...]
    program_list: Path | None
    allow_programs: bool


@dataclass(frozen=True)
class SplitOptions:
    """The part of the data set that is measured, as `dataset.split` takes it."""

    part: str
    split_by: str


@dataclass(frozen=True)
class RunOptions:
    """How often and where to measure."""

    repeats: int
    scheduler: str | None


@dataclass(frozen=True)
class SignalOptions:
    """The signal that codecs get. `unit`: of the files that state none."""

    unit: str | None
    stream_rate_hz: int | None
    keep_dc: bool


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast bench recordings --out results\n"
    "vibrocast bench manifest.csv --codecs mdct,slp --split test --out results",
)
@click.argument("recordings", metavar="FOLDER|MANIFEST", type=INPUT)
@section(
    "Codecs",
    grouped(
        "codecs",
        CodecOptions,
        click.option(
            "--codecs",
            "names",
            callback=separate_names,
            metavar="NAME,...",
            help="Codecs, or sets of their rate points. Default: all.",
        ),
        own_models_option,
        section(
            MORE,
            click.option(
                "--programs",
                "program_list",
                type=INPUT,
                metavar="FILE",
                help="TOML file with codecs in programs of your own.",
            ),
            allow_programs_option,
        ),
    ),
    section(
        MORE,
        click.option("--peers", type=INPUT, metavar="FILE", help="CSV file of others' points on the same recordings."),
    ),
)
@section(
    "Recordings",
    grouped(
        "split",
        SplitOptions,
        click.option(
            "--split",
            "part",
            type=click.Choice(dataset.PARTS),
            default="all",
            help="Part to measure.",
        ),
        section(
            MORE,
            click.option(
                "--split-by",
                type=click.Choice(dataset.SPLITS),
                default="auto",
                help="Kept whole in a split; auto follows the manifest.",
            ),
        ),
    ),
)
@section(
    INPUT_SECTION,
    grouped(
        "signal",
        SignalOptions,
        unit_option,
        click.option(
            "--stream-rate-hz",
            type=Whole("Hz", 1, MAX_RATE_HZ),
            help="Sample rate for all recordings. Default: each recording's own.",
        ),
        section(
            MORE,
            click.option(
                "--keep-dc",
                is_flag=True,
                help=f"Keep the band below {textures.HIGHPASS_HZ:g} Hz: offset, gravity, drift.",
            ),
        ),
    ),
)
@section(
    RUN,
    grouped(
        "run",
        RunOptions,
        click.option(
            "--repeats",
            type=Whole("NUMBER", 0),
            default=3,
            help="Runs whose median time counts; 0 measures no times.",
        ),
        section(
            MORE,
            click.option(
                "--scheduler",
                metavar="ADDRESS",
                help="Dask scheduler that you trust, for its workers. Default: this machine.",
            ),
        ),
    ),
)
@section(
    OUTPUT,
    click.option(
        "--out", type=FOLDER, required=True, help="Folder for results.md and results/; continues a run that was cut."
    ),
)
def bench(
    recordings: Path,
    out: Path,
    codecs: CodecOptions,
    peers: Path | None,
    split: SplitOptions,
    run: RunOptions,
    signal: SignalOptions,
) -> None:
    """Measure codecs and trained models on a folder of recordings.

    A MANIFEST is a CSV file that names recordings. It has the column file, and any of unit, rate_hz, full_scale,
    hand_speed_mm_s, columns, reduce, key, material, subject and split.

    The command codes each recording at every setting of every codec. If one fails, the others continue; the failures
    are listed at the end, and the exit code is 1.

    A scheduler's ADDRESS is one such as tcp://host:8786. Trust it: whoever runs it, or its workers, can run any program
    as you on this machine.
    """
    from vibrocast import workers
    from vibrocast.codec.timing import cpu_name
    from vibrocast.evaluation import bench, cells, external, results_page, trained
    from vibrocast.evaluation.points import check_imported, read_imported, write_rows

    programs = external.read_programs(codecs.program_list, codecs.allow_programs) if codecs.program_list else []
    chosen = cells.methods(codecs.names, programs, trained.known_models(codecs.model_folders))
    found = dataset.read(recordings, leave_out=out)
    for remark in found.remarks:
        click.echo(remark, err=True)
    highpass_hz = textures.highpass_of(signal.unit, None if signal.keep_dc else textures.HIGHPASS_HZ)
    entries = dataset.split(found.entries, split.part, by=split.split_by)
    own = bench.Recordings(entries, signal.unit, signal.stream_rate_hz, highpass_hz)
    imported: tuple[list[Point], list[Timing]] = ([], [])
    if peers:
        imported = read_imported(peers)
        check_imported(peers, found.entries, {entry.name for entry in entries}, own.load)
    results = bench.results_folder(out)
    write_rows(results / "skipped.csv", found.skipped, dataset.Skipped)
    settings = sum(len(each.rate_points) for each in chosen)
    tell(
        f"{len(entries)} recordings, {len(chosen)} curves, {settings} settings",
        recordings=len(entries),
        curves=len(chosen),
    )
    work: Any = partial(workers.on_cores, processes=workers.cores())
    if run.scheduler:
        work = partial(workers.on_cluster, address=run.scheduler, version=workers.program_version)
    with bench.Journal(results / bench.JOURNAL) as journal, progress.bar("measuring") as update:
        measured = bench.run(entries, own.load, chosen, run.repeats, journal, work, progress_reporter(update))
    measurements = bench.compared(measured, imported, chosen, own, run.repeats, progress.bar)
    bench.write(results, measurements)
    data = recordings.resolve().name + ("" if split.part == "all" else f" ({split.part} part, by {split.split_by})")
    cells_on = "a Dask cluster" if run.scheduler else f"{workers.cores()} cores at once"
    machine = f"{cpu_name()}; single cells on {cells_on}"
    description = results_page.Description(dataset.printable(data), machine, command_run())
    with progress.bar("drawing") as update:
        results_page.write_results(out, measurements, description, update)
    show(measurements)
    show_remarks(chosen, measurements, own)
    tell(
        f"{out / bench.PAGE}: the charts and tables; their figures are in {results}",
        page=str(out / bench.PAGE),
        results=str(results),
        failures=[asdict(each) for each in measurements.failures],
    )
    if measurements.failures:
        show_failures(measurements.failures)
        raise click.ClickException(
            f"{len(measurements.failures)} recordings or cells failed; see {results / 'failures.csv'}, correct the "
            "cause, and run the same command again"
        )


def show_remarks(chosen: "Sequence[Method]", measurements: "Measurements", recordings: "Recordings") -> None:
    """Print what a run left out, what the high-pass removed, and which recordings have no physical unit."""
    tried = {point.codec for point in measurements.points} | {failure.codec for failure in measurements.failures}
    if left_out := [method.name for method in chosen if method.physical and method.name not in tried]:
        tell(f"left out, because no recording states a physical unit (--unit, or a manifest): {', '.join(left_out)}")
    if drifting := [name for name, part in recordings.removed_energy.items() if part > MUCH_REMOVED]:
        tell(
            f"removed below {textures.HIGHPASS_HZ:g} Hz: more than {MUCH_REMOVED:.0%} of the energy of {drifting[0]}"
            f"{others(drifting)} (--keep-dc codes it)"
        )
    relative = [name for name, unit in recordings.units.items() if unit == "full scale"]
    if recordings.unit not in (None, "full scale") and relative:
        tell(f"relative to full scale: {relative[0]}{others(relative)}; a manifest gives the full scale of --unit")


def others(names: Sequence[str]) -> str:
    """Return how many names there are after the first."""
    return f" and {len(names) - 1} more" if len(names) > 1 else ""


def progress_reporter(update: progress.Update) -> "Callable[[CellCounts], None]":
    """Return a function that shows the progress of a run by `update`: cells done, failures, time left."""
    start_s = time.monotonic()

    def report_progress(counts: "CellCounts") -> None:
        details = f"{counts.done} of {counts.cells} cells, {counts.failed} failed"
        if counts.measured:
            left_s = (time.monotonic() - start_s) / counts.measured * (counts.cells - counts.done)
            details += f", {datetime.timedelta(seconds=round(left_s))} left"
        update(counts.done / counts.cells, details)

    return report_progress


def show(measurements: "Measurements") -> None:
    """Print a table of the curves: mean bits per sample at some SNRs, median times and delay; in JSON, nothing."""
    if wants_json():
        return
    from statistics import fmean, median

    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from vibrocast.evaluation.bd_rate import SNR, bits_per_sample_at

    table = Table(
        box=SIMPLE, pad_edge=False, title="Mean bits per sample at an SNR; delay, ms; seconds per million samples"
    )
    table.add_column("codec", no_wrap=True)
    for title in (*(f"{snr_db:g} dB" for snr_db in SNRS_DB), "delay", "encode", "decode"):
        table.add_column(title, justify="right")
    for name, curves in measurements.curves.items():
        bits = [bits_per_sample_at(curve, SNRS_DB) for curve in measurements.everywhere(name, SNR) or [()]]
        delays_ms = [point.delay_ms for curve in curves.values() for point in curve if point.delay_ms is not None]
        source = measurements.source(name)
        times = [timing for timing in measurements.timings if (timing.codec, timing.source) == (name, source)]
        figures = [
            *(f"{mean:.2f}" for mean in map(fmean, zip(*bits, strict=True))),
            f"{median(delays_ms):.1f}" if delays_ms else "",
            f"{median(each.encode_s_per_megasample for each in times):.2f}" if times else "",
            f"{median(each.decode_s_per_megasample for each in times):.2f}" if times else "",
        ]
        table.add_row(name, *(text.replace("nan", "") for text in figures))
    Console().print(table)


def show_failures(failures: "Sequence[Failure]") -> None:
    """Print what failed on stderr, alike failures in one line, and no more than a person reads."""
    alike: dict[tuple[str, str], list[str]] = {}
    for failure in failures:
        alike.setdefault((failure.codec, failure.reason), []).append(f"{failure.trace} {failure.setting}".strip())
    for (codec_name, reason), places in list(alike.items())[:SHOWN_FAILURES]:
        click.echo(f"failed: {f'{codec_name}: ' if codec_name else ''}{places[0]}{others(places)}: {reason}", err=True)
    if len(alike) > SHOWN_FAILURES:
        click.echo(f"failed: {len(alike) - SHOWN_FAILURES} other ways", err=True)
