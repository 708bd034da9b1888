"""The pictures of the pages are as the script draws them."""

from pathlib import Path

import pytest

pytest.importorskip("schemdraw")
diagrams = pytest.importorskip("studies.diagrams")

ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "docs" / "figures"


@pytest.mark.parametrize("name", diagrams.PICTURES)
def test_the_stored_picture_is_what_the_script_draws(name: str) -> None:
    assert diagrams.PICTURES[name]().save() == (FIGURES / f"{name}.svg").read_text(encoding="utf-8")
