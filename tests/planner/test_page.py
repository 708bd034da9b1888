"""The answer as text and JSON, and the picture of a plan: which candidates it shows."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from tests.planner.scenes import scene
from vibrocast.planner import page
from vibrocast.planner.choose import TextureChoice, plan
from vibrocast.planner.plan_file import PlannedTexture
from vibrocast.planner.scene import MEASURES, Scene


@pytest.fixture(scope="module")
def answer(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, TextureChoice, PlannedTexture]:
    read = scene(tmp_path_factory.mktemp("scene"))
    planned, (choice,) = plan(read)
    return read, choice, planned.textures[0]


def test_the_answer_begins_with_the_choice_and_fits_a_terminal(
    answer: tuple[Scene, TextureChoice, PlannedTexture],
) -> None:
    read, choice, texture = answer
    lines = page.summary(read.asked, choice, texture).splitlines()
    assert lines[0] == f"wood: {choice.chosen.measured.option.name}"
    labels = [line[:14].strip() for line in lines[1:] if line[:14].strip()]
    assert labels == ["why", "settings", "bit rate", "quality", "delay", "controller", *["rejected"] * 3]
    assert len(lines) <= 14 and max(map(len, lines)) <= 80


def test_a_long_name_is_folded_and_its_controls_are_escaped(
    answer: tuple[Scene, TextureChoice, PlannedTexture],
) -> None:
    read, choice, texture = answer
    lines = page.summary(read.asked, choice, replaced(texture, name="wood \x1b[2J " * 12)).splitlines()
    assert "\\x1b" in lines[0] and lines[1].startswith(("  wood", "  \\x1b"))
    assert max(map(len, lines)) <= 80


def replaced(texture: PlannedTexture, **changed: Any) -> Any:
    return SimpleNamespace(**{name: getattr(texture, name) for name in texture.__struct_fields__} | changed)


def test_json_holds_the_choice_its_reason_and_the_alternatives(
    answer: tuple[Scene, TextureChoice, PlannedTexture],
) -> None:
    _, choice, texture = answer
    read = json.loads(json.dumps(page.document(choice, texture), allow_nan=False))
    assert read["choice"]["codec"] == texture.codec and read["choice"]["setting"] == texture.setting
    assert read["reason"] == choice.why
    assert [each["rejected"] for each in read["alternatives"]] == [each.why for each in choice.alternatives]
    assert all(each["cost"] >= read["choice"]["cost"] for each in read["alternatives"])


def test_the_picture_is_drawn(answer: tuple[Scene, TextureChoice, PlannedTexture], tmp_path: Path) -> None:
    read, choice, _ = answer
    page.draw(tmp_path / "plan.png", read, [choice] * 8)
    picture = imread(tmp_path / "plan.png")
    assert picture.shape[0] > picture.shape[1], "panels are below each other"
    assert np.ptp(picture[..., :3]) > 0.5


def candidate(quality: float | None, cost: float) -> Any:
    return SimpleNamespace(quality=quality, cost=cost)


FAR_DB, FAR_COST = MEASURES["snr_db"].far, page.FAR_COST
NEAR = [
    ("snr_db", 12.0, 1.5, True),
    ("snr_db", 10 + FAR_DB, 1.5, True),
    ("snr_db", 10.1 + FAR_DB, 1.5, False),
    ("snr_db", -577.0, 1.0, False),
    ("snr_db", None, 1.0, False),
    ("snr_db", 12.0, 1.1 * FAR_COST, False),
    ("spqi", 9.8, 1.0, True),
    ("spqi", 9.6, 1.0, False),
]


@pytest.mark.parametrize(("measure", "quality", "cost", "is_near"), NEAR)
def test_candidates_far_off_do_not_squeeze_the_others(
    measure: str, quality: float | None, cost: float, is_near: bool
) -> None:
    asked: Any = SimpleNamespace(measure=measure, **{measure: 10.0})
    choice: Any = SimpleNamespace(compared=candidate(10.0, 1.0), alternatives=())
    assert page.is_near(asked, choice, candidate(quality, cost)) == is_near


def test_alternatives_are_shown_at_twice_the_distance() -> None:
    asked: Any = SimpleNamespace(measure="snr_db", snr_db=10.0)
    costly, far = candidate(12.0, 1.9 * FAR_COST), candidate(12.0, 2.1 * FAR_COST)
    choice: Any = SimpleNamespace(
        compared=candidate(10.0, 1.0), alternatives=(SimpleNamespace(best=costly), SimpleNamespace(best=far))
    )
    assert page.is_near(asked, choice, costly) and not page.is_near(asked, choice, far)


def test_the_choice_is_always_shown() -> None:
    asked: Any = SimpleNamespace(measure="snr_db", snr_db=10.0)
    best = candidate(60.0, 1.0)
    choice: Any = SimpleNamespace(compared=best, alternatives=())
    assert page.is_near(asked, choice, best)
