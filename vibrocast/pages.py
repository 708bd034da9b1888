"""Renders pages from the templates next to their modules: text, Markdown, C, and HTML with every value escaped."""

import html
import re
import subprocess
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from vibrocast.files import atomic_write

FIGURES = "Figures: "
"""Begins the last line of each part of a page of figures."""
_CHECKOUT = Path(__file__).resolve().parents[1]


def render(template: Path, **values: object) -> str:
    """Return the page of a Jinja2 template, `*.html.jinja`, `*.md.jinja` or another text, filled with values.

    Except in HTML, consecutive blank lines become one. Raises jinja2.TemplateError.
    """
    is_html = template.name.endswith(".html.jinja")
    environment = Environment(
        loader=FileSystemLoader(template.parent),
        undefined=StrictUndefined,
        autoescape=is_html,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    text = environment.get_template(template.name).render(values)
    return (text if is_html else re.sub(r"\n{3,}", "\n\n", text)).strip("\n") + "\n"


def write_figures(path: Path, part: str, redrawn: bool = False) -> None:
    """Write a part of a page of figures; its last line states from which program they are. Raises OSError.

    A part that begins with the heading of one of the page replaces it. Else `# ` begins the page anew, and `## ` comes
    at its end. `redrawn`: the figures are those of the part that is there, and keep its last line. A file
    of suffix .tex next to it gets the tables of the page.
    """
    page = path.read_text(encoding="utf-8") if path.exists() else ""
    heading = re.escape(part.partition("\n")[0])
    former = re.search(rf"^{heading}\n.*?^({FIGURES}[^\n]*)\n", page, re.MULTILINE | re.DOTALL)
    last = f"{FIGURES}{program()}." if not redrawn else former[1] if former else ""
    text = f"{part}\n{last}\n" if last else part
    if former:
        text = page[: former.start()] + text + page[former.end() :]
    elif page and part.startswith("## "):
        text = f"{page}\n{text}"
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
    with atomic_write(path.with_suffix(".tex")) as partial:
        partial.write_text(latex_tables(text), encoding="utf-8")


@cache
def program() -> str:
    """Return the commit of this program with its date, and whether files differ; its version outside of a checkout."""
    # Of the folder alone: a checkout of something else may lie around an installed program.
    commit = _git("log", "-1", "--format=commit %h (%cs)", "--", ".")
    changed = commit and _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
    return (commit or f"vibrocast {version('vibrocast')}") + (", changed since" if changed else "")


def _git(*arguments: str) -> str:
    """Return the output of git in the folder of this program; "" without git or a checkout."""
    command = ["git", "-C", str(_CHECKOUT), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def latex_tables(page: str) -> str:
    """Return the tables of a page of Markdown for LaTeX, each under the title of its section."""
    tables, title = [], ""
    for is_table, group in groupby(page.splitlines(), lambda line: line.startswith("|")):
        lines = list(group)
        if is_table:
            head, rule, *rows = ([_plain(each) for each in _BAR.split(line)[1:-1]] for line in lines)
            tables.append(latex_table(title, head, rows, "".join("r" if each.endswith(":") else "l" for each in rule)))
        else:
            title = next((_plain(line.lstrip("#")) for line in reversed(lines) if line.startswith("#")), title)
    return "\n".join(tables)


_BAR = re.compile(r"(?<!\\)\|")


def _plain(markdown: str) -> str:
    """Return the text of a cell or a title in Markdown: without links, footnotes, code marks, emphasis and escapes."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", markdown)
    return html.unescape(re.sub(r"\[\^[^]]*\]|[`*]|\\(?=[\\|])", "", text)).strip()


def latex_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], columns: str) -> str:
    """Return a table for LaTeX. `columns`: a letter for each, "l" or "r"."""
    first, *others = (" & ".join(map(latex, row)) + r" \\" for row in (head, *rows))
    return "\n".join(
        (
            r"\begin{table}  % needs \usepackage{booktabs}",
            rf"\centering\caption{{{latex(title)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            *(r"\toprule", first, r"\midrule", *others, r"\bottomrule"),
            r"\end{tabular}",
            "\\end{table}\n",
        )
    )


_LATEX = str.maketrans(
    {letter: f"\\{letter}" for letter in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "|": r"\textbar{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "≈": r"$\approx$", "−": "$-$", "²": r"\textsuperscript{2}"}
)
"""Letters that LaTeX reads as commands, or does not know."""


def latex(text: str) -> str:
    """Return text that shows unchanged in LaTeX."""
    return text.translate(_LATEX)


def cell(value: object) -> str:
    """Return text that shows unchanged in a table cell of Markdown, in one line."""
    return " ".join(str(value).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").split())


def code(text: str) -> str:
    """Return a name as code."""
    return f"`{text.replace('`', '')}`"


def codes(names: Iterable[str], last: str = ", ") -> str:
    """Return names as code, in a list. `last`: between the last two."""
    return listed([code(name) for name in names], last)


def counted(number: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def listed(items: Iterable[str], last: str = " and ") -> str:
    """Return items as a person lists them. `last`: between the last two."""
    *others, final = list(items) or [""]
    return last.join(filter(None, (", ".join(others), final)))


def number(value: float | None, form: str = ".3g", unit: str = "") -> str:
    """Return a number in a form of Python's format strings, then its unit; empty for None."""
    return "" if value is None else f"{value:{form}}{unit}"


def g(value: float) -> str:
    """Return a number with its digits, six at most."""
    return f"{value:g}"


def size(count: int | None) -> str:
    """Return a count of bytes in words; empty for None."""
    if count is None:
        return ""
    return f"{count} B" if count < 1000 else f"{count / 1000:.3g} kB" if count < 1_000_000 else f"{count / 1e6:.3g} MB"


FILTERS: dict[str, Any] = {each.__name__: each for each in (cell, code, codes, counted, g, listed, number, size)}
"""Filters of every template."""
