"""The subcommand `measure`: measures a controller on its bench, reports, and compares with an earlier run."""

import json
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click

from vibrocast.harness.results import (
    ACTUATOR,
    JSON,
    NAMES,
    PAGE,
    STABLE,
    compare,
    findings_in,
    likely_cause,
    read_results,
    warnings,
)
from vibrocast.host.cli.answers import add, figures_so_far, tell
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.options import allow_programs_option, fail, given_once
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.report import UP_TO_DAC_CALL

TRACE = "trace.pcapng"


def chosen_names(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Return the measurements that commas separate, STABLE if not given, or raise click.BadParameter."""
    names = tuple(name.strip() for name in value.split(",")) if value else STABLE
    for name in names:
        if name not in NAMES:
            raise click.BadParameter(f"{name!r} is no measurement; give some of {', '.join(NAMES)}", ctx, param)
    return names


def written_since(path: Path, began_ns: int) -> dict[str, Any] | None:
    """Return the results that a run has written since it began, ns since 1970; None without any."""
    if not path.exists() or path.stat().st_mtime_ns < began_ns:
        return None
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast measure --device serial:/dev/ttyACM0 --out monday\n"
    "vibrocast measure --bench bench.toml --compare monday/measured.json",
)
@click.option(
    "--device",
    callback=given_once(lambda _, __, device: device),
    metavar="ADDRESS|NAME",
    multiple=True,
    help="Controller, by address or name. Default: the bench's, else sim.",
)
@click.option(
    "--bench",
    "bench_path",
    type=INPUT,
    metavar="FILE",
    help="TOML file with controllers, actuators, sensors and textures.",
)
@allow_programs_option
@click.option(
    "--out",
    type=FOLDER,
    default=Path("measured"),
    help=f"Folder for {PAGE}, {JSON} and {ACTUATOR}.",
)
@click.option(
    "--compare",
    "earlier",
    type=INPUT,
    metavar="FILE",
    help=f"{JSON} of an earlier run; a worse result fails.",
)
@click.option(
    "--only",
    "names",
    callback=chosen_names,
    metavar="NAME,...",
    help=f"Some of {', '.join(NAMES)}. Default: all but {', '.join(sorted(set(NAMES) - set(STABLE)))}.",
)
def measure(
    device: str | None,
    bench_path: Path | None,
    allow_programs: bool,
    out: Path,
    earlier: Path | None,
    names: tuple[str, ...],
) -> None:
    """Measure the latency, load, fidelity and response of a controller.

    If you interrupt the command, it writes the results so far.

    The exit code is 1 if a measurement failed, or the controller played anything other than was sent. It is 5 if the
    run is worse than the earlier one, or cannot be compared with it, and 4 if a limit of the bench file was missed. If
    several hold, it is the first of these. It is 6 if this machine may have caused all that is wrong.
    """
    from vibrocast.harness.run import measure_bench
    from vibrocast.host.bench_file import choose_controller, read_bench

    bench = None if bench_path is None else read_bench(bench_path, allow_programs)
    bench = choose_controller(bench, device)
    before = None if earlier is None else read_results(earlier)
    trace_failure(out / TRACE)
    figures_so_far(partial(written_since, out / JSON, time.time_ns()))
    results = measure_bench(bench, out, names, before)
    changes = [] if before is None else compare(before, results)
    add(results.document() | {"changes": [asdict(change) for change in changes]})
    for value in results.figures():
        if value.value is not None:
            tell(value.line())
    for warning in warnings(results):
        click.echo(f"warning: {warning}", err=True)
    checked = f"; {UP_TO_DAC_CALL}" if bench.sensor is None else ""
    tell(f"{out / PAGE}{checked}", page=str(out / PAGE))
    found = findings_in(results, bench, changes, earlier)
    if found and (cause := likely_cause(results, bench, changes)):
        click.echo(f"likely cause: {cause}", err=True)
        add({"cause": cause})
    fail(found)
