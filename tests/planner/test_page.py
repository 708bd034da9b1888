"""Tests of the picture of a plan: what range of qualities it shows."""

from types import SimpleNamespace
from typing import Any

import pytest

from vibrocast.host.planner.page import FAR_DB, _shown


@pytest.mark.parametrize(
    ("measure", "qualities", "shown"),
    [
        ("snr_db", [8.0, 12.0, 20.0], (8.0, 20.0)),
        ("snr_db", [-577.0, 12.0, 96.0], (10.0 - FAR_DB, 10.0 + FAR_DB)),
        ("snr_db", [], (9.0, 11.0)),
        ("spqi", [0.2, 0.9], (0.2, 10.0)),
    ],
)
def test_one_candidate_far_off_does_not_squeeze_the_others(
    measure: str, qualities: list[float], shown: tuple[float, float]
) -> None:
    asked = SimpleNamespace(measure=measure, **{measure: 10.0})
    scene: Any = SimpleNamespace(asked=asked)
    assert _shown(scene, qualities) == shown
