"""Tests of the picture of a plan: which candidates it shows."""

from types import SimpleNamespace
from typing import Any

import pytest

from vibrocast.host.planner.page import FAR_COST, FAR_DB, _is_near


def candidate(quality: float | None, cost: float) -> Any:
    return SimpleNamespace(quality=quality, cost=cost)


@pytest.mark.parametrize(
    ("measure", "quality", "cost", "is_near"),
    [
        ("snr_db", 12.0, 1.5, True),
        ("snr_db", 10 + FAR_DB, 1.5, True),
        ("snr_db", 10.1 + FAR_DB, 1.5, False),
        ("snr_db", -577.0, 1.0, False),
        ("snr_db", None, 1.0, False),
        ("snr_db", 12.0, 1.1 * FAR_COST, False),
        ("spqi", 0.2, 1.0, True),
    ],
)
def test_candidates_far_off_do_not_squeeze_the_others(
    measure: str, quality: float | None, cost: float, is_near: bool
) -> None:
    scene: Any = SimpleNamespace(asked=SimpleNamespace(measure=measure, **{measure: 10.0}))
    assert _is_near(scene, candidate(10.0, 1.0), candidate(quality, cost)) == is_near


def test_the_choice_is_always_shown() -> None:
    scene: Any = SimpleNamespace(asked=SimpleNamespace(measure="snr_db", snr_db=10.0))
    silent = candidate(None, 1.0)
    assert _is_near(scene, silent, silent)
