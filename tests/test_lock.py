"""requirements-dev.txt: pins with hashes all that pyproject.toml asks for, and names no machine."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK = (ROOT / "requirements-dev.txt").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# Every extra but train; the file says why.
EXTRAS = ("audio", "bench", "docs", "firmware", "keys", "learned", "peers", "plot", "study", "test")
# A package may have several versions, each for some Pythons or systems.
PINS = re.findall(r"^([\w.-]+)==(\S+)((?: ;[^\\\n]*)?(?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", LOCK, re.MULTILINE)


def requirements() -> list[Requirement]:
    lists = [PROJECT["dependencies"], *(PROJECT["optional-dependencies"][extra] for extra in EXTRAS)]
    return [Requirement(text) for each in lists for text in each if not text.startswith("vibrocast[")]


@pytest.mark.parametrize("requirement", requirements(), ids=str)
def test_every_requirement_has_a_pin_in_its_range(requirement: Requirement) -> None:
    versions = [version for name, version, _ in PINS if canonicalize_name(name) == canonicalize_name(requirement.name)]
    assert versions, "run `make lock`"
    assert all(requirement.specifier.contains(version) for version in versions)


def test_every_pin_has_hashes() -> None:
    assert len(re.findall(r"^[\w.-]+==", LOCK, re.MULTILINE)) == len(PINS) > 50


def test_the_file_names_no_machine() -> None:
    comments = [line for line in LOCK.splitlines() if line.lstrip().startswith("#")]
    assert not [
        line for line in LOCK.splitlines() if re.search(r"https?:|file:|--(extra-)?index|--find-links| @ ", line)
    ]
    assert not [line for line in comments if re.search(r"(^|\s)/\w", line)]


def test_every_extra_but_train_is_in_it() -> None:
    assert set(PROJECT["optional-dependencies"]) == {*EXTRAS, "train"}
