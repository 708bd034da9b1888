"""Finds words that cost a reader: in pages, docstrings, comments, help texts, names of tests and commit subjects.

`python -m tests.words [FILE...]` prints FILE:LINE: problem; passage. The exit code is 1 if there is one. Without FILE
it looks at everything. `python -m tests.words --table [PAGE...]` measures pages instead.
"""

import argparse
import ast
import inspect
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import click
from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
CHANGELOG = "CHANGELOG.md"  # its headings are fixed, and it names what was renamed

LONG_SENTENCE = 25  # words; one sentence in ten may be longer
LONGEST_SENTENCE = 35
LONG_SHARE = 0.1
WORDS_A_HEADING = 120  # of paragraphs; the words of a list count half, those of tables and code do not
LONGEST_STEP = 40  # words of a list item in docs/how-to
MOST_FIGURES = 3  # in a sentence
LONGEST_HELP = 12  # words
LONGEST_SUBJECT = 72  # characters of a commit subject
COMMITS = 30

# A clause with "what" or a similar word, in place of a noun. Indirect questions ("says what it needs") may stay.
WHAT_CLAUSE = re.compile(
    r"\b(?:of|for|from|by|to|with|on|as|in|at|than|about|over|beyond|against|without|between) what\b"
    r"(?! (?:to|extent|degree|order|kind|sort|rate|way)\b)"
    r"|\bthat which\b|^what\b(?! to\b|[^?]*\?)",
    re.IGNORECASE,
)
# The same as an apposition; in pages only.
WHAT_APPOSITION = re.compile(r"[;:,] what\b(?! to\b|[^?]*\?)")

_CLAUSE = r"(?:\w+ ){1,4}?(?:is|are|was|were|has|have|had|does|do|did|can|cannot|must|would|could|will|might)\b"
ODD_WORDS = {
    re.compile(pattern, re.IGNORECASE): advice
    for pattern, advice in {
        r"\btold\b": "name who says it",
        r"\banew\b": "again",
        r"\bdear(?:er|est|ly)?\b": "costly, expensive",
        r"\bbeside\b": "in addition to; of places: next to",
        r"\bso (?:many|much)\b": "give the number, or leave it out",
        r"\bby lot\b": "at random",
        r"\b(?:held|hold|holds|holding) against\b": "compared with",
        r"\bpass(?:ed|es)? off\b": "presented as",
        r"\b(?:is|are|was|were|been|be) tried\b": "tested; name who tests",
        r"\brefus\w+": "reject",
        r"\bone's own\b": "your",
        rf", for (?:it|they|we|there|nothing)\b(?! and\b)|, for (?!(?:which|what|when|where)\b)"
        rf"(?!(?:\w+ ){{0,4}}(?:that|which|who|when|where|if|and|or)\b){_CLAUSE}": "because",
    }.items()
}

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
        r"\b(?:an?|the|each|every|this|other|perceptual) judges?\b": "metric",
        r"\b(?:serial|usb) lines?\b": "link",
        r"\b(?:the|its) (?:playout |default |shortest )?margin\b": "playout delay",
        r"\bflash(?:es|ed|ing)? (?:(?:an?|the|its|your|this|that|each|every) )?models?\b": "upload",
        r"\bnot offered\b": "not applicable",
        r"\btwo takes\b|\banother take\b": "independent realisations",
        r"\b(?:the|an?|its) (?:asked|wanted)\b": "target, required",
    }.items()
}

DECIMAL = re.compile(r"(?<![\w.)\]}/…])\.\d+(?!\w)")

