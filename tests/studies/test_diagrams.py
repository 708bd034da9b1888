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


@pytest.mark.parametrize("name", diagrams.PICTURES)
def test_a_picture_is_white_and_its_labels_lie_apart(name: str) -> None:
    root = ElementTree.parse(FIGURES / f"{name}.svg").getroot()
    assert "fill:white" in root[0].attrib["style"]
    boxes = []
    for text in root.iter(f"{SVG}text"):
        (line,) = text
        size = float(text.attrib["font-size"])
        assert size >= 12
        width = 0.54 * size * len("".join(text.itertext()))
        left = float(line.attrib["x"]) - {"start": 0.0, "middle": 0.5, "end": 1.0}[text.attrib["text-anchor"]] * width
        boxes.append((left, left + width, float(text.attrib["y"]), size, "".join(text.itertext())))
    assert all(left >= 0 and right <= 36 * diagrams.WIDTH for left, right, *_ in boxes)
    for one, other in itertools.combinations(boxes, 2):
        beside = one[1] <= other[0] or other[1] <= one[0]
        assert beside or abs(one[2] - other[2]) >= 0.9 * min(one[3], other[3]), (one[4], other[4])


@pytest.mark.parametrize("name", ["session", "upload"])
def test_every_request_is_followed_by_its_answer(name: str) -> None:
    known = {message.__name__: message for message in messages.ALL}
    sent = [label.split(":")[0] for label in labels(name) if ":" in label]
    sent = [label for label in sent if label in known]
    assert len(sent) >= 10
    for request, answer in itertools.pairwise(sent):
        if known[request] in messages.REQUESTS:
            assert known[request].ANSWER.startswith(answer)
