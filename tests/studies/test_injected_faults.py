"""Injected faults raise an alarm: one of each place is measured here; the stored page shows all of them."""

from pathlib import Path

import pytest

from studies import injected_faults as study
from studies.faulty_bench import FAULTS
from vibrocast.evaluation import points
from vibrocast.simulated_device.serial_port import has_pseudo_terminals

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
NOTICED = points.read_rows(BENCHMARKS / "results" / study.TABLE, study.Noticed)
CLEAN = points.read_rows(BENCHMARKS / "results" / study.CLEAN_TABLE, study.Clean)


@pytest.mark.slow
@pytest.mark.skipif(not has_pseudo_terminals(), reason="the controller serves a pseudo-terminal")
@pytest.mark.parametrize("places", [("wire", "host"), ("device",), study.SENSED], ids=str)
def test_a_fault_of_each_place_is_noticed(places: tuple[str, ...], tmp_path: Path) -> None:
    chosen = {injected.place: injected for injected in FAULTS if injected.place in places}
    noticed = list(study.notice(list(chosen.values()), tmp_path))
    assert [each.place for each in noticed] == list(chosen)
    assert all(each.alarm != "none" and each.reason for each in noticed)


def test_the_stored_page_shows_every_fault_and_no_false_alarm() -> None:
    assert [(each.place, each.fault) for each in NOTICED] == [(each.place, each.fault) for each in FAULTS]
    assert len(NOTICED) >= 20
    assert all(each.alarm != "none" for each in NOTICED)
    assert {each.device for each in CLEAN} == set(study.DEVICES)
    assert len(CLEAN) >= 3 * len(study.DEVICES)
    stored, _, commit = (BENCHMARKS / study.PAGE).read_text(encoding="utf-8").rpartition("\nFigures: commit ")
    assert stored == study.page(NOTICED, CLEAN) and commit


def test_a_missed_fault_and_a_false_alarm_lead_the_page() -> None:
    page = study.page([study.Noticed("wire", "a fault", "none", "")], [study.Clean("sim", 1, "regression", "x")])
    assert "missed 1 of 1 faults" in page
    assert "1 of 1 runs without a fault raised an alarm" in page