# These are no figures: parts of names, versions, dates, numbers of sections, bits of types.
NOT_FIGURES = re.compile(
    r"\b[A-Za-z]+[-.]?\d[\w.,-]*"  # C99, SHA-256, int16, P1918.1.1, GPL-2.0
    r"|\b(?:IEEE|ISO|IEC|MPEG|ITU-T|RFC|ANSI)\b[ A-Z./]*\d[\w.-]*"
    r"|\b[vV]?\d+\.\d+\.\d+[\w.]*|\b\d{4}-\d\d(?:-\d\d)?\b|\b\d\d:\d\d\b"
    r"|\b(?:Python|NumPy|torch|ONNX|Windows|Linux|Ubuntu|GCC|Clang|Zig|MATLAB|USB|GPL|LGPL|HDF|Cortex"
    r"|(?i:versions?|opset|slots?|ports?|sections?|sec\.|chapters?|figs?\.|figures?|eqs?\.|equations?|tables?|pages?"
    r"|issues?|steps?|lines?|levels?|rows?|appendix|parts?|no\.|bits?))"
    r" \(?\d[\d.]*\)?(?:(?:,| to| and| or) \(?\d[\d.]*\)?)*"
    r"|\b(?:January|February|March|April|May|June|July|August|September|October|November|December) \d{4}"
    r"|\(\d{4}[a-z]?\)|\[\d+\]|(?<=al\. )\d{4}|, (?:19|20)\d\d\b"
    r"|\b\d+-(?:bits?|bytes?)\b|\b\d+(?:st|nd|rd|th)\b|\^-?\d+|\b[\d.]+[A-Za-z_]\w*"
)
_NUMBER = r"\d+(?:[ ,]\d{3})*(?:\.\d+)?(?:e-?\d+)?"
# A range, a share and a product are one figure.
FIGURE = re.compile(rf"{_NUMBER}(?: ?[A-Za-z%/]{{0,6}} ?(?:to|of|of the|or|by|×|x|–|/) ?[-+]?{_NUMBER})?")

# Words with which no imperative begins.
_NO_VERBS = """a an the this that these those such another other some any all each every no none not both one two three
    more fewer less new old now also only of for from in on at as by to with without instead after before while where
    when what which who how why whether if it its your
    address codec codecs csv dask device devices directory duration file files folder folders json largest length
    longest manifest mean models names output parameter parameters passes path seconds shortest signal signal-to-noise
    size smallest speed tests text threads toml unit version wav controller actuator port true false default
    charts figures page pages rates results table tables"""
# Words with which one may begin, unless they are followed by these.
_NOUN = re.compile(
    r"(?:bench|format|level|lines?|list|map|model|name|number|part|plan|rate|sample|seed|value) "
    r"(?:at|file|for|in|of|or|rate|to|that|which)\b",
    re.IGNORECASE,
)
# They end in "ed", "ing" or "s", and are verbs all the same.
_BARE_VERBS = """feed embed shed speed need seed shred exceed proceed succeed bleed weed heed breed
    bring string ring sing swing ping spring wing focus bias canvas process pass guess press express compress
    stress access assess miss cross discuss toss bless dismiss suppress"""
NO_VERBS, BARE_VERBS = frozenset(_NO_VERBS.split()), frozenset(_BARE_VERBS.split())


class Finding(NamedTuple):
    """A place at which a rule is broken; `line` counts from 1, 0 where a thing has no line."""

    path: str
    line: int
    problem: str
    passage: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.problem}; {self.passage}"


class Block(NamedTuple):
    """A run of text: a `paragraph`, a list `item`, a table's `cell`, a `heading` or the `alt` text of a picture.

    Code spans are "`…`". Words of one link are joined by no-break spaces, and so count as one. `unit` is the line of
    the list item that the text belongs to.
    """

    kind: str
    line: int
    text: str
    unit: int = 0


class Sentence(NamedTuple):
    """A sentence of a block, at the line on which it begins; `words` counts links and code spans as one."""

    line: int
    text: str
    words: int


# --- text ------------------------------------------------------------------------------------------------------------

_MARKDOWN = MarkdownIt("commonmark").enable("table")
_PLAIN = MarkdownIt("commonmark").enable("table").disable(["code", "html_block", "heading", "lheading", "hr"])
_CONTAINER = re.compile(r"( *)(?:!!!|\?\?\?\+?|===) ")
_ABBREVIATION = re.compile(r"(?:\b(?:e\.g|i\.e|vs|cf|al|approx|resp|etc|Figs?|Eqs?|Sec|No|Dr)|\.\.|…)\.?$")


def _flat(text: str) -> str:
    """Return Markdown with the contents of admonitions and tabs at the level of the text around them, line by line."""
    lines, indents = [], []  # type: list[str], list[int]
    for line in text.splitlines():
        while indents and line.strip() and len(line) - len(line.lstrip()) <= indents[-1]:
            indents.pop()
        container = _CONTAINER.match(line)
        if container:
            indents.append(len(container[1]))
            lines.append("")
        else:
            lines.append(line[min(4 * len(indents), len(line) - len(line.lstrip())) :])
    return "\n".join(lines)


