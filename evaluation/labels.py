"""Labels beside a panel: as near to what they name as they fit without overlap."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression


def spread(wanted: Sequence[float], rooms: Sequence[float]) -> NDArray[np.float64]:
    """Return the heights of labels in a panel from 0 to 1, in the same order: nearest in squares to those wanted.

    `wanted`: rising. `rooms`: how much of the panel each label takes; all shrink alike where they do not fit.
    """
    if not len(wanted):
        return np.zeros(0)
    needed = np.asarray(rooms, np.float64)
    needed = needed / max(1.0, float(needed.sum()))
    # Rising heights, each at least half of both rooms above the one below.
    centres = np.cumsum(needed) - needed / 2
    slack = isotonic_regression(np.asarray(wanted) - centres).x
    return np.asarray(np.clip(slack, 0, 1 - needed.sum()) + centres)
