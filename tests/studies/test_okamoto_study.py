"""Simulated observers in the texture paper's study: its tables, limits, agreement and page."""

import numpy as np
import pytest
from scipy import stats

from studies import okamoto_study
from studies.okamoto_study import (
    AGAIN,
    CUT,
    DEGREES,
    EXAMPLES,
    LINEAR,
    TEXTURES,
    Published,
    Simulated,
    limit,
    limits,
    orders,
    read_tables,
    similar,
)
from studies.texture_paper import PUBLISHED
from vibrocast.study.methods import FixedDesign, design
from vibrocast.study.study_file import read_study


def test_each_p_of_the_tables_follows_from_its_t() -> None:
    table = read_tables()
    assert len(table) == 51
    for row in table:
        assert row.p == pytest.approx(2 * stats.t.sf(row.t, DEGREES), rel=0.02), row


def test_the_study_file_has_the_conditions_of_the_tables() -> None:
    study = read_study(EXAMPLES / "okamoto.toml")
    for texture in TEXTURES:
        assert set(study.of_role("condition", texture=texture)) == {
            condition for name, condition in (row.key for row in read_tables()) if name == texture
        }
    found: FixedDesign = design(study, 1)  # type: ignore[assignment]
    trials = found._trials
    assert len({trial.texture for trial in trials}) == 2
    counts = {(each.texture, each.facts["condition"]): 0 for each in trials}
    for each in trials:
        counts[each.texture, each.facts["condition"]] += 1
    assert set(counts.values()) == {4}
    assert study.hand is not None and study.hand.stroke_s == pytest.approx(1 / 1.25)
    assert study.masking_noise is not None and study.masking_noise.spectrum == "pink"
    pairs = read_study(EXAMPLES / "okamoto_pairs.toml")
    for texture in TEXTURES:
        assert 2 * pairs.repetitions * len(pairs.of_role("condition", texture=texture)) == 40


def test_limits_end_at_the_first_noticed_value_from_the_finest() -> None:
    assert limit({4: True, 6: False, 8: True, 10: False, 12: False}, LINEAR) == 10
    assert limit({4: True, 6: False}, LINEAR) == 6
    assert limit({8: True}, LINEAR) is None
    assert limit({-8: False, -4: False, 0: False, 4: True}, CUT) == 0


def people(table: list[Published], studies: int) -> Simulated:
    """Return studies in which ten people notice exactly what those of the paper do, with t in the paper's order."""
    reference = np.tile([0.0, 0.5], (studies, 5))
    ranks = stats.rankdata([row.t for row in table])
    grades = {(texture, AGAIN): reference for texture in TEXTURES}
    for row, rank in zip(table, ranks, strict=True):
        spread = np.linspace(-1, 1, 10)
        spread /= np.std(spread, ddof=1) / np.sqrt(10)
        t = 2.2 * rank / 51 if not row.is_noticed else 2.3 + rank
        grades[row.key] = reference + 0.01 * (t + spread)
    return Simulated(grades)


def test_people_like_those_of_the_paper_agree_with_it() -> None:
    table = read_tables()
    simulated = people(table, 3)
    agreeing, rho = simulated.agreement(table)
    assert agreeing.tolist() == [51] * 3
    assert rho == pytest.approx(1)
    found = limits(simulated, table)
    assert len(found) == 8
    for each in found:
        assert each.percent == {each.paper: 100}
        if each.family != okamoto_study.LOG:
            paper = PUBLISHED[each.texture]
            assert each.paper == (paper.b0_db if each.family == CUT else paper.levels)
    assert set(orders(simulated, table).values()) == {100}
    assert {each.texture: each.percent for each in similar(simulated, table)} == {
        "wood": 0,  # its t is higher than that of ten levels, by a little
        "sandpaper": 100,
        "leather": 100,
    }