def _inline(token: Token) -> Iterator[tuple[str, str]]:
    """Yield the text of an inline token, and the alt texts of its pictures, each with its kind."""
    text, linked = "", 0
    for child in token.children or []:
        if child.type == "image":
            yield "alt", child.content
        elif child.type in ("link_open", "link_close"):
            linked += 1 if child.type == "link_open" else -1
        elif child.type == "code_inline":
            text += "`…`"
        elif child.type in ("softbreak", "hardbreak"):
            text += "\n"
        elif child.type == "html_inline":
            text += "\n" * child.content.count("\n")
        elif child.type == "text":
            text += child.content.replace(" ", "\xa0") if linked else child.content
    yield "text", text


def blocks(text: str, markdown: MarkdownIt = _MARKDOWN) -> Iterator[Block]:
    """Yield the blocks of a Markdown text; code, HTML and directives of the site's extensions are left out."""
    items: list[int] = []
    kind = ""
    for token in markdown.parse(text):
        line = token.map[0] + 1 if token.map else 0
        if token.type == "list_item_open":
            items.append(line)
        elif token.type == "list_item_close":
            items.pop()
        elif token.type in ("heading_open", "td_open", "th_open", "paragraph_open"):
            kind = {"h": "heading", "t": "cell", "p": "item" if items else "paragraph"}[token.tag[0]]
        elif token.type == "inline" and not token.content.startswith((":::", "--8<--")):
            for part, content in _inline(token):
                if content.strip():
                    yield Block(kind if part == "text" else part, line, content, items[-1] if items else 0)


def page_blocks(text: str) -> list[Block]:
    """Return the blocks of a page."""
    return list(blocks(_flat(text)))


