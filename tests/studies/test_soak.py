"""The page of a soak: it leads with the losses and their causes, and shows every minute of its table."""

import csv
from pathlib import Path

from studies import soak as study
from vibrocast.host.live_watch import Minute

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def test_the_page_leads_with_losses_and_causes() -> None:
    minutes = [Minute(0.0, packets=100), Minute(60.0, packets=100, lost_packets=1, host_late_ms=9.0, cause="host")]
    page = study.page(minutes, busy=1, playout_delay_ms=10.0)
    assert "for 2 minutes, and lost 1 of 200 packets" in page
    assert "The host was the cause in 1 minutes, the wire in 0, and the device in 0." in page
    assert "No minute had a loss." in study.page(minutes[:1], busy=1, playout_delay_ms=10.0)


def test_the_stored_page_shows_its_table() -> None:
    page = (BENCHMARKS / study.PAGE).read_text(encoding="utf-8")
    with (BENCHMARKS / "results" / study.TABLE).open(newline="") as file:
        minutes = list(csv.DictReader(file))
    assert minutes
    for each in minutes:
        begins = (
            f"| {float(each['from_s']) / 60:g} | {each['packets']} | {each['underruns']} | {each['lost_packets']} |"
        )
        assert begins in page
