"""Tests of labels next to a panel."""

from itertools import pairwise

import pytest

from vibrocast.evaluation.labels import spread


def test_labels_that_fit_stay_at_their_targets() -> None:
    assert spread([0.2, 0.5, 0.9], [0.1, 0.1, 0.1]) == pytest.approx([0.2, 0.5, 0.9])
    assert spread([], []) == []


def test_labels_that_collide_move_apart_and_stay_in_the_panel() -> None:
    assert spread([0.5, 0.5], [0.1, 0.3]) == pytest.approx([0.5, 0.7])
    assert spread([0.9, 0.95], [0.1, 0.1]) == pytest.approx([0.85, 0.95])
    assert spread([0.0, 1.0], [0.2, 0.2]) == pytest.approx([0.1, 0.9])


def test_too_many_labels_shrink() -> None:
    heights = spread([0.5] * 20, [0.1] * 20)
    assert [after - before for before, after in pairwise(heights)] == pytest.approx([0.05] * 19)
    assert 0 < heights[0] < heights[-1] < 1