def _spaced(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


def count_words(text: str) -> int:
    """Return how many words a text has; a sign between spaces is none, a number and its unit are two."""
    return sum(1 for word in re.split(r"[ \n\t]+", text) if re.search(r"[\w…]", word))


def sentences(block: Block) -> list[Sentence]:
    """Split a block into sentences."""
    found, start = [], 0
    for end in re.finditer(r"[.!?][\"'”’)*]*(?=\s)|$(?![\n])", block.text):
        before = block.text[start : end.start()]
        rest = block.text[end.end() :].lstrip()
        if rest and (_ABBREVIATION.search(before) or not re.match(r"[\w\"'“‘(`\[+-]", rest)):
            continue
        text = block.text[start : end.end()]
        if text.strip():
            begin = start + len(text) - len(text.lstrip())
            found.append(Sentence(block.line + block.text.count("\n", 0, begin), _spaced(text), count_words(text)))
        start = end.end()
    return found


def count_figures(sentence: str) -> int:
    """Return how many figures a sentence states; names, versions, dates and numbers of sections are none."""
    return len(FIGURE.findall(NOT_FIGURES.sub(" ", sentence)))


# --- rules -----------------------------------------------------------------------------------------------------------


def _around(text: str, start: int = 0, end: int = 0) -> str:
    """Return the place of a hit in a text, or the beginning of the text, in one line."""
    left, right = max(0, start - 40), max(end + 40, start + 90)
    return f"{'...' if left else ''}{_spaced(text[left:right])}{'...' if right < len(text) else ''}"


def _patterns(path: str, block: Block, patterns: Iterable[tuple[re.Pattern[str], str]]) -> Iterator[Finding]:
    # Of the same length as the block's text, for the lines.
    text = re.sub(r"\s", " ", block.text)
    for pattern, problem in patterns:
        for hit in pattern.finditer(text):
            line = block.line + block.text[: hit.start()].count("\n")
            yield Finding(path, line, problem.format(hit[0].strip(" ,")), _around(text, *hit.span()))


ODD = [(pattern, f'do not write "{{}}": {advice}') for pattern, advice in ODD_WORDS.items()]
RETIRED = [(pattern, f'"{{}}" is a retired term: {term}') for pattern, term in RETIRED_TERMS.items()]
ZERO = [(DECIMAL, "write {} with its leading zero")]


def _sentence_findings(path: str, block: Block, *clauses: re.Pattern[str]) -> Iterator[Finding]:
    """Yield the sentences of a block that are too long, or in which one of the clauses stands for a noun."""
    for line, text, words in sentences(block):
        if words > LONGEST_SENTENCE:
            yield Finding(path, line, f"sentence of {words} words", _around(text))
        hit = next(filter(None, (clause.search(text) for clause in clauses)), None)
        if hit and not text.endswith("?"):
            yield Finding(path, line, f'write a noun for "{hit[0].strip(" ,;:")} ..."', _around(text, *hit.span()))


def page_findings(path: str, text: str) -> list[Finding]:
    """Return what is wrong with a page; `path` is relative to the checkout, with slashes."""
    found: list[Finding] = []
    counted: list[Sentence] = []
    items: dict[int, int] = {}
    section, prose, avoided = 1, 0.0, False

    def end_section() -> None:
        if prose > WORDS_A_HEADING and path != CHANGELOG:
            words = f"{prose:.0f} words without a heading (at most {WORDS_A_HEADING}; lists count half)"
            found.append(Finding(path, section, words, "divide, shorten, or make a table"))

    for block in page_blocks(text):
        if block.kind == "heading":
            end_section()
            section, prose = block.line, 0.0
            avoided = block.text.strip().lower() == "words to avoid"
        if avoided:
            continue
        found += _patterns(path, block, [*ODD, *ZERO, *([] if path == CHANGELOG else RETIRED)])
        if block.kind not in ("paragraph", "item"):
            continue
        words = count_words(block.text)
        prose += words / 2 if block.kind == "item" else words
        if block.unit:
            items[block.unit] = items.get(block.unit, 0) + words
        found += _sentence_findings(path, block, WHAT_CLAUSE, WHAT_APPOSITION)
        for sentence in sentences(block):
            counted.append(sentence)
            figures = count_figures(sentence.text)
            if figures > MOST_FIGURES:
                found.append(Finding(path, sentence.line, f"{figures} figures in a sentence", _around(sentence.text)))
    end_section()
    long = [sentence for sentence in counted if sentence.words > LONG_SENTENCE]
    if len(long) > max(1, LONG_SHARE * len(counted)):
        share = f"{len(long)} of {len(counted)} sentences over {LONG_SENTENCE} words (at most a tenth)"
        found.append(Finding(path, 1, share, f"lines {', '.join(str(sentence.line) for sentence in long)}"))
    if path.startswith("docs/how-to/"):
        found += [
            Finding(path, line, f"list item of {words} words (at most {LONGEST_STEP})", "shorten, or divide")
            for line, words in items.items()
            if words > LONGEST_STEP
        ]
    return sorted(found, key=lambda finding: finding.line)


def _plain_findings(path: str, line: int, text: str) -> Iterator[Finding]:
    """Yield what is wrong with a docstring or a comment that begins at `line`."""
    for block in blocks(text, _PLAIN):
        moved = block._replace(line=block.line + line - 1)
        yield from _sentence_findings(path, moved, WHAT_CLAUSE)
        yield from _patterns(path, moved, [*ODD, *ZERO])


_PRAGMA = re.compile(r"#\s*(?:type:|noqa|mypy:|ruff:|pragma|!)|^#$")


def _comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield each comment of a Python source and its line; comments on lines that follow each other are one."""
    held: list[str] = []
    first, last, column = 0, 0, 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        alone = not token.line[: token.start[1]].strip()
        if held and not (alone and token.start == (last + 1, column)):
            yield first, "\n".join(held)
            held = []
        if _PRAGMA.match(token.string):
            continue
        first = first if held else token.start[0]
        last, column = token.start[0] if alone else -1, token.start[1]
        held.append(token.string.lstrip("#").strip())
    if held:
        yield first, "\n".join(held)


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and the statements in it; expressions hold no docstring, and are most of a tree."""
    yield node
    for field in ("body", "orelse", "finalbody", "handlers"):
        below = getattr(node, field, None)
        for each in below if isinstance(below, list) else []:
            yield from _statements(each)


def python_findings(path: str, source: str) -> list[Finding]:
    """Return what is wrong with the docstrings, comments and names of tests of a Python source."""
    found: list[Finding] = []
    for node in _statements(ast.parse(source)):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if node.body and isinstance(node.body[0], ast.Expr):
            value = node.body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                found += _plain_findings(path, value.lineno, inspect.cleandoc(value.value))
        if not isinstance(node, ast.Module) and node.name.lower().startswith("test"):
            name = Block("name", node.lineno, node.name.replace("_", " "))
            found += _patterns(path, name, RETIRED)
    if "#" in source:
        for line, text in _comments(source):
            found += _plain_findings(path, line, text)
    return sorted(found, key=lambda finding: finding.line)


# Strings and characters are matched first, so that none of their content counts as a comment.
_C_COMMENT = re.compile(
    r"\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'|(/\*.*?\*/|//[^\n]*(?:\n[ \t]*//[^\n]*)*)", re.DOTALL
)


def c_findings(path: str, source: str) -> list[Finding]:
    """Return what is wrong with the comments of a C source."""
    found: list[Finding] = []
    for comment in _C_COMMENT.finditer(source):
        if comment[1] is None or "clang-format" in comment[1]:
            continue
        lines = [re.sub(r"^\s*(?:/\*+|//+|\*(?!/))?\s?|\s*\*+/$", "", line) for line in comment[1].splitlines()]
        line = source.count("\n", 0, comment.start()) + 1
        found += _plain_findings(path, line, "\n".join(each.strip() for each in lines))
    return sorted(found, key=lambda finding: finding.line)


def _without_verb(text: str) -> bool:
    """Return whether a text begins with a word that is no verb in the imperative."""
    word = (re.match(r"[\w'-]+", text) or [""])[0].lower()
    other_form = word not in BARE_VERBS and re.search(r"(?:ing|ed|[^s]s)$", word) is not None
    return word in NO_VERBS or other_form or _NOUN.match(text) is not None


def help_findings(command: click.Command, name: str, path: str = "host/cli") -> list[Finding]:
    """Return what is wrong with the help of a command, of its options and of its subcommands, each text once."""
    found: dict[tuple[str, str], Finding] = {}

    def report(owner: str, line: int, where: str, problem: str, passage: str) -> None:
        found.setdefault((problem, passage), Finding(where, line, f"{owner}: {problem}", passage))

    def check(owner: str, text: str, where: str, line: int) -> list[Sentence]:
        parts = sentences(Block("help", 1, text))
        opening = parts[0].text
        if parts[0].words > LONGEST_HELP:
            report(owner, line, where, f"first sentence of {parts[0].words} words (at most {LONGEST_HELP})", opening)
        if not opening[0].isupper():
            report(owner, line, where, "begin with a capital letter", opening)
        elif _without_verb(opening):
            report(owner, line, where, "begin with a verb", opening)
        for finding in _plain_findings(where, line, text):
            report(owner, line, where, finding.problem, finding.passage)
        for finding in _patterns(where, Block("help", line, text), RETIRED):
            report(owner, line, where, finding.problem, finding.passage)
        return parts

    def walk(command: click.Command, name: str) -> None:
        where, line = path, 0
        if command.callback is not None:
            code = inspect.unwrap(command.callback).__code__
            where, line = Path(code.co_filename).resolve().relative_to(ROOT.resolve()).as_posix(), code.co_firstlineno
        if command.help and command.help.strip():
            check(name, inspect.cleandoc(command.help).split("\f")[0], where, line)
        else:
            report(name, line, where, "no help", name)
        shown = bool(command.context_settings.get("show_default"))
        for option in command.params:
            if not isinstance(option, click.Option) or option.hidden:
                continue
            owner = f"{name} {option.opts[0]}"
            if not option.help:
                report(owner, line, where, "no help", owner)
                continue
            parts = check(owner, option.help, where, line)
            rest = [part.text for part in parts[1:] if not part.text.startswith("Default:")]
            if rest:
                report(owner, line, where, 'after the first sentence only "Default: ..." may follow', " ".join(rest))
            stated = option.show_default or shown or "Default:" in option.help
            default = option.to_info_dict()["default"]
            if not stated and not option.is_flag and not option.required and default not in (None, ()):
                report(owner, line, where, "state the default", option.help)
            if re.search(r"\bif (?:not given|neither|none)\b", option.help):
                report(owner, line, where, 'state the default as "Default: ..."', option.help)
        if isinstance(command, click.Group):
            context = click.Context(command, info_name=name)
            for each in command.list_commands(context):
                subcommand = command.get_command(context, each)
                if subcommand is not None and not subcommand.hidden:
                    walk(subcommand, f"{name} {each}")

    walk(command, name)
    return list(found.values())


def subject_findings(subjects: Iterable[str]) -> list[Finding]:
    """Return what is wrong with commit subjects."""
    found = []
    for subject in subjects:
        if len(subject) > LONGEST_SUBJECT:
            found.append(Finding("commit", 0, f"subject of {len(subject)} characters", subject))
        if not subject[:1].isupper() or subject.endswith("."):
            found.append(Finding("commit", 0, "begin with a capital letter, end without a full stop", subject))
        elif _without_verb(subject):
            found.append(Finding("commit", 0, "write the subject as an imperative", subject))
    return found


# --- the checkout ----------------------------------------------------------------------------------------------------


def pages() -> list[str]:
    """Return the paths of all pages, relative to the checkout."""
    patterns = (
        "README.md",
        "CONTRIBUTING.md",
        "SECURITY.md",
        "CHANGELOG.md",
        "docs/**/*.md",
        "[!.]*/README.md",
        "models/*/*.md",
    )
    found = {path for pattern in patterns for path in ROOT.glob(pattern)}
    return sorted(
        path.relative_to(ROOT).as_posix() for path in found if "vibrocast" not in path.relative_to(ROOT).parts
    )


def _git(*arguments: str) -> list[str]:
    """Return the lines that git prints; none where git or its data are missing."""
    try:
        printed = subprocess.run(
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True, encoding="utf-8", check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return []
    return printed.stdout.splitlines()


def sources() -> list[str]:
    """Return the paths of the Python and C sources that git knows or would add, relative to the checkout."""
    own = "*.py", "firmware/*.c", "firmware/*.h"
    listed = _git("ls-files", "--cached", "--others", "--exclude-standard", *own)
    return sorted({path for path in listed if (ROOT / path).is_file()})


def subjects(count: int = COMMITS) -> list[str]:
    """Return the subjects of the last commits, without merges; none where git or its data are missing."""
    return _git("log", "--no-merges", f"--max-count={count}", "--format=%s")


def findings(path: str) -> list[Finding]:
    """Return what is wrong with a file, by its suffix."""
    text = (ROOT / path).read_text(encoding="utf-8")
    suffix = Path(path).suffix
    check = {".py": python_findings, ".c": c_findings, ".h": c_findings}.get(suffix, page_findings)
    return check(path, text)


def measures(text: str) -> dict[str, float]:
    """Return the measures of a page: see `--table`."""
    found = [block for block in page_blocks(text) if block.kind in ("paragraph", "item")]
    prose = [sentence for block in found for sentence in sentences(block)]
    headings = sum(block.kind == "heading" for block in page_blocks(text))
    words = sum(sentence.words for sentence in prose)
    each = {
        name: sum(len(re.findall(rf"\b{name}r?\b", s.text, re.IGNORECASE)) for s in prose if not s.text.endswith("?"))
        for name in ("what", "you")
    }
    return {
        "words": words,
        "a sentence": words / max(1, len(prose)),
        "over 25, %": 100 * sum(s.words > LONG_SENTENCE for s in prose) / max(1, len(prose)),
        "a heading": words / max(1, headings),
        "what, 1/1000": 1000 * each["what"] / max(1, words),
        "you, 1/1000": 1000 * each["you"] / max(1, words),
        "longest": max((s.words for s in prose), default=0),
    }


def table(paths: Sequence[str]) -> str:
    """Return a table in Markdown: a page a row."""
    rows = [(path, measures((ROOT / path).read_text(encoding="utf-8"))) for path in paths]
    if not rows:
        return ""
    names = list(rows[0][1])
    digits = {"a sentence": 1, "what, 1/1000": 1, "you, 1/1000": 1}
    lines = [f"| page | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
    lines += [f"| {path} | {' | '.join(f'{row[n]:.{digits.get(n, 0)}f}' for n in names)} |" for path, row in rows]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the findings, or the table; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.words", description="Look for words that cost a reader.")
    parser.add_argument("files", nargs="*", metavar="FILE", help="Look at these files. Default: all, help and commits.")
    parser.add_argument("--table", action="store_true", help="Measure pages instead.")
    given = parser.parse_args(arguments)
    files = [Path(name).resolve().relative_to(ROOT.resolve()).as_posix() for name in given.files]
    if given.table:
        print(table(files or pages()))
        return 0
    found = [finding for path in files or [*pages(), *sources()] for finding in findings(path)]
    if not files:
        from vibrocast.host.cli.command_line import main as command_line

        found += help_findings(command_line, "vibrocast") + subject_findings(subjects())
    for finding in found:
        print(finding)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
