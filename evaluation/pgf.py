"""Writes a figure as PGF without LaTeX, which matplotlib would call to measure each text."""

from pathlib import Path
from typing import Any
from unittest.mock import patch

from matplotlib.backend_bases import RendererBase
from matplotlib.backends import backend_pgf
from matplotlib.figure import Figure

from vibrocast.pages import latex


class _Renderer(backend_pgf.RendererPgf):
    """Measures text in matplotlib's own font, and escapes what LaTeX would read as a command."""

    get_text_width_height_descent = RendererBase.get_text_width_height_descent

    def draw_text(
        self, gc: Any, x: float, y: float, s: str, prop: Any, angle: float, ismath: Any = False, mtext: Any = None
    ) -> None:
        # The preamble of a paper need not define matplotlib's own command.
        text = s.replace(r"\mathdefault", "") if ismath else latex(s)
        super().draw_text(gc, x, y, text, prop, angle, ismath, mtext)  # type: ignore[no-untyped-call]


def write(figure: Figure, path: Path) -> None:
    """Write a figure without images. Raises OSError."""
    # Matplotlib's canvas looks its renderer up by this name.
    with patch.object(backend_pgf, "RendererPgf", _Renderer):
        figure.savefig(path, format="pgf")
