"""The subcommand `measure`: measures a controller on its bench, reports, and compares with an earlier run."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vibrocast import extras, progress
from vibrocast.codec import CodecError
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.cli.options import INPUT, plan_option
from vibrocast.host.controller import ConnectionLost, ControllerError

if TYPE_CHECKING:  # what measures takes a second to load, which other commands need not wait for
    from vibrocast.host.harness.bench_file import Bench
    from vibrocast.host.harness.results import Results

NAMES = ("latency", "smallest", "throughput", "load", "gap", "fidelity", "response", "together")
TIMED, RETAKES = NAMES[:5], 2
PAGE, JSON, ACTUATOR = "measured.html", "measured.json", "actuator.toml"


def chosen_names(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Return the measurements that commas separate, all if not given, or raise click.BadParameter."""
    names = tuple(name.strip() for name in value.split(",")) if value else NAMES
    for name in names:
        if name not in NAMES:
            raise click.BadParameter(f"{name!r} is none of {', '.join(NAMES)}.", ctx, param)
    return names


@click.command()
@click.option(
    "--device", help="Address as `vibrocast devices` lists them, or a name in the bench file; sim if neither."
)
@click.option(
    "--bench", "bench_path", type=INPUT, help="Bench file in TOML: controllers, actuators, sensors, textures."
)
@plan_option
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("measured"),
    show_default=True,
    help=f"Folder for {PAGE}, {JSON} and {ACTUATOR}.",
)
@click.option(
    "--compare", "earlier", type=INPUT, help=f"{JSON} of an earlier run: what has become worse fails the run."
)
@click.option("--only", "names", callback=chosen_names, metavar="NAME,...", help=f"Some of {', '.join(NAMES)}.")
def measure(
    device: str | None,
    bench_path: Path | None,
    plan_path: Path | None,
    out: Path,
    earlier: Path | None,
    names: tuple[str, ...],
) -> None:
    """Measure a controller: latency, load, fidelity, frequency response.

    With --plan, on the plan's actuators and textures. What has been measured is written also when the run is cut. The
    exit code is 1 where something could not be measured or has become worse than in the earlier run.
    """
    extras.require("bench")
    from vibrocast.host.harness import bench_file, results
    from vibrocast.host.planner.plan_file import read_plan

    if plan_path is not None and bench_path is not None:
        raise click.UsageError("a plan and a bench file both say what is there: drop one of them.")
    bench = None if bench_path is None else bench_file.read_bench(bench_path)
    bench = bench_file.chosen(bench if plan_path is None else read_plan(plan_path).bench(), device)
    before = None if earlier is None else results.read(earlier)
    out.mkdir(parents=True, exist_ok=True)
    run = results.Results({}, {})
    with saved(out, run, before, bench):
        measure_all(bench, names, run)
        if before is not None:
            measure_again(bench, before, run)
    changes = [] if before is None else results.compare(before, run.document())
    for name, why in run.failed.items():
        click.echo(f"not measured: {name}: {why}", err=True)
    worse = [change.name for change in changes if change.regressed]
    for name, value in results.figures(run.document()):
        click.echo(f"{name}: {value:.6g}")
    click.echo(f"{out / PAGE}")
    if worse:
        raise click.ClickException(f"worse than in {earlier}: {'; '.join(worse)}")
    if run.failed:
        raise click.ClickException(f"not all could be measured: {', '.join(run.failed)}")


def measure_all(bench: "Bench", names: tuple[str, ...], run: "Results") -> None:
    """Take the measurements of these names into a run; one that fails leaves the others, a lost controller ends all."""
    from vibrocast.host.harness import bench_file, measurements
    from vibrocast.host.harness.alignment import AlignmentError
    from vibrocast.host.harness.sensors import SensorError

    run.host.update(measurements.machine())
    with bench_file.connect(bench, bench.first) as controller:
        run.device.update(measurements.device_facts(bench, controller))
        subject = measurements.subject(bench, controller)
        for name, take in measurements.MEASUREMENTS.items():
            if name not in names:
                continue
            with progress.bar(name) as update:
                try:
                    run.measured[name] = take(subject, update)
                except (ConnectionLost, TransportError):
                    raise
                except (AlignmentError, CodecError, ControllerError, MessageError, SensorError, StreamError) as error:
                    run.failed[name] = str(error)
                    controller.stop()
                except KeyboardInterrupt:
                    with contextlib.suppress(ControllerError, TransportError):
                        controller.stop()
                    raise
    if "together" in names and len(bench.controllers) > 1:
        with progress.bar("together"):
            run.measured["together"] = measurements.together(bench)


def measure_again(bench: "Bench", before: dict[str, Any], run: "Results") -> None:
    """Take anew what is a matter of time and has become worse: the computer may have been busy with something else."""
    from vibrocast.host.harness import results

    for _ in range(RETAKES):
        again = tuple(name for name in TIMED if name in run.measured and is_worse(before, run, name))
        if not again:
            return
        click.echo(f"worse, measured again: {', '.join(again)}", err=True)
        retaken = results.Results({}, {})
        measure_all(bench, again, retaken)
        run.measured.update(
            {name: value for name, value in retaken.measured.items() if not is_worse(before, retaken, name)}
        )


def is_worse(before: dict[str, Any], run: "Results", name: str) -> bool:
    """Return whether a figure of one measurement has become worse than in an earlier run."""
    from vibrocast.host.harness import results

    now = results.Results(run.device, run.host, {name: run.measured[name]})
    return any(change.regressed for change in results.compare(before, now.document()))


@contextlib.contextmanager
def saved(out: Path, run: "Results", before: dict[str, Any] | None, bench: "Bench") -> Iterator[None]:
    """Write what a run has measured when the block ends, however it ends."""
    from vibrocast.host.harness import bench_file, page, results

    try:
        yield
    except BaseException as error:
        run.failed["the rest"] = str(error) or "interrupted"
        raise
    finally:
        if run.measured:
            table = ""
            if response := run.measured.get("response"):
                table = bench_file.actuator_toml(response.actuator, bench.first.name)
                (out / ACTUATOR).write_text(table, encoding="utf-8")
            document = run.document()
            run.write(out / JSON)
            page.write(out / PAGE, document, [] if before is None else results.compare(before, document), table)
