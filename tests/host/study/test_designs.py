"""Orders of trials: balanced over places and neighbours, the same again from the same seed."""

from collections import Counter
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from vibrocast.host.study.designs import balanced_order, shuffled, williams_square

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


def test_one_item_has_one_order() -> None:
    assert balanced_order(["only"], 3, [1]) == ["only"]
