"""Writes pictures of pages: the same bytes from the same data, SVG or PNG by the path's suffix."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vibrocast.files import atomic_write

POINTS = 8
_DPI = 120


@contextmanager
def figure_file(path: Path, width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a figure to draw on, which is written when the block succeeds. Raises OSError."""
    # Matplotlib names the parts of an SVG file by chance, unless it gets a salt.
    with rc_context({"font.size": POINTS, "axes.titlesize": POINTS, "svg.hashsalt": "vibrocast"}):
        figure = Figure((width_in, height_in), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with atomic_write(path) as partial:
            figure.savefig(partial, metadata={"Date": None} if path.suffix == ".svg" else None)
