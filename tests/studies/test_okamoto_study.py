"""Simulated observers in the texture paper's study: its conditions, limits, claims and page."""

from dataclasses import replace
from pathlib import Path

import pytest

from studies import okamoto_study
from studies.okamoto_study import CUT, LINEAR, LOG, Fall, Result, claims, limit
from studies.texture_paper import PUBLISHED, generated_profiles
from vibrocast.host.study.study_file import read_study


def row(texture: str, family: str, parameter: float, is_noticed: bool) -> Result:
    return Result(texture, family, parameter, 10.0, 1.0, 0.5, 3.0, 0.01 if is_noticed else 0.5, 0.5, 1.0, 0.0, 2.0)


def test_limits_end_at_the_first_noticed_value_from_the_finest() -> None:
    levels = [row("wood", LINEAR, value, value in (4, 8)) for value in (4, 6, 8, 10, 12)]
    assert limit(levels, "wood", LINEAR, (4, 6, 8, 10, 12)) == 10
    assert limit(levels, "wood", LINEAR, (4, 6)) == 6
    assert limit(levels, "wood", LINEAR, (8,)) is None
    cuts = [row("wood", CUT, value, value > 0) for value in (-8, -4, 0, 4)]
    assert limit(cuts, "wood", CUT, (-8, -4, 0, 4)) == 0


def test_a_better_grade_than_the_hidden_reference_is_not_noticed() -> None:
    assert row("wood", LINEAR, 4, True).is_noticed
    assert not replace(row("wood", LINEAR, 4, True), difference=-0.5).is_noticed


def rows_of(levels: dict[str, int], cuts_db: dict[str, float]) -> list[Result]:
    """Return results in which each texture has these limits."""
    rows = [row(name, LINEAR, value, value < levels[name]) for name in levels for value in okamoto_study.LEVELS]
    return rows + [row(name, CUT, value, value > cuts_db[name]) for name in cuts_db for value in okamoto_study.CUTS_DB]


def test_listeners_like_those_of_the_paper_agree_with_every_claim() -> None:
    levels = {name: each.levels for name, each in PUBLISHED.items()}
    cuts_db = {name: each.b0_db for name, each in PUBLISHED.items()}
    found = claims(rows_of(levels, cuts_db), [Fall("wood", 4, 5, 0.5, 0.01)])
    assert [each.text for each in found if not each.agrees] == []
    assert sum(each.is_order for each in found) == 4


def test_other_listeners_disagree() -> None:
    found = claims(rows_of(dict.fromkeys(PUBLISHED, 1000), dict.fromkeys(PUBLISHED, -100.0)), [])
    agreeing = [each.text for each in found if each.agrees]
    assert agreeing == ["a cut at the threshold, b0 = 0 dB, is noticed on wood and sandpaper"]
    assert "more than 128" in found[0].here


def test_the_study_file_can_be_read(tmp_path: Path) -> None:
    for name in PUBLISHED:
        (tmp_path / f"{name}.csv").touch()
    path = tmp_path / "study.toml"
    path.write_text(okamoto_study.study_file("degradation", 2, PUBLISHED))
    study = read_study(path)
    assert len(study.conditions) == 2 + len(okamoto_study.conditions())
    settings = {each.name: each.setting for each in study.conditions}
    assert settings["cut -8"]["b0_db"] == -8
    assert settings["log 14"]["quantiser"] == "log"


def test_the_page_is_written_for_few_observers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(okamoto_study, "REPETITIONS", 1)
    monkeypatch.setattr(okamoto_study, "PAIRS", 2)
    monkeypatch.setattr(okamoto_study, "LEVELS", (4, 128))
    monkeypatch.setattr(okamoto_study, "PAPER_LEVELS", (4,))
    monkeypatch.setattr(okamoto_study, "CUTS_DB", (-20, 0))
    monkeypatch.setattr(okamoto_study, "VALUES", {LINEAR: (4, 128), LOG: (4, 128), CUT: (-20, 0)})
    okamoto_study.write(tmp_path, generated_profiles(), 3)
    page = (tmp_path / "simulated_study.md").read_text()
    assert "**A simulated observer is not a person.**" in page
    assert "Simulated observers, not people" in (tmp_path / "results/simulated_study.svg").read_text()
    lines = (tmp_path / "results/simulated_study.csv").read_text().splitlines()
    assert len(lines) == 1 + 3 * 6
    grades = {tuple(line.split(",")[:3]): float(line.split(",")[4]) for line in lines[1:]}
    assert grades["leather", "linear", "4"] > grades["leather", "linear", "128"]
