"""Orders of trials: balanced Latin squares, drawn from a seed, with a row for each participant."""

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


def shuffled(items: Sequence[Item], seed: Sequence[int]) -> list[Item]:
    """Return the items in an order drawn from a seed."""
    return [items[place] for place in np.random.default_rng(list(seed)).permutation(len(items))]
