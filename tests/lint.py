"""Checks of words and quoted figures: `python -m tests.lint [FILE...]` prints FILE:LINE: problem; passage.

Without FILE it looks at all pages, docstrings and comments in C, at help texts, and at the figures
that docs/quoted_figures.toml lists. The exit code is 1 if there is a finding.
"""

import ast
import csv
import inspect
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
from markdown_it import MarkdownIt

from vibrocast.host.cli.command_line import main as command_line

ROOT = Path(__file__).parents[1]
QUOTED = "docs/quoted_figures.toml"
LONGEST_SENTENCE = 35  # words

# From the table "Words to avoid" of docs/reference/glossary.md: those that a pattern can tell from their other uses.
RETIRED_TERMS = {
    re.compile(pattern, re.IGNORECASE): term
    for pattern, term in {
        r"\btactor controllers?\b": "controller",
        r"\btactors?\b(?! controller)": "actuator",
        r"\b(?:ladders?|rungs?)\b": "rate points, rate point",
        r"\bthrift\b": "rd-weight",
        r"\bcoarseness\b": "quantiser offset",
        r"\bsteer(?:s|ed|ing)?\b": "rate control",
        r"\brefresh packets?\b": "random-access packet",
        r"(?<!leaky )\bbuckets?\b": "rate buffer",
        r"\b(?:serial|usb) lines?\b": "link",
        r"\bnot offered\b": "not applicable",
        r"\b(?:the|an?|its) (?:asked|wanted)\b": "target, required",
    }.items()
}
NO_LEADING_ZERO = re.compile(r"(?<![\w.)\]}/…])\.\d+(?!\w)")
END_OF_SENTENCE = re.compile(r"(?<=[.!?])[\"')*]*\s+")
FIGURE = re.compile(r"([-+]?)(\d+(?:\.\d+)?)( kB)?[ %]*$")

_MARKDOWN = MarkdownIt("commonmark").enable("table").disable(["code", "html_block"])


def sentences(text: str) -> list[str]:
    """Split a text without markup into sentences."""
    return END_OF_SENTENCE.split(text.strip())


def count_words(text: str) -> int:
    """Return how many words a text has; a sign between spaces is none, a number and its unit are two."""
    return len(re.findall(r"\S*[\w…]\S*", text))


def text_findings(path: str, line: int, text: str, retired: bool = True) -> Iterator[str]:
    """Yield the findings of a text in Markdown that begins at a line of a file. `retired`: look for retired terms."""
    cell = False
    for token in _MARKDOWN.parse(text.partition("\n## Words to avoid")[0]):
        if token.type != "inline":
            cell = token.tag in ("td", "th")
            continue
        replaced = {"text": "", "code_inline": "…", "softbreak": " "}  # "": by its content
        parts = [each for each in token.children or [] if each.type in replaced]
        words = "".join(replaced[each.type] or each.content for each in parts)
        where = f"{path}:{line + (token.map or [0])[0]}"
        for sentence in sentences(words) if not cell else ():
            if count_words(sentence) > LONGEST_SENTENCE:
                yield f"{where}: sentence of {count_words(sentence)} words; {sentence}"
        for hit in NO_LEADING_ZERO.finditer(words):
            yield f"{where}: write {hit[0]} with its leading zero; {words[:100]}"
        for pattern, term in RETIRED_TERMS.items() if retired else ():
            for hit in pattern.finditer(words):
                yield f'{where}: "{hit[0]}" is a retired term: {term}; {words[:100]}'


def file_findings(path: str) -> Iterator[str]:
    """Yield the findings of a page, of the docstrings of a Python source, or of the comments of a C source."""
    text = (ROOT / path).read_text(encoding="utf-8")
    if path.endswith(".md"):
        yield from text_findings(path, 1, text)
    elif path.endswith(".py"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                docstring = ast.get_docstring(node)
                if docstring:
                    yield from text_findings(path, node.body[0].lineno, docstring, retired=False)
    else:
        for comment in re.finditer(r"/\*(.*?)\*/", text, re.DOTALL):
            line = text.count("\n", 0, comment.start()) + 1
            yield from text_findings(path, line, re.sub(r"^ *\* ?", "", comment[1], flags=re.MULTILINE), retired=False)


def help_findings(command: click.Command, name: str) -> Iterator[str]:
    """Yield the findings of the help of a command, of its options and of its subcommands."""
    options = [each for each in command.params if isinstance(each, click.Option) and not each.hidden]
    for owner, text in {name: command.help, **{f"{name} {each.opts[0]}": each.help for each in options}}.items():
        yield from text_findings(owner, 0, inspect.cleandoc(text or ""))
    if isinstance(command, click.Group):
        context = click.Context(command)
        for each in command.list_commands(context):
            below = command.get_command(context, each)
            if below is not None and not below.hidden:
                yield from help_findings(below, f"{name} {each}")


def figure_findings(page: str, text: str, table: str, row: dict[str, str], column: str) -> Iterator[str]:
    """Yield the findings of one entry of docs/quoted_figures.toml.

    `text` ends with a figure and its unit, and stands in the page once. The figure is rounded as it stands there. One
    without a sign stands for either, as in "16 % fewer". `row`: values of the table's columns that name one row.
    """
    content = (ROOT / page).read_text(encoding="utf-8")
    count = len(re.findall(re.escape(text) + r"(?!\.?\d)", content))
    with (ROOT / table).open(newline="", encoding="utf-8") as file:
        rows = [each for each in csv.DictReader(file) if row.items() <= each.items()]
    quoted = FIGURE.search(text)
    if count != 1 or quoted is None or len(rows) != 1:
        yield f"{page}:0: text found {count} times, {len(rows)} rows of {table}, {QUOTED} must name one of each; {text}"
        return
    sign, digits, kilobytes = quoted.groups()
    measured = float(rows[0][column]) / (1000 if kilobytes else 1)
    rounded = f"{measured:+.{len(digits.partition('.')[2])}f}"
    if rounded[1:] != digits or sign not in ("", rounded[0]):
        yield f"{page}:{content[: content.index(text)].count(chr(10)) + 1}: {table} has {rounded}; {text}"


def git(*arguments: str) -> list[str]:
    """Return the lines that git prints. Raises CalledProcessError outside a git checkout."""
    printed = subprocess.run(["git", *arguments], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return printed.stdout.splitlines()


def tracked(*patterns: str) -> list[str]:
    """Return the files that git knows or would add, relative to the checkout."""
    listed = git("ls-files", "--cached", "--others", "--exclude-standard", *patterns)
    return [path for path in listed if (ROOT / path).is_file()]


def findings(files: list[str]) -> Iterator[str]:
    """Yield the findings of files, whose paths are relative to the checkout; of everything without files."""
    for path in files or tracked("*.md", "*.py", "firmware/*.[ch]"):
        yield from file_findings(path)
    for page, quoted in tomllib.loads((ROOT / QUOTED).read_text(encoding="utf-8")).items():
        for each in quoted if page in files or not files else ():
            yield from figure_findings(page, **each)
    if not files:
        yield from help_findings(command_line, "vibrocast")


def main(arguments: list[str]) -> int:
    """Print the findings, and return the exit code."""
    found = list(findings([Path(name).resolve().relative_to(ROOT).as_posix() for name in arguments]))
    for finding in found:
        print(finding)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
