"""Pages, docstrings, comments, help texts and commit subjects keep the rules of plain words: see tests/words.py."""

from pathlib import Path

import click
import pytest

from tests import words
from vibrocast.host.cli.command_line import main as command_line

SHOWN = 20  # findings of a test that fails

FOLDERS = sorted({path.partition("/")[0] for path in words.sources()})


def listing(found: list[words.Finding]) -> str:
    """Return the first findings, a line each."""
    more = [f"... and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join(["", *map(str, found[:SHOWN]), *more])


@pytest.mark.parametrize("page", words.pages())
def test_a_page_keeps_the_rules(page: str) -> None:
    found = words.findings(page)
    assert not found, listing(found)


@pytest.mark.parametrize("folder", FOLDERS)
def test_docstrings_comments_and_names_of_tests_keep_the_rules(folder: str) -> None:
    paths = [path for path in words.sources() if path.partition("/")[0] == folder]
    found = [finding for path in paths for finding in words.findings(path)]
    assert not found, listing(found)


def test_help_texts_keep_the_rules() -> None:
    found = words.help_findings(command_line, "vibrocast")
    assert not found, listing(found)


def test_commit_subjects_are_short_imperatives() -> None:
    subjects = words.subjects()
    if not subjects:
        pytest.skip("no git, or no history")
    found = words.subject_findings(subjects)
    assert not found, listing(found)


LONG = "One word after another " * 8
MENDED = "docs/how-to/page.md"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (f"{LONG}{LONG}.", "sentence of 64 words"),
        (f"{LONG}.\n\n{LONG}.\n\nShort.", "2 of 3 sentences over 25 words"),
        ("# Page\n\n" + "Ten short words are in this sentence, I am sure. " * 13, "130 words without a heading"),
        ("- " + "Ten short words are in this sentence, I am sure. " * 5, "list item of 50 words"),
        ("It tells of what is rejected.", 'write a noun for "of what ..."'),
        ("It ends. What fails is listed.", 'write a noun for "What ..."'),
        ("The rule: what fails is listed.", 'write a noun for "what ..."'),
        ("That which fails is listed.", 'write a noun for "That which ..."'),
        ("At 1, 2, 3 and 4.5 s it stops.", "4 figures in a sentence"),
        ("It takes .3 % more.", "write .3 with its leading zero"),
        ("| a |\n|---|\n| .3 |", "write .3 with its leading zero"),
        ("The controller\nrefused it.", 'do not write "refused"'),
        ("It waits, for the link is slow.", 'do not write "for the link is"'),
        ("# A tactor", '"tactor" is a retired term: actuator'),
        ("See [the ladder](page.md).", '"ladder" is a retired term'),
        ('!!! note "Title"\n    It is told.', 'do not write "told"'),
        ('=== "Tab"\n\n    It is told.\n\nIt ends.', 'do not write "told"'),
    ],
)
def test_a_page_that_breaks_a_rule_is_found(text: str, problem: str) -> None:
    found = words.page_findings(MENDED, text)
    assert [each.problem.startswith(problem) for each in found] == [True], found


@pytest.mark.parametrize(
    "text",
    [
        "Read what it says, e.g. in Fig. 3, and decide what to do.",
        "What does it say?",
        "IEEE 1918.1.1, MPEG 23090-31, C99, Python 3.11, section 4.2 and 0.1.0 are names of 2026-11-01.",
        "From 1 to 2 s, 3 of 4 and 10 000 are three figures.",
        "`.3 = what was told` is code, and so is this:\n\n```\nrefused\n```\n",
        "A comment <!-- is told --> is none, nor is a path such as ../x.3gp or a name such as .7z.",
        "It takes a list, for the first packet that has one.",
        f"A [{'link of many words ' * 20}](page.md) is one word.",
        "A sentence ends. `another` begins (with brackets). Then (a third.) It is short. " * 3,
        "::: vibrocast.codec\n    options: that which is told",
    ],
)
def test_a_page_that_keeps_the_rules_passes(text: str) -> None:
    assert words.page_findings("docs/page.md", text) == []


