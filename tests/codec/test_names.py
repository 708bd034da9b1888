"""Codecs describe themselves: outside codec/, no module names one, but those that are about that codec alone."""

import ast
from pathlib import Path

import pytest

from vibrocast.codec import BUILT_IN

ROOT = Path(__file__).parents[2]
PACKAGES = ("device_protocol", "evaluation", "host", "output", "simulated_device", "textures")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
SOURCES += sorted((ROOT / "vibrocast").glob("*.py"))
MODULES = {path.stem for path in (ROOT / "codec").glob("*.py") if "\nCODEC" in path.read_text(encoding="utf-8")}
MODULES = MODULES - {"registry"} | {"eva_image"}
ABOUT_ONE_CODEC = {
    "evaluation/charts.py": "the curves that charts emphasise",
    "evaluation/comparison.py": "the curves that others are compared with",
    "export/model_card.py": "the card of a model that export/ has trained",
    "evaluation/results_page.py": "the curves of the first table",
    "evaluation/stability/filters.py": "a map of the filters of one codec",
    "evaluation/stability/float_parity.py": "a map of one network in floating point",
    "evaluation/stability/settings.py": "maps of the parameters and entropy coders of one codec",
    "evaluation/stability/learned_signals.py": "a map of the learned codec beside one without a network",
    "harness/conformance/test_playing.py": "a packet that one codec is sure to find damaged",
    "evaluation/pictures.py": "the colours of the curves that charts emphasise",
}


def named_codecs(source: str) -> set[str]:
    """Return the codecs that the code names: as a text, or by their modules."""
    named: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            named |= {node.value} & set(BUILT_IN)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vibrocast.codec"):
            imported = {*(node.module or "").split("."), *(alias.name for alias in node.names)}
            named |= imported & MODULES
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "codec":
            named |= {node.attr} & MODULES
    return named


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_read_what_they_need_from_the_codec(path: Path) -> None:
    named = named_codecs(path.read_text(encoding="utf-8"))
    if str(path.relative_to(ROOT)) in ABOUT_ONE_CODEC:
        assert named, "it names no codec any more: take it off the list"
    else:
        assert not named, f"make what it knows of {', '.join(sorted(named))} an attribute of codec.Codec"


@pytest.mark.parametrize("line", ["name == 'dct'", "codec.mdct.IDENTIFIER", "from vibrocast.codec import slp"])
def test_naming_a_codec_is_found(line: str) -> None:
    assert named_codecs(line)
