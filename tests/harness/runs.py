"""A run of `vibrocast measure` to test with: the golden one, with what that leaves out."""

from dataclasses import replace
from pathlib import Path

from vibrocast.harness.latency import MinLatency
from vibrocast.harness.load import Load, Throughput
from vibrocast.harness.results import Results, read_results

GOLDEN = read_results(Path(__file__).with_name("golden_reports") / "measure.json")
assert GOLDEN.measured.latency is not None
LATENCY = replace(GOLDEN.measured.latency, blocks=100, clock=replace(GOLDEN.measured.latency.clock, round_trip_ms=2.0))
"""A measurement of 100 packets, whose round trips took 2 ms and more."""
RUN: Results = replace(
    GOLDEN,
    device=GOLDEN.device | {"build": "<1>"},
    failed={"gap": "no <sensor>"},
    measured=replace(
        GOLDEN.measured,
        latency=LATENCY,
        smallest=MinLatency(LATENCY, ()),
        throughput=Throughput(9e4, 8e4, 0),
        load=(Load(1, 2800, 0, 0),),
    ),
    asked=("latency", "smallest", "throughput", "load", "fidelity", "response"),
)
