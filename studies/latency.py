"""Writes the page of the latency budget of live streams: `python -m studies.latency PAGE`."""

import shlex
import statistics
import sys
from pathlib import Path

import click

from studies.page import errors_in_one_line, render, write
from vibrocast.host import bench_file, live
from vibrocast.host.bench_file import Bench, BenchController
from vibrocast.host.harness import (
    PARTS,
    Latency,
    MinLatency,
    find_min_latency,
    machine,
    measure_latency,
    subject,
)

ADDRESSES = ("sim", "sim-usb", "host", "cortex-m4", "cortex-m7")
# A computer that does other work as well delays some runs: the median of these is shown.
RUNS = 5
TARGET_MS = 30.0


@click.command()
@click.argument("path", metavar="PAGE", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--device", "addresses", multiple=True, default=ADDRESSES, help="Address; may be repeated.")
def main(path: Path, addresses: tuple[str, ...]) -> None:
    """Measure the controllers at the addresses given, and write PAGE."""
    budgets, searches = {}, {}
    for address in addresses:
        bench = Bench((BenchController(address, address),))
        with bench_file.connect(bench, bench.first) as controller:
            measured = subject(bench, controller)
            texture = measured.scene[0]
            runs = sorted((measure_latency(controller, measured.actuator, texture) for _ in range(RUNS)), key=_total_ms)
            budgets[address] = runs
            searches[address] = find_min_latency(controller, measured.actuator, texture)
        click.echo(f"{address}: {statistics.median(map(_total_ms, runs)):.1f} ms", err=True)
    command = shlex.join(["python", "-m", "studies.latency", *sys.argv[1:]])
    with errors_in_one_line():
        write(path, page(budgets, searches, machine(), command))


def page(
    budgets: dict[str, list[Latency]], searches: dict[str, MinLatency], machine: dict[str, str], command: str
) -> str:
    """Return the page, of what was measured by address. `budgets`: runs with default buffers, sorted by their total."""
    middle = {address: _middle(runs) for address, runs in budgets.items()}
    below = [address for address, latency in middle.items() if latency.total_ms < TARGET_MS]
    return render(
        "latency",
        command=command,
        machine=machine,
        runs=RUNS,
        target_ms=TARGET_MS,
        margin_ms=1e3 * live.PLAYOUT_DELAY_S,
        below=below,
        above=[address for address in middle if address not in below],
        first=next(iter(middle.values())),
        parts=PARTS,
        budgets={
            address: {
                "middle": middle[address],
                "min_ms": _total_ms(runs[0]),
                "max_ms": _total_ms(runs[-1]),
                "stable": sum(run.stable for run in runs),
            }
            for address, runs in budgets.items()
        },
        searches=searches,
    )


def _middle(runs: list[Latency]) -> Latency:
    """Return the one in the middle of the runs without an underrun, or of all where there is no such."""
    kept = [run for run in runs if run.stable] or runs
    return kept[len(kept) // 2]


def _total_ms(latency: Latency) -> float:
    return latency.total_ms


if __name__ == "__main__":
    main()
