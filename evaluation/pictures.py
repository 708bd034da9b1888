"""Pictures of pages and papers: colours of codecs, readable in grey, and the same bytes from the same data."""

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vibrocast.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, GREY, PALE = "#222222", "#767676", "#e6e6e6"
"""Of text and axes; of what stays in the background; of grids and areas."""
BLUE, SKY, PURPLE, ORANGE = "#00558c", "#2f86cc", "#8e3fa8", "#d55e00"
BROWN, GREEN, AMBER = "#7f3b08", "#00856a", "#a87400"
POINTS, SMALL_POINTS = 9.0, 7.5
"""Sizes of letters: of titles, axes and labels, and of labels in grey."""
AXES: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "grid.color": PALE,
    "text.parse_math": False,
}
"""Settings of matplotlib for panels of curves and marks."""
_FILE: Any = {
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "pdf.fonttype": 42,  # TrueType: journals reject Type 3
    "pgf.rcfonts": False,  # the paper's fonts
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "vibrocast",  # else the parts get random names
}
"""Settings of matplotlib for files."""
_METADATA: Mapping[str, Any] = {".svg": {"Date": None, "Creator": None}, ".pdf": {"CreationDate": None}}
_FOR_PAPERS = (".pdf", ".pgf")
_PAGE_POINTS = 8
_DPI = 120


@dataclass(frozen=True)
class Style:
    """How a codec is drawn. `dashes`: a line style of matplotlib; lines of this project's codecs are solid."""

    colour: str
    dashes: Any = "-"
    width: float = 1.6


CODECS: Mapping[str, Style] = {
    "mdct": Style(BLUE, width=2.8),
    "eva": Style(PURPLE),
    "vcpwq": Style(ORANGE, (0, (5, 1.5))),
    "mpeg": Style(BROWN, (0, (1.5, 1))),
    "opus": Style(GREEN, (0, (6, 1.5, 1.5, 1.5))),
    "speex": Style(AMBER, (0, (3, 1))),
}
"""By the first letters of a curve's name."""
OTHERS = Style("#c2185b", width=2.0)
"""Of codecs that are not known."""


@contextmanager
def figure_file(path: Path, width_in: float, height_in: float) -> "Iterator[Figure]":
    """Yield a figure to draw on, which is written when the block succeeds. Raises OSError."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context({"font.size": _PAGE_POINTS, "axes.titlesize": _PAGE_POINTS}):
        figure = Figure((width_in, height_in), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        write(figure, path)


def write(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of the path's suffix, and for papers as PDF and PGF next to it. Raises OSError.

    A figure with images has no PGF file: each image would be a file of its own.
    """
    from matplotlib import rc_context
    from matplotlib.image import AxesImage

    from vibrocast.evaluation import pgf

    suffixes = (path.suffix, *_FOR_PAPERS[: 1 if figure.findobj(AxesImage) else 2])
    for each in map(path.with_suffix, suffixes):
        with atomic_write(each) as partial, rc_context(_FILE):
            if each.suffix == ".pgf":
                pgf.write(figure, partial)
                continue
            stored = io.BytesIO()
            figure.savefig(stored, format=each.suffix[1:], metadata=_METADATA.get(each.suffix))
            partial.write_bytes(stored.getbuffer())  # matplotlib's own writing of a PDF hides a full disk


def inlined(figure: "Figure") -> str:
    """Return a figure as SVG for a page of HTML."""
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context(_FILE):
        figure.savefig(text, format="svg", metadata=_METADATA[".svg"])
    return text.getvalue()[text.getvalue().index("<svg") :]


def remove(path: Path) -> None:
    """Remove what `write` wrote, if it is there. Raises OSError."""
    for each in map(path.with_suffix, (path.suffix, *_FOR_PAPERS)):
        each.unlink(missing_ok=True)
