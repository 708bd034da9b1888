"""The page of many controllers: it leads with the cost of the host, and shows every row of its table."""

import csv
from pathlib import Path

from studies import many_controllers as study

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def measured(kind: str, underruns: int = 0) -> study.Measured:
    return study.Measured(kind, 100, 10, 0.25, 1.0, underruns, 0, 0)


def test_the_page_leads_with_the_cost_of_the_host() -> None:
    first = study.page([measured("firmware"), measured("null")], 10.0, 0.3).split("|")[0]
    assert "100 controllers of 10 channels with 25 % of a core" in first
    assert "No controller had an underrun" in first


def test_the_page_hides_no_underrun() -> None:
    assert "No controller" not in study.page([measured("null", underruns=1)], 10.0, 0.3)


def test_the_stored_page_shows_its_table() -> None:
    page = (BENCHMARKS / study.PAGE).read_text(encoding="utf-8")
    with (BENCHMARKS / "results" / study.TABLE).open(newline="") as file:
        for row in csv.DictReader(file):
            shares = f"{float(row['host_share']):.3f} | {float(row['controllers_share']):.3f}"
            assert f"| {study.KINDS[row['kind']]} | {row['controllers']} | {row['channels']} | {shares} |" in page
