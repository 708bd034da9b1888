"""Labels next to a panel: at the heights of their curves, moved apart where they would overlap."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Label:
    """A text for a point of a panel. `form`: how matplotlib writes it; `arrow`: how it draws the line to the point."""

    point: tuple[float, float]
    text: str
    form: Mapping[str, Any]
    arrow: Mapping[str, Any]


def write_beside(
    axes: Axes, left: float, labels: Sequence[Label], targets: Sequence[float], heights: Sequence[float]
) -> None:
    """Write labels at `left` of a panel's width, with lines to their points; `targets`, `heights`: as in spread."""
    for label, height in zip(labels, spread(targets, heights), strict=True):
        axes.annotate(
            label.text,
            label.point,
            (left, height),
            textcoords="axes fraction",
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "relpos": (0, 0.5), **label.arrow},
            **label.form,
        )


def spread(targets: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Return the places of labels in a panel from 0 to 1: each at its target, or just above the label below.

    `targets`: rising. `heights`: how much of the panel each label takes; all shrink alike where they do not fit. Labels
    that would leave the panel at the top move down, with those below them.
    """
    halves = [height / 2 / max(1.0, sum(heights)) for height in heights]
    places: list[float] = []
    bottom, top = 0.0, 1.0
    for target, half in zip(targets, halves, strict=True):
        places.append(max(target, bottom + half))
        bottom = places[-1] + half
    for index in reversed(range(len(places))):
        places[index] = min(places[index], top - halves[index])
        top = places[index] - halves[index]
    return places
