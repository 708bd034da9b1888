"""Labels next to a panel: at the heights of their points, moved apart where they would overlap."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes

from vibrocast.evaluation.pictures import INK, POINTS

_LINE = 1.35
"""Height of a line of text, relative to the size of its letters."""
_PANEL = 0.75
"""About this part of a figure's height belongs to its panels; the rest to titles and axes."""
_LEFT = 1.03
"""Where labels begin, of a panel's width."""


@dataclass(frozen=True, eq=False)
class Label:
    """A text for a point of a panel. `points`: the size of its letters."""

    x: float
    y: float
    text: str
    colour: str = INK
    points: float = POINTS
    bold: bool = False


def write_beside(axes: Axes, labels: Sequence[Label]) -> None:
    """Write labels right of a panel, as near to the height of their points as they fit, with lines to the points."""
    to_axes = axes.transScale + axes.transLimits
    targets = {label: float(to_axes.transform((label.x, label.y))[1]) for label in labels}
    ordered = sorted(labels, key=lambda label: (targets[label], -label.x))
    grid, figure = axes.get_gridspec(), axes.get_figure(root=True)
    assert grid is not None and figure is not None, "the panel is one of a figure's"
    panel_points = 72 * _PANEL * figure.get_figheight() / grid.nrows
    heights = [_LINE * label.points * (1 + label.text.count("\n")) / panel_points for label in ordered]
    for label, place in zip(ordered, spread([targets[label] for label in ordered], heights), strict=True):
        axes.annotate(
            label.text,
            (label.x, label.y),
            (_LEFT, place),
            textcoords="axes fraction",
            va="center",
            annotation_clip=False,
            color=label.colour,
            fontsize=label.points,
            fontweight="bold" if label.bold else "normal",
            arrowprops={
                "arrowstyle": "-",
                "relpos": (0, 0.5),
                "color": label.colour,
                "alpha": 0.4,
                "linewidth": 0.5,
                "shrinkA": 1,
                "shrinkB": 0,
            },
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
