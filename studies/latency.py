"""Writes the page of the latency budget, and its table: `python -m studies.latency --out docs/benchmarks`."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click

import vibrocast
from studies import page
from vibrocast.harness.latency import Latency, MinLatency, find_min_latency, measure_latency
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
@click.option(
    "--device",
    "addresses",
    multiple=True,
    default=ADDRESSES,
    show_default=True,
    help="Measure this controller; may be repeated.",
)
def main(out: Path, addresses: tuple[str, ...]) -> None:
    """Measure the latency of controllers, and write the page latency.md."""
    budgets, searches = {}, {}
    for address in addresses:
        bench = Bench((BenchController(address, address),))
        with bench_file.connect(bench, bench.first) as session:
            texture = bench.scene()[0]
            runs = sorted((measure_latency(session, texture) for _ in range(RUNS)), key=_total_ms)
            budgets[address] = runs
            searches[address] = find_min_latency(session, texture)
        click.echo(f"{address}: {statistics.median(map(_total_ms, runs)):.1f} ms", err=True)
    played = played_parts(RECORDING)
    text = rendered(budgets, searches, played, machine())
    page.publish(out, "latency", text, [("latency.csv", rows(budgets, played), Row)])


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
    latency = sorted((report.latency_ms for report in reports), key=lambda each: each.end_to_end or 0.0)[RUNS // 2]
    assert latency.algorithmic and latency.buffered and latency.end_to_end, "it was played to its end"
    return {
        "buffer": latency.buffered,
        "packet": 1e3 * stream.packet_samples / stream.header.rate_hz,
        "overlap": 1e3 * stream.delay_samples / stream.header.rate_hz,
        "drive": latency.end_to_end - latency.algorithmic - latency.buffered - dac_ms,
        "dac": dac_ms,
    }


def rows(budgets: dict[str, list[Latency]], played: dict[str, float]) -> list[Row]:
    """Return the table: of each live stream, and of the recording played on the simulated controller."""
    found = []
    for address, runs in budgets.items():
        middle = _middle(runs)
        parts = {**live_parts(middle), "total": middle.total_ms}
        found += [Row("live", address, part, round(delay_ms, 2)) for part, delay_ms in parts.items()]
    parts = {**played, "total": sum(played.values())}
    return found + [Row("play", "sim", part, round(delay_ms, 2)) for part, delay_ms in parts.items()]


def rendered(
    budgets: dict[str, list[Latency]],
    searches: dict[str, MinLatency],
    played: dict[str, float],
    machine: dict[str, str],
) -> str:
    """Return the page. `budgets`: by address, runs with the default playout delay, sorted by their total."""
    middle = {address: _middle(runs) for address, runs in budgets.items()}
    return page.render(
        "latency",
        machine=machine,
        recording=RECORDING,
        runs=RUNS,
        target_ms=TARGET_MS,
        playout_delay_ms=1e3 * live.PLAYOUT_DELAY_S,
        totals_ms=[latency.total_ms for latency in middle.values()],
        above=[address for address, latency in middle.items() if latency.total_ms >= TARGET_MS],
        first=next(iter(middle.values())),
        parts=PARTS,
        played=played,
        budgets={
            address: {
                "middle": middle[address],
                "parts": live_parts(middle[address]),
                "min_ms": _total_ms(runs[0]),
                "max_ms": _total_ms(runs[-1]),
                "stable": sum(not run.report.lost_anything for run in runs),
            }
            for address, runs in budgets.items()
        },
        searches=searches,
    )


def _middle(runs: Sequence[Latency]) -> Latency:
    """Return the one in the middle of the runs without an underrun, or of all where there is no such."""
    kept = [run for run in runs if not run.report.lost_anything] or runs
    return kept[len(kept) // 2]


def _total_ms(latency: Latency) -> float:
    return latency.total_ms


if __name__ == "__main__":
    main()
