"""Pages filled from templates: what is escaped, what is missing, and how values are written."""

from pathlib import Path

import pytest
from jinja2 import UndefinedError

from vibrocast import pages


def render(folder: Path, name: str, template: str, **values: object) -> str:
    (folder / name).write_text(template)
    return pages.render(folder / name, **values)


def test_html_escapes_every_value_and_markdown_what_a_table_would_take_for_its_own(tmp_path: Path) -> None:
    assert render(tmp_path, "a.html.jinja", "<p>{{ text }}</p>", text="<b> & |") == "<p>&lt;b&gt; &amp; |</p>\n"
    assert render(tmp_path, "a.md.jinja", "| {{ text | cell }} |", text="<b> \\\n|") == "| &lt;b> \\\\ \\| |\n"


def test_blank_lines_of_markdown_are_one(tmp_path: Path) -> None:
    template = "# Page\n\n{% if false %}\nno\n{% endif %}\n\n{% for each in some %}\n- {{ each }}\n{% endfor %}\n\n\n"
    assert render(tmp_path, "a.md.jinja", template, some="ab") == "# Page\n\n- a\n- b\n"


def test_a_value_that_is_not_given_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UndefinedError, match="missing"):
        render(tmp_path, "a.md.jinja", "{{ missing }}")


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        ("12.345 | number", "12.3"),
        ("none | number('.1f', ' %')", ""),
        ("12.345 | number('+.1f', ' %')", "+12.3 %"),
        ("0.00001 | g", "1e-05"),
        ("['a', 'b', 'c'] | listed", "a, b and c"),
        ("[] | listed", ""),
        ("['a', 'b`'] | codes", "`a`, `b`"),
        ("1 | counted('trace')", "1 trace"),
        ("2 | counted('trace')", "2 traces"),
        ("999 | size", "999 B"),
        ("28688 | size", "28.7 kB"),
        ("none | size", ""),
    ],
)
def test_filters(tmp_path: Path, expression: str, text: str) -> None:
    assert render(tmp_path, "a.md.jinja", f"{{{{ {expression} }}}}") == f"{text}\n"
