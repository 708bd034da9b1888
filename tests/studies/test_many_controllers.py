"""The page of many controllers: it leads with the cost of the host, and shows every row of its table."""

import csv
import os
from pathlib import Path

import pytest

from studies import many_controllers as study

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def measured(kind: str, underruns: int = 0) -> study.Measured:
    return study.Measured(kind, 100, 10, 0.25, 1.0, underruns, 0, 0)


def measured_live(streams: int = 1, round_ms: float = 0.2) -> study.LiveMeasured:
    return study.LiveMeasured(streams, 0, 5.7, 0.5, 0.9, 2.0, 0.3, 0.1, 0.0, 0.1, 0.05, round_ms, 0.1, 0.0)


def test_the_page_leads_with_the_cost_of_the_host() -> None:
    first = study.page([measured("firmware"), measured("null")], [measured_live()], 10.0, 0.3).split("|")[0]
    assert "100 controllers of 10 channels with 25 % of a core" in first
    assert "No controller had an underrun" in first


def test_the_page_hides_no_underrun() -> None:
    assert "No controller" not in study.page([measured("null", underruns=1)], [measured_live()], 10.0, 0.3)


@pytest.mark.parametrize(("round_ms", "says"), [(4.0, "is enough for 100"), (17.0, "is full at about 33 streams")])
def test_the_page_says_whether_one_core_is_enough(round_ms: float, says: str) -> None:
    assert says in study.page([measured("null")], [measured_live(), measured_live(100, round_ms)], 10.0, 0.3)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux keeps a process on a core")
def test_live_streams_are_timed() -> None:
    assert study.measure_live(2, 0.1).encode_ms > 0


def test_the_stored_page_shows_its_table() -> None:
    page = (BENCHMARKS / study.PAGE).read_text(encoding="utf-8")
    with (BENCHMARKS / "results" / study.TABLE).open(newline="") as file:
        for row in csv.DictReader(file):
            shares = f"{float(row['host_share']):.3f} | {float(row['controllers_share']):.3f}"
            assert f"| {study.KINDS[row['kind']]} | {row['controllers']} | {row['channels']} | {shares} |" in page
    with (BENCHMARKS / "results" / study.LIVE_TABLE).open(newline="") as file:
        medians = [f"{float(row['median_ms']):.2f}" for row in csv.DictReader(file)]
    assert f"median**, ms | {' | '.join(medians)} |" in page
