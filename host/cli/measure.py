"""The subcommand `measure`: measures a controller on its bench, reports, and compares with an earlier run."""

from pathlib import Path

import click

from vibrocast import extras
from vibrocast.host.cli.options import INPUT, plan_option
from vibrocast.host.harness import ACTUATOR, JSON, NAMES, PAGE


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
    from vibrocast.host.bench_file import choose_controller, read_bench
    from vibrocast.host.harness import compare, figures, measure_bench, read_results
    from vibrocast.host.planner import read_plan

    if plan_path is not None and bench_path is not None:
        raise click.UsageError("a plan and a bench file both say what is there: drop one of them.")
    bench = None if bench_path is None else read_bench(bench_path)
    bench = choose_controller(bench if plan_path is None else read_plan(plan_path).bench(), device)
    before = None if earlier is None else read_results(earlier)
    results = measure_bench(bench, out, names, before)
    changes = [] if before is None else compare(before, results.document())
    for name, why in results.failed.items():
        click.echo(f"not measured: {name}: {why}", err=True)
    for name, value in figures(results.document()):
        click.echo(f"{name}: {value:.6g}")
    click.echo(f"{out / PAGE}")
    if worse := [change.name for change in changes if change.regressed]:
        raise click.ClickException(f"worse than in {earlier}: {'; '.join(worse)}")
    if results.failed:
        raise click.ClickException(f"not all could be measured: {', '.join(results.failed)}")
