"""Writes the page of the latency budget, and its table: `python -m studies.latency --out docs/benchmarks`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

import vibrocast
from studies import page
from vibrocast.harness.latency import Latency, find_min_latency, measure_latency
from vibrocast.harness.measurements import machine
from vibrocast.host import bench_file, live
from vibrocast.host.bench_file import Bench, BenchController
from vibrocast.host.report import Report

ADDRESSES = ("sim", "sim-usb", "host", "cortex-m4", "cortex-m7")
RECORDING = Path("examples/oak.wav")
# A computer that does other work as well delays some runs: the median of these is shown.
RUNS = 5
TARGET_MS = 30.0
PARTS = {
    "wake": "waking the host's program",
    "encode": "encoding",
    "send": "handing the packet to the operating system",
    "wire": "transport to the controller",
    "buffer": "playout delay: the packet waits until it is needed",
    "packet": "packet: a sample waits for the others of its packet",
    "overlap": "overlap of the codec's blocks",
    "drive": "output processing: resampling to the DAC's rate, low-pass of the compensation",
    "dac": "one DAC sample: half the hold, half the compensated response",
}
"""In the order in which a sample goes through them."""


@dataclass(frozen=True)
class Row:
    """A part of the delay, of `live` or `play` on a controller; the part "total" is the whole."""

    command: str
    device: str
    part: str
    delay_ms: float


@page.study
def main(out: Path) -> None:
    """Measure the latency of controllers, and write the page latency.md."""
    budgets, searches = {}, {}
    for address in ADDRESSES:
        bench = Bench((BenchController(address, address),))
        with bench_file.connect(bench, bench.first) as session:
            texture = bench.scene()[0]
            runs = [measure_latency(session, texture) for _ in range(RUNS)]
            budgets[address] = Budget.of(runs)
            searches[address] = find_min_latency(session, texture)
        click.echo(f"{address}: {budgets[address].middle.total_ms:.1f} ms", err=True)
    played = played_parts(RECORDING)
    text = page.render(
        "latency",
        globals(),
        machine=machine(),
        playout_delay_ms=1e3 * live.PLAYOUT_DELAY_S,
        above=[address for address, budget in budgets.items() if budget.middle.total_ms >= TARGET_MS],
        played=played,
        budgets=budgets,
        searches=searches,
    )
    page.publish(out, "latency", text, [("latency.csv", rows(budgets, played), Row)])


@dataclass(frozen=True)
class Budget:
    """The delays of several live streams on a controller.

    `middle`: the one in the middle of the runs without an underrun, or of all where there is no such. `parts`: of that
    one, by the names of PARTS, in ms. `stable`: the number of runs without an underrun.
    """

    middle: Latency
    parts: dict[str, float]
    min_ms: float
    max_ms: float
    stable: int

    @classmethod
    def of(cls, runs: Sequence[Latency]) -> "Budget":
        """Return the budget of runs."""
        ordered = sorted(runs, key=lambda run: run.total_ms)
        stable = [run for run in ordered if not run.report.lost_anything]
        kept = stable or ordered
        middle = kept[len(kept) // 2]
        return cls(middle, live_parts(middle), ordered[0].total_ms, ordered[-1].total_ms, len(stable))


def live_parts(latency: Latency) -> dict[str, float]:
    """Return the delays of a live stream by the names of PARTS, in ms."""
    delays_ms = {name: part.median_ms for name, part in latency.parts.items()}
    assert latency.report.live is not None, "it was streamed live"
    delays_ms["packet"] = latency.report.live.packet_ms * (1 - 1 / latency.packet_samples)
    delays_ms["overlap"] = delays_ms.pop("codec") - delays_ms["packet"]
    return {name: delays_ms[name] for name in PARTS}


def played_parts(path: Path) -> dict[str, float]:
    """Play a recording on the simulated controller, RUNS times; return the delays of the median run, in ms.

    Those that a report does not have, of the host and the link, are left out.
    """
    stream = vibrocast.encode(vibrocast.load(path), random_access=True)
    with vibrocast.connect("sim") as controller:
        reports: list[Report] = [controller.play(stream) for _ in range(RUNS)]
        dac_ms = 1e3 / controller.controller.description.actuator.dac_rate_hz
    latency = sorted((report.timing for report in reports), key=lambda each: each.end_to_end_ms or 0.0)[RUNS // 2]
    assert latency.algorithmic_ms and latency.buffered_ms and latency.end_to_end_ms, "it was played to its end"
    return {
        "buffer": latency.buffered_ms,
        "packet": 1e3 * stream.packet_samples / stream.header.rate_hz,
        "overlap": 1e3 * stream.delay_samples / stream.header.rate_hz,
        "drive": latency.end_to_end_ms - latency.algorithmic_ms - latency.buffered_ms - dac_ms,
        "dac": dac_ms,
    }


def rows(budgets: Mapping[str, Budget], played: Mapping[str, float]) -> list[Row]:
    """Return the table: of each live stream, and of the recording played on the simulated controller."""
    found = {("live", address): {**each.parts, "total": each.middle.total_ms} for address, each in budgets.items()}
    found["play", "sim"] = {**played, "total": sum(played.values())}
    return [Row(*of, part, round(delay_ms, 2)) for of, parts in found.items() for part, delay_ms in parts.items()]


if __name__ == "__main__":
    main()
