"""Tests of labels beside a panel."""

import numpy as np
import pytest

from vibrocast.evaluation.labels import spread


def test_labels_that_fit_stay_where_they_are_wanted() -> None:
    assert spread([0.2, 0.5, 0.9], [0.1, 0.1, 0.1]).tolist() == pytest.approx([0.2, 0.5, 0.9])
    assert spread([], []).tolist() == []


def test_labels_that_collide_move_apart_by_their_rooms() -> None:
    assert spread([0.5, 0.5], [0.1, 0.3]).tolist() == pytest.approx([0.4, 0.6])
    assert spread([0.0, 1.0], [0.2, 0.2]).tolist() == pytest.approx([0.1, 0.9])


def test_too_many_labels_shrink() -> None:
    heights = spread([0.5] * 20, [0.1] * 20)
    assert np.diff(heights).tolist() == pytest.approx([0.05] * 19)
    assert 0 < heights[0] < heights[-1] < 1
