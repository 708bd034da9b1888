"""The page of the latency budget: its parts are those of its table, and add up."""

import csv
from pathlib import Path

import pytest

from studies import latency as study
from vibrocast.harness.latency import PARTS, Latency, MinLatency, Spread
from vibrocast.host.device_clock import ClockFit

TABLE = Path(__file__).parents[2] / "docs" / "benchmarks" / "results" / "latency.csv"
PLAYED = {"buffer": 250.0, "packet": 46.0, "overlap": 11.0, "drive": 3.0, "dac": 0.5}


def measured(buffer_ms: float, underruns: int = 0) -> Latency:
    """Return a live stream whose other parts take 1 ms each, the codec 11 ms."""
    parts = {name: Spread({"buffer": buffer_ms, "codec": 11.0}.get(name, 1.0), 2.0) for name in PARTS}
    return Latency(
        codec="mdct",
        setting={},
        rate_hz=2800,
        packet_samples=15,
        playout_delay_ms=10.0,
        blocks=100,
        packets=100,
        parts=parts,
        total_ms=sum(part.median_ms for part in parts.values()),
        jitter_ms=0.1,
        underruns=underruns,
        lost_packets=0,
        as_sent=True,
        clock=ClockFit(0.0, 0.0, 0.0, 0.0, 0.0),
    )


def test_the_codec_is_a_packet_and_an_overlap() -> None:
    parts = study.live_parts(measured(10.0))
    assert list(parts) == list(study.PARTS)
    assert parts["packet"] == pytest.approx(5.0)
    assert parts["overlap"] == pytest.approx(6.0)


def test_the_page_leads_with_the_totals_and_shows_the_middle_run() -> None:
    budgets = {"sim": [measured(9.0, underruns=1), measured(10.0), measured(11.0), measured(12.0)]}
    page = study.page(budgets, {"sim": MinLatency(None, ())}, PLAYED, {"processor": "P", "system": "S"})
    first = page.split("##")[0]
    assert "28 ms" in first
    assert "310 ms" in first
    assert "| **total** | **28.0** |" in page
    assert "| runs without an underrun | 3 of 5 |" in page
    assert "no setting was stable" in page


@pytest.mark.parametrize(("command", "devices"), [("live", set(study.ADDRESSES)), ("play", {"sim"})])
def test_the_parts_of_the_table_add_up(command: str, devices: set[str]) -> None:
    with TABLE.open(newline="") as file:
        cells = list(csv.DictReader(file))
    rows = [study.Row(row["command"], row["device"], row["part"], float(row["delay_ms"])) for row in cells]
    assert {row.device for row in rows if row.command == command} == devices
    for device in devices:
        delays = {row.part: row.delay_ms for row in rows if (row.command, row.device) == (command, device)}
        total = delays.pop("total")
        assert set(delays) <= set(study.PARTS)
        assert sum(delays.values()) == pytest.approx(total, abs=0.5)
