"""The pictures of the pages: as the script draws them, true to the sources, and legible."""

import itertools
from pathlib import Path
from xml.etree import ElementTree

import pytest

from vibrocast.device_protocol import messages

pytest.importorskip("schemdraw")
diagrams = pytest.importorskip("studies.diagrams")

ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "docs" / "figures"
SVG = "{http://www.w3.org/2000/svg}"


def labels(name: str) -> list[str]:
    """Return the labels of a stored picture, line by line."""
    root = ElementTree.parse(FIGURES / f"{name}.svg").getroot()
    return ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]


@pytest.mark.parametrize("name", diagrams.PICTURES)
def test_the_stored_picture_is_what_the_script_draws(name: str) -> None:
    assert diagrams.PICTURES[name]().save() == (FIGURES / f"{name}.svg").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["session", "upload"])
def test_every_request_is_followed_by_its_answer(name: str) -> None:
    known = {message.__name__: message for message in messages.ALL}
    sent = [label.split(":")[0] for label in labels(name) if ":" in label]
    sent = [label for label in sent if label in known]
    assert len(sent) >= 10
    for request, answer in itertools.pairwise(sent):
        if known[request] in messages.REQUESTS:
            assert known[request].ANSWER.startswith(answer)
