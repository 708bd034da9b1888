"""Figures that hand-written pages quote are those of the generated tables that comments next to them name.

A comment follows a figure and its unit:
16 %<!-- from docs/benchmarks/results/bd_rate.csv: mean where codec=slp, anchor=mdct -->.
"""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted({ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")})
COMMENT = re.compile(r"<!-- from (\S+): (\w+) where (.+?) -->")
FIGURE = re.compile(r"([-+]?)(\d+(?:\.\d+)?)( kB)?[ %]*$")


def mismatches(text: str, root: Path) -> list[str]:
    """Return what is wrong with the quoted figures of a page, whose comments name CSV files by their paths from `root`.

    Each comment must follow a figure, and name one row and a column. A figure is rounded as it stands; one without a
    sign stands for either, as in "16 % fewer".
    """
    wrong = []
    for comment in COMMENT.finditer(text):
        path, column, conditions = comment.groups()
        quoted = FIGURE.search(text, 0, comment.start())
        with (root / path).open(newline="", encoding="utf-8") as file:
            wanted = dict(condition.split("=", 1) for condition in conditions.split(", "))
            rows = [row for row in csv.DictReader(file) if {name: row.get(name) for name in wanted} == wanted]
        if quoted is None or len(rows) != 1:
            wrong.append(f"{comment[0]}: {len(rows)} rows, {'no' if quoted is None else 'a'} figure before it")
            continue
        sign, digits, kilobytes = quoted.groups()
        measured = float(rows[0][column]) / (1000 if kilobytes else 1)
        rounded = f"{measured:+.{len(digits.partition('.')[2])}f}"
        if rounded[1:] != digits or sign not in ("", rounded[0]):
            wrong.append(f"{quoted[0]}: {path} has {rounded}")
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_quoted_figures_are_those_of_the_tables(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert len(COMMENT.findall(text)) == text.count("<!-- from ")
    assert mismatches(text, ROOT) == []


def test_the_headline_is_compared() -> None:
    assert len(COMMENT.findall((ROOT / "README.md").read_text(encoding="utf-8"))) >= 3


@pytest.mark.parametrize(
    ("quoted", "fits"),
    [
        ("16 %", True),
        ("16.3 %", True),
        ("+16.32 %", True),
        ("11 %", False),
        ("-16 %", False),
        ("16.4", False),
        ("0.016 kB", True),
        ("many %", False),
    ],
)
def test_a_figure_fits_as_far_as_it_is_written(tmp_path: Path, quoted: str, fits: bool) -> None:
    (tmp_path / "a.csv").write_text("codec,kind,mean\nslp,,16.3211\nslp,tool,3\n")
    text = f"It needs {quoted}<!-- from a.csv: mean where codec=slp, kind= --> more."
    assert (mismatches(text, tmp_path) == []) == fits


@pytest.mark.parametrize("condition", ["codec=slp", "codec=mdct", "name=slp"])
def test_a_comment_names_one_row(tmp_path: Path, condition: str) -> None:
    (tmp_path / "a.csv").write_text("codec,kind,mean\nslp,,16.3211\nslp,tool,3\n")
    (problem,) = mismatches(f"16 %<!-- from a.csv: mean where {condition} -->", tmp_path)
    assert " rows, a figure before it" in problem
