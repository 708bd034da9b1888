"""Orders of trials: balanced Latin squares, random orders and shares of textures, drawn from a seed."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def williams_square(count: int) -> list[list[int]]:
    """Return orders of `count` items: rows in which each item stands in each place equally often.

    Each item also follows each other one equally often: once with an even count, whose square has `count` rows, and
    twice with an odd count, whose square has twice as many. E. J. Williams, "Experimental designs balanced for the
    estimation of residual effects of treatments", Australian Journal of Scientific Research A 2(2), 1949.
    """
    zigzag = [place // 2 if place % 2 == 0 else count - (place + 1) // 2 for place in range(count)]
    rows = [[(item + row) % count for item in zigzag] for row in range(count)]
    return rows if count % 2 == 0 or count == 1 else [*rows, *([*reversed(row)] for row in rows)]


def balanced_order(items: Sequence[Item], row: int, seed: Sequence[int]) -> list[Item]:
    """Return the items in the order of a row of their square; the seed draws which item is which.

    Rows after the last begin again. So each number of participants that is a multiple of the rows is balanced.
    """
    names = np.random.default_rng(list(seed)).permutation(len(items))
    rows = williams_square(len(items))
    return [items[names[place]] for place in rows[row % len(rows)]]


def balanced_share(items: Sequence[Item], count: int, row: int, seed: Sequence[int]) -> list[Item]:
    """Return `count` neighbours on a circle of the items, from place `row` on; the seed draws the circle.

    So each item belongs to equally many shares if the number of rows is a multiple of the number of items.
    """
    circle = np.random.default_rng(list(seed)).permutation(len(items))
    chosen = {int(circle[(row + place) % len(items)]) for place in range(count)}
    return [item for place, item in enumerate(items) if place in chosen]


def shuffled(items: Sequence[Item], seed: Sequence[int]) -> list[Item]:
    """Return the items in an order drawn from a seed."""
    return [items[place] for place in np.random.default_rng(list(seed)).permutation(len(items))]
