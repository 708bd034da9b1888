"""Writes the page of the latency budget of live streams: `python -m studies.latency PAGE`."""

import argparse
import shlex
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

from vibrocast.evaluation.page_parts import paragraphs, table
from vibrocast.files import atomic_write
from vibrocast.host import live
from vibrocast.host.harness import bench_file, measurements
from vibrocast.host.harness.bench_file import Bench, BenchController
from vibrocast.host.harness.latency import PARTS, Latency, SmallestDelay, measure, smallest

ADDRESSES = ("sim", "sim-usb", "host", "cortex-m4", "cortex-m7")
# A computer that does other work as well delays some runs: the median of these is shown.
RUNS = 5
TARGET_MS = 30.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the controllers at the addresses given, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m studies.latency")
    parser.add_argument("page", type=Path, help="Markdown file to write")
    parser.add_argument("--device", dest="addresses", action="append", help="address; may be repeated")
    chosen = parser.parse_args(arguments)
    budgets, searches = {}, {}
    for address in chosen.addresses or ADDRESSES:
        bench = Bench((BenchController(address, address),))
        with bench_file.connect(bench, bench.first) as controller:
            subject = measurements.subject(bench, controller)
            texture = subject.scene[0]
            runs = sorted((measure(controller, subject.actuator, texture) for _ in range(RUNS)), key=_total_ms)
            budgets[address] = runs
            searches[address] = smallest(controller, subject.actuator, texture)
        print(f"{address}: {statistics.median(map(_total_ms, runs)):.1f} ms", file=sys.stderr)
    command = shlex.join(["python", "-m", "studies.latency", *(sys.argv[1:] if arguments is None else arguments)])
    with atomic_write(chosen.page) as partial:
        partial.write_text(page(budgets, searches, measurements.machine(), command), encoding="utf-8")


def page(
    budgets: dict[str, list[Latency]], searches: dict[str, SmallestDelay], machine: dict[str, str], command: str
) -> str:
    """Return the page, of what was measured by address. `budgets`: runs with default buffers, sorted by their total."""
    middle = {address: _middle(runs) for address, runs in budgets.items()}
    rows = [
        [f"{name}: {PARTS[name]}", *(f"{latency.parts[name].median_ms:.2f}" for latency in middle.values())]
        for name in PARTS
    ]
    rows.append(["**in all**", *(f"**{latency.total_ms:.1f}**" for latency in middle.values())])
    rows.append(
        [
            "least and most of the runs",
            *(f"{_total_ms(runs[0]):.1f} - {_total_ms(runs[-1]):.1f}" for runs in budgets.values()),
        ]
    )
    rows.append(["arrival jitter", *(f"{latency.jitter_ms:.2f}" for latency in middle.values())])
    rows.append(
        ["runs without an underrun", *(f"{sum(run.stable for run in runs)} of {RUNS}" for runs in budgets.values())]
    )
    below = [address for address, latency in middle.items() if latency.total_ms < TARGET_MS]
    above = [address for address in middle if address not in below]
    verdict = f"Below {TARGET_MS:g} ms: {', '.join(below) or 'none'}." + (
        f" Above: {', '.join(above)}." if above else ""
    )
    first = next(iter(middle.values()))
    found = [
        [address, search.found.setting["hop"], f"{search.found.margin_ms:g}", f"{search.found.total_ms:.1f}"]
        if search.found
        else [address, "", "", "nothing that was tried was stable"]
        for address, search in searches.items()
    ]
    return (
        paragraphs(
            "# Latency",
            f"Written by `{command}` on {machine['processor']}, {machine['system']}.",
            "From a block's last sample at the host to the DAC, by part, in ms: the median over the blocks of a stream "
            f"of 4 s, and of {RUNS} streams the one in the middle of those without an underrun. {verdict}",
            f"Default buffers: `mdct` in packets of {first.packet_samples} samples at {first.rate_hz} Hz, each sent at "
            f"once, and due {1e3 * live.MARGIN_S:g} ms after it comes. How each part is measured: "
            "[harness.md](harness.md).",
            table(["part", *middle], rows),
            "## The least that is stable",
            "The shortest margin at which no packet of a stream of 4 s came too late, over both lengths of a block. It "
            "is a figure of the host as much as of the controller: a computer that does other work needs more.",
            table(["controller", "samples in a block", "margin, ms", "latency, ms"], found),
            "## What is not in these figures",
            "- The controllers here are simulated or emulated, on the computer that is the host: the wire is a "
            "pseudo-terminal or a call. USB adds its polling, up to 1 ms each way at full speed.\n"
            "- What a controller makes ahead of its DAC lies behind its clock, where no Status shows it: up to 2 ms on "
            "simulated and emulated ones; on the STM32F405 board 4 ms and twice what the first packet takes to decode "
            "(`firmware/ports/stm32f405/dac.c`).\n"
            "- An actuator's own response is what the compensation makes up for, and is not counted again.",
        )
        + "\n"
    )


def _middle(runs: list[Latency]) -> Latency:
    """Return the one in the middle of the runs without an underrun, or of all where there is no such."""
    kept = [run for run in runs if run.stable] or runs
    return kept[len(kept) // 2]


def _total_ms(latency: Latency) -> float:
    return latency.total_ms


if __name__ == "__main__":
    main()