def test_a_finding_names_its_line() -> None:
    text = "# Page\n\nFine. One more\nline. It was\ntold so.\n\n| a |\n|---|\n| anew |\n"
    assert [each.line for each in words.page_findings("page.md", text)] == [5, 9]
    assert str(words.page_findings("page.md", text)[1]) == 'page.md:9: do not write "anew": again; anew'


SOURCE = '''"""Fine."""

# It is
# told.
x = "told"  # and refused


def test_a_tactor() -> None:
    """Fine.

    The rest of what it does.
    """
'''


def test_docstrings_comments_and_names_of_tests_are_read() -> None:
    found = words.python_findings("a.py", SOURCE)
    assert [(each.line, each.problem.partition(":")[0]) for each in found] == [
        (4, 'do not write "told"'),
        (5, 'do not write "refused"'),
        (8, '"tactor" is a retired term'),
        (11, 'write a noun for "of what ..."'),
    ]


def test_comments_in_c_are_read() -> None:
    source = '/* Fine.\n * It is told. */\nchar *x = "/* told */"; // .5 of it\n// refused\n'
    found = words.c_findings("a.c", source)
    assert [(each.line, each.problem.partition(":")[0]) for each in found] == [
        (2, 'do not write "told"'),
        (3, "write .5 with its leading zero"),
        (4, 'do not write "refused"'),
    ]


@click.group(help="Do things.")
def group() -> None: ...


@group.command(help="Play a recording.\n\nA longer text may follow it.")
@click.option("--fine", default=3, show_default=True, help="Set the number of passes.")
@click.option("--stated", default=4, help="Set the seed. Default: 4.")
@click.option("--flag", is_flag=True, help="Print JSON.")
@click.option("--none")
@click.option("--noun", help="Of its clock.")
@click.option("--small", help="measure it.")
@click.option("--default", default=5, help="Set the delay.")
@click.option("--implied", help="Set the codec, mdct if not given.")
@click.option("--long", help="Set a very long list of all the words that one could ever want here.")
@click.option("--more", help="Set it. And then there is more.")
def play(**_options: object) -> None: ...


def test_help_texts_are_read() -> None:
    assert [each.problem for each in words.help_findings(group, "x")] == [
        "x play --none: no help",
        "x play --noun: begin with a verb",
        "x play --small: begin with a capital letter",
        "x play --default: state the default",
        'x play --implied: state the default as "Default: ..."',
        "x play --long: first sentence of 15 words (at most 12)",
        'x play --more: after the first sentence only "Default: ..." may follow',
    ]


@pytest.mark.parametrize(
    ("subject", "fine"),
    [
        ("Reject a Configure that names no codec", True),
        ("Process each packet once", True),
        ("Plan live streams", True),
        ("Plan of live streams", False),
        ("Rejects a Configure", False),
        ("Rejected a Configure", False),
        ("The controller rejects", False),
        ("reject it", False),
        ("Reject it.", False),
        (f"Reject {'x' * 70}", False),
    ],
)
def test_a_subject_is_read(subject: str, fine: bool) -> None:
    assert (words.subject_findings([subject]) == []) == fine


def test_the_command_prints_findings_and_the_table(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(words, "ROOT", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("# Page\n\nYou see what it is. It is told.\n")
    assert words.main([str(page)]) == 1
    assert (
        capsys.readouterr().out == 'page.md:3: do not write "told": name who says it; You see what it is. It is told.\n'
    )
    assert words.main(["--table", str(page)]) == 0
    assert capsys.readouterr().out.splitlines()[2] == "| page.md | 8 | 4.0 | 0 | 8 | 125.0 | 125.0 | 5 |"
    page.write_text("# Page\n\nYou see it.\n")
    assert words.main([str(page)]) == 0
