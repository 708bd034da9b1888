"""Pages filled from templates: what is escaped, what is missing, and how values are written."""

import re
import subprocess
from pathlib import Path

import pytest

from vibrocast import pages


def render(folder: Path, name: str, template: str, **values: object) -> str:
    (folder / name).write_text(template)
    return pages.render(folder / name, **values)


def test_html_escapes_every_value_and_markdown_what_a_table_would_take_for_its_own(tmp_path: Path) -> None:
    assert render(tmp_path, "a.html.jinja", "<p>{{ text }}</p>", text="<b> & |") == "<p>&lt;b&gt; &amp; |</p>\n"
    assert render(tmp_path, "a.md.jinja", "| {{ text | cell }} |", text="<b> \\\n|") == "| &lt;b> \\\\ \\| |\n"


def test_a_part_of_a_page_of_figures_ends_with_its_commit_and_leaves_the_other_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.md"

    def write(text: str, commit: str = "") -> str:
        monkeypatch.setattr(pages, "program", lambda: commit)
        pages.write_figures(path, text, redrawn=not commit)
        return path.read_text()

    assert write("# New\n") == "# New\n"
    assert write("# Page\n", "one") == "# Page\n\nFigures: one.\n"
    page = write("## Part\n", "two")
    assert page == "# Page\n\nFigures: one.\n\n## Part\n\nFigures: two.\n"
    page = write("# Page\n\nDrawn again.\n")
    assert page == "# Page\n\nDrawn again.\n\nFigures: one.\n\n## Part\n\nFigures: two.\n"
    page = write("## Part\n", "three")
    assert page == "# Page\n\nDrawn again.\n\nFigures: one.\n\n## Part\n\nFigures: three.\n"
    more = write("## More\n", "four")
    assert write("## Part\n", "five") == more.replace("three", "five")
    assert write("# Another page\n", "six") == "# Another page\n\nFigures: six.\n"


def test_the_tables_of_a_page_are_there_for_latex(tmp_path: Path) -> None:
    page = "# Codecs\n\n## Rates of `mdct`\n\n| codec | 50 % |\n| --- | ---: |\n| [a_b](x) &lt; \\| `c` | **1**[^1] |\n"
    pages.write_figures(tmp_path / "page.md", page)
    lines = (tmp_path / "page.tex").read_text().splitlines()
    assert lines[1:] == [
        r"\centering\caption{Rates of mdct}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"codec & 50 \% \\",
        r"\midrule",
        r"a\_b \textless{} \textbar{} c & 1 \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]


def test_the_program_is_its_commit_in_a_checkout_and_its_version_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Elsewhere: also below the checkout of another project, which ignores the folder."""
    pages.program.cache_clear()
    monkeypatch.setattr(pages, "_CHECKOUT", tmp_path / "other" / ".venv")
    pages._CHECKOUT.mkdir(parents=True)
    assert pages.program().startswith("vibrocast 0.")

    def git(*arguments: str) -> None:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", tmp_path / "other", *identity, *arguments], check=True, capture_output=True)

    (tmp_path / "other" / ".gitignore").write_text(".venv\n")
    for arguments in (("init",), ("add", "."), ("commit", "-m", "one")):
        git(*arguments)
    pages.program.cache_clear()
    assert pages.program().startswith("vibrocast 0.")
    monkeypatch.setattr(pages, "_CHECKOUT", tmp_path / "other")
    pages.program.cache_clear()
    assert re.fullmatch(r"commit [0-9a-f]{7,} \(\d{4}-\d\d-\d\d\)", pages.program())
    (tmp_path / "other" / ".gitignore").write_text("")
    pages.program.cache_clear()
    assert pages.program().endswith("), changed since")
    pages.program.cache_clear()


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        ("12.345 | number", "12.3"),
        ("none | number('.1f', ' %')", ""),
        ("12.345 | number('+.1f', ' %')", "+12.3 %"),
        ("0.00001 | g", "1e-05"),
        ("['a', 'b', 'c'] | listed", "a, b and c"),
        ("['a', 'b`'] | codes", "`a`, `b`"),
        ("1 | counted('trace')", "1 trace"),
        ("999 | size", "999 B"),
        ("28688 | size", "28.7 kB"),
        ("none | size", ""),
    ],
)
def test_filters(tmp_path: Path, expression: str, text: str) -> None:
    assert render(tmp_path, "a.md.jinja", f"{{{{ {expression} }}}}") == f"{text}\n"
