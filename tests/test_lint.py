"""The checks of `make lint` notice a page, a docstring and a figure that break a rule."""

from pathlib import Path

import pytest

from tests import lint

LONG = "One word after another " * 9


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("page.md", f"# Page\n\n{LONG}.\n", ["3: sentence of 36 words"]),
        ("page.md", f'=== "Tab"\n\n    {LONG}.\n', ["3: sentence of 36 words"]),
        ("page.md", "| a |\n|---|\n| .3 s |\n", ["3: write .3 with its leading zero"]),
        ("page.md", "See\n[the ladder](page.md).\n", ['1: "ladder" is a retired term: rate points, rate point']),
        ("page.md", "`.3`, 1.2.3, ../a and:\n\n```\ntactor\n```\n\n## Words to avoid\n\ntactor\n", []),
        ("page.md", f"{LONG[:100]}. {LONG[:100]}!\n", []),
        (
            "a.py",
            f'"""Fine."""\n\n\ndef f() -> None:\n    """Fine.\n\n    {LONG}.\n    """\n',
            ["7: sentence of 36 words"],
        ),
        ("a.c", f"/* Fine. */\nint x;\n/* Fine.\n *\n * {LONG}. */\n", ["5: sentence of 36 words"]),
    ],
)
def test_words_are_read(
    name: str, content: str, found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lint, "ROOT", tmp_path)
    (tmp_path / name).write_text(content)
    assert [each.partition("; ")[0] for each in lint.file_findings(name)] == [f"{name}:{each}" for each in found]


@pytest.mark.parametrize(
    ("text", "row", "fits"),
    [
        ("It needs 16 %", {"codec": "slp", "kind": ""}, True),
        ("It needs +16.32 %", {"codec": "slp", "kind": ""}, True),
        ("It needs 0.016 kB", {"codec": "slp", "kind": ""}, True),
        ("It needs 11 %", {"codec": "slp", "kind": ""}, False),
        ("It needs -16 %", {"codec": "slp", "kind": ""}, False),
        ("It needs many %", {"codec": "slp", "kind": ""}, False),
        ("It needs 16 %", {"codec": "slp"}, False),  # two rows
        ("It needs 16 %", {"name": "slp"}, False),
        ("needs 16.3", {"codec": "slp", "kind": ""}, False),  # the page goes on: 16.32
    ],
)
def test_a_quoted_figure_fits_as_far_as_it_is_written(
    text: str, row: dict[str, str], fits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lint, "ROOT", tmp_path)
    (tmp_path / "a.csv").write_text("codec,kind,mean\nslp,,16.3211\nslp,tool,3\n")
    (tmp_path / "page.md").write_text(f"{text}2 more." if text == "needs 16.3" else f"{text} more.")
    assert (list(lint.figure_findings("page.md", text, "a.csv", row, "mean")) == []) == fits
