"""Orders of trials: balanced over places and neighbours, the same again from the same seed."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tests.study.small_study import study_of, text_of
from vibrocast.study.designs import balanced_order, balanced_share, shuffled, williams_square
from vibrocast.study.methods import FixedDesign, design
from vibrocast.study.study_file import Study, read_study
from vibrocast.study.trials import Trial

COUNTS = st.integers(2, 12)
SEEDS = st.integers(0, 2**32 - 1)


@given(COUNTS)
def test_each_item_stands_in_each_place_and_behind_each_other_item_equally_often(count: int) -> None:
    rows = williams_square(count)
    repeats = 1 if count % 2 == 0 else 2
    assert len(rows) == repeats * count
    assert set(Counter((place, item) for row in rows for place, item in enumerate(row)).values()) == {repeats}
    followers = Counter(pair for row in rows for pair in pairwise(row))
    assert len(followers) == count * (count - 1)
    assert set(followers.values()) == {repeats}


@given(COUNTS, SEEDS)
def test_participants_get_all_rows_of_the_square(count: int, seed: int) -> None:
    items = [f"condition {number}" for number in range(count)]
    rows = len(williams_square(count))
    orders = [balanced_order(items, row, [seed]) for row in range(rows)]
    assert all(sorted(order) == sorted(items) for order in orders)
    assert set(Counter(order[0] for order in orders).values()) == {rows // count}
    assert balanced_order(items, rows, [seed]) == orders[0]


@given(COUNTS, SEEDS)
def test_the_same_seed_gives_the_same_order(count: int, seed: int) -> None:
    assert shuffled(range(count), [seed, 1]) == shuffled(range(count), [seed, 1])
    assert sorted(shuffled(range(count), [seed])) == list(range(count))
    assert balanced_order(["only"], 3, [seed]) == ["only"]


@given(COUNTS, st.data(), SEEDS)
def test_each_item_belongs_to_equally_many_shares(items: int, data: st.DataObject, seed: int) -> None:
    count = data.draw(st.integers(1, items))
    shares = [balanced_share(range(items), count, row, [seed]) for row in range(2 * items)]
    assert all(len(set(share)) == count and share == sorted(share) for share in shares)
    assert set(Counter(item for share in shares for item in share).values()) == {2 * count}


def trials_of(study: Study, participant: int) -> list[Trial]:
    """Return the main trials of a participant."""
    found: FixedDesign = design(study, participant)  # type: ignore[assignment]
    return found._trials


def test_of_fifteen_participants_ten_get_each_of_three_textures(tmp_path: Path) -> None:
    third = '[[textures]]\nname = "ridges"\nsurface = "ridges"\nseconds = 0.3\nhand_speed_mm_s = 50\n'
    (tmp_path / "study.toml").write_text(text_of("degradation", "textures_per_participant = 2\n") + third)
    study = read_study(tmp_path / "study.toml")
    met = [{trial.texture for trial in trials_of(study, participant)} for participant in range(1, 16)]
    assert all(len(textures) == 2 for textures in met)
    assert Counter(texture for textures in met for texture in textures) == {"rough": 10, "wood": 10, "ridges": 10}
    orders = [[trial.texture for trial in trials_of(study, participant)] for participant in range(1, 7)]
    assert Counter(order[0] for order in orders) == {"rough": 2, "wood": 2, "ridges": 2}


def test_a_random_order_has_each_stimulus_as_often_and_mixes_repetitions(tmp_path: Path) -> None:
    study = study_of(tmp_path, "degradation", 'order = "random"\nrepetitions = 4\n')
    orders = [[(each.texture, each.facts["condition"]) for each in trials_of(study, n)] for n in (1, 2)]
    assert all(set(Counter(order).values()) == {4} and len(order) == 2 * 3 * 4 for order in orders)
    assert orders[0] != orders[1]
    # Neither a repetition nor a texture comes in one go.
    assert all(len(set(order[:6])) < 6 or len({texture for texture, _ in order[:3]}) > 1 for order in orders)
    assert [each.number for each in trials_of(study, 1)] == list(range(1, 25))
