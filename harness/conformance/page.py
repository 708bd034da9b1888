"""Writes the list of requirements into docs/reference/conformance.md; run it as a module."""

import argparse
import re
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

import pytest

from vibrocast.harness.conformance.fixtures import SECTIONS
from vibrocast.harness.conformance.runner import cases_of, collected, section_of, text_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "conformance.md"
# The rest of the page is generated.
_HEADING = "## Requirements\n"


def with_requirements(page: str) -> str:
    """Return the page with the suite's present requirements: a table for each section, a row for each test."""
    lines = [page[: page.index(_HEADING)] + _HEADING.rstrip()]
    for section, tests in groupby(sorted(collected(), key=lambda test: SECTIONS.index(section_of(test))), section_of):
        lines += [
            f"\n### [{section}](protocol.md#{_anchor(section)})\n",
            "| requirement | cases | test |",
            "|---|---|---|",
        ]
        lines += [_row(name, same) for name, same in groupby(tests, lambda test: test.originalname)]
    return "\n".join(lines) + "\n"


def _anchor(section: str) -> str:
    """Return the anchor of a heading on the protocol's page."""
    return re.sub(r"[^\w ]", "", section.rpartition(": ")[2].lower()).replace(" ", "-")


def _row(name: str, tests: Iterable[pytest.Function]) -> str:
    """Return the row of a test with all its cases."""
    same = list(tests)
    cases = list(map(cases_of, same))
    text = text_of(same[0])
    shown = [parameter for parameter in cases[0] if f"{{{parameter}}}" in text]
    values = [", ".join(dict.fromkeys(case[parameter] for case in cases)) for parameter in shown]
    listed = "; ".join(f"*{_words(parameter)}*: {value}" for parameter, value in zip(shown, values, strict=True))
    text = text.format(**{parameter: f"*{_words(parameter)}*" for parameter in cases[0]})
    return f"| {text} | {listed} | `{name}` |".replace("|  |", "| |")


def _words(parameter: str) -> str:
    return parameter.replace("_", " ")


if __name__ == "__main__":
    argparse.ArgumentParser(
        description="Write the requirements of the suite into docs/reference/conformance.md."
    ).parse_args()
    PAGE.write_text(with_requirements(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
