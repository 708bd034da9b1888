"""Writes the list of requirements into docs/reference/conformance.md: `python -m vibrocast.host.conformance.page`."""

from itertools import groupby
from pathlib import Path

from vibrocast.host.conformance.fixtures import SECTIONS
from vibrocast.host.conformance.runner import requirements

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "conformance.md"
# All behind it is generated.
_HEADING = "## Requirements\n"


def with_requirements(page: str) -> str:
    """Return the page with the requirements of the suite as it is."""
    lines = [page[: page.index(_HEADING)] + _HEADING.rstrip()]
    ordered = sorted(requirements(), key=lambda requirement: SECTIONS.index(requirement.section))
    for section, found in groupby(ordered, lambda requirement: requirement.section):
        lines.append(f"\n### {section}\n")
        lines += [f"- {requirement.text}" for requirement in found]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(with_requirements(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
