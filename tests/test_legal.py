"""Licences and versions: each dependency has a row on the page of licences, and the files agree with pyproject.toml."""

import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "third_party_licences.md"
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def normalised(name: str) -> str:
    """Return the name of a package as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def dependencies() -> set[str]:
    """Return the names of the packages that vibrocast, its extras and its build require, without vibrocast itself."""
    project = PROJECT["project"]
    groups = [PROJECT["build-system"]["requires"], project["dependencies"], *project["optional-dependencies"].values()]
    groups += [
        [each for each in group if isinstance(each, str)] for group in PROJECT.get("dependency-groups", {}).values()
    ]
    names = {re.split(r"[\s\[<>=!~;@]", requirement, maxsplit=1)[0] for group in groups for requirement in group}
    return {normalised(name) for name in names} - {"vibrocast"}


def licensed_packages() -> set[str]:
    """Return the packages that have a row of their own with a licence on the page."""
    rows = re.findall(r"^\| `([\w.-]+)` \| *[^|\s][^|]*\|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return set(map(normalised, rows))


def test_every_dependency_has_its_licence_on_the_page() -> None:
    assert dependencies() - licensed_packages() == set(), f"add rows to {PAGE.relative_to(ROOT)}"


def test_the_citation_agrees_with_the_project() -> None:
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    stated = dict(line.split(": ", 1) for line in lines if re.match(r"[a-z-]+: ", line))
    assert stated["cff-version"] == "1.2.0"
    assert stated["title"] == PROJECT["project"]["name"]
    assert stated["version"] == PROJECT["project"]["version"]
    assert stated["license"] == PROJECT["project"]["license"]
    assert "  - name: the vibrocast authors" in lines
