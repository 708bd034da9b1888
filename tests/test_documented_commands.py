"""Every command block of every page runs and prints what the page shows.

A ```console block holds commands, each after `$ `; a `\\` at the end continues a line, and the lines below a command
are its output. A ```python block is code, and a ```text block directly below is its output. All blocks of a page share
one folder and one namespace. The titles in MARKS name blocks that cannot run here: only the options of their
`vibrocast` commands are looked up.

- `COMMAND &` runs until `kill %1` or the end of the page. Its first line of output is awaited. Where the page shows
  that line, such as an address, later commands get the real one in its place.
- `make` must have the target, and `pip` the extra. `pip install ./FOLDER` installs for this page alone. `pytest`
  collects the tests and runs none. The commands in ACCEPTED do not run: the folder is prepared.
- A command fails if, and only if, the page shows a line that begins with `error:`, and that line must be the same.
- Where the page shows output, all of it must be there, word by word. `...` stands for any text, on a line by itself
  for any lines. Numbers may differ behind `train` alone: the weights of a training differ by processor.
"""

import contextlib
import io
import itertools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import pytest
from markdown_it import MarkdownIt

from vibrocast.errors import HOST_BUSY, LIMIT_MISSED
from vibrocast.host.cli.command_line import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs/**/*.md", "*/README.md")
    for path in ROOT.glob(pattern)
    if path.parent != ROOT / "docs/benchmarks/results"  # parts of generated pages
)
MARKS = tuple(f'title="needs {thing}"' for thing in ("data", "hardware", "other programs"))
ACCEPTED = re.compile(r"(cd|git clone|source|python3? -m venv)\b")
TIMEOUT_S = 300
"""Of one command."""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
ON_STDERR = ("error:", "warning:", "note:")


class Session:
    """The folder, the background commands and the Python names of a page."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._background: dict[str, subprocess.Popen[str]] = {}
        self._printed: dict[str, str] = {}  # the line that the page shows: the line printed here
        self._trained = False
        self._names: dict[str, Any] = {"__name__": "__main__"}
        shutil.copytree(ROOT / "examples", folder / "examples")
        for name in ("firmware", "models", "tests"):
            (folder / name).symlink_to(ROOT / name)
        (folder / ".venv").symlink_to(sys.prefix)
        packages = str(folder / "packages")
        pip = {"TARGET": packages, "NO_BUILD_ISOLATION": "0", "NO_DEPS": "1", "NO_INDEX": "1"}
        self._environment = {
            **os.environ,
            **{f"PIP_{name}": value for name, value in pip.items()},
            "COLUMNS": "120",
            "MPLBACKEND": "Agg",
            "NO_COLOR": "1",
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "PYTHONPATH": os.pathsep.join([str(ROOT), packages]),
        }

    def close(self) -> None:
        """End the commands in the background."""
        for process in self._background.values():
            end(process)

    def command(self, text: str, shown: Sequence[str]) -> None:
        """Run a command, and compare what it prints with the lines that the page shows."""
        text, shown = self._as_printed(text), [self._as_printed(line) for line in shown]
        words = shlex.split(text.replace("\\\n", " "), comments=True)
        if words[0] == "kill":
            end(self._background.pop(words[1]))
        elif words[-1] == "&":
            self._start(text.rstrip(" &"), shown)
        elif words[0] == "make":
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert {word for word in words[1:] if "=" not in word} <= set(targets), text
        elif "install" in words and re.search(r"\bpipx?$", words[words.index("install") - 1]):
            extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
            named = re.fullmatch(r"\.\[([\w,]+)\]", words[-1])
            assert named is None or set(named[1].split(",")) <= set(extras), text
            if words[-1].startswith("./"):
                self._run(f"python -m pip install --quiet {words[-1]}", [])
        elif any(word.endswith("pytest") for word in words):
            self._run(f"{shlex.join([*words, '--collect-only', '-q'])} || test $? = 5", [])  # 5: there are no tests
        elif not ACCEPTED.match(text):
            self._run(text, shown)

    def python(self, code: str, shown: Sequence[str]) -> None:
        """Run a block of Python in this process, and compare what it prints with the lines below it."""
        printed = io.StringIO()
        with contextlib.chdir(self._folder), contextlib.redirect_stdout(printed):
            exec(compile(self._as_printed(code), "a block of the page", "exec"), self._names)
        if shown:
            compare(shown, printed.getvalue(), exact=not self._trained)

    def _as_printed(self, text: str) -> str:
        for shown, printed in self._printed.items():
            text = text.replace(shown, printed)
        return text

    def _start(self, text: str, shown: Sequence[str]) -> None:
        process = self._open(f"exec {text}", stderr=subprocess.DEVNULL)
        self._background[f"%{len(self._background) + 1}"] = process
        assert process.stdout is not None
        printed = process.stdout.readline().rstrip("\n")
        assert printed, f"{text}: ended without a line of output"
        if shown:
            assert printed.partition(":")[0] == shown[0].partition(":")[0], f"{text}: printed {printed}"
            self._printed[shown[0]] = printed

    def _run(self, text: str, shown: Sequence[str]) -> None:
        process = self._open(f"set -o pipefail\n{text}", stderr=subprocess.PIPE)
        printed, errors = process.communicate()
        must_fail = any(line.startswith("error:") for line in shown)
        code = process.returncode
        if code == HOST_BUSY or (code == LIMIT_MISSED and "lost_percent" in errors):
            return  # this machine is too busy for real time, of which the page does not speak
        assert must_fail == (code != 0), f"{text}: exit code {code}\n{printed}{errors}"
        for line in shown:
            assert not line.startswith(ON_STDERR) or line in errors.splitlines(), f"{text}: shown {line}\n{errors}"
        self._trained |= re.search(r"vibrocast train\b", text) is not None
        shown = [line for line in shown if line.strip() and not line.startswith(ON_STDERR)]
        if shown:
            compare(shown, printed, exact=not self._trained)

    def _open(self, script: str, stderr: int) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["timeout", str(TIMEOUT_S), "bash", "-c", script],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )


def end(process: subprocess.Popen[str]) -> None:
    """End a process in the background as Ctrl-C does; `timeout` passes the signal on."""
    process.send_signal(signal.SIGINT)
    process.wait(10)
    assert process.stdout is not None
    process.stdout.close()


def compare(shown: Sequence[str], printed: str, exact: bool) -> None:
    """Raise AssertionError if a printed text differs from a page. `exact`: False = any number stands for any other."""
    pattern = ""
    for line in filter(str.strip, shown):
        if line.strip() == "...":
            pattern += r"(?:[^\n]*\n)*?"
            continue
        words = " ".join(line.split())
        parts = [words] if exact else NUMBER.split(words)
        pattern += NUMBER.pattern.join(re.escape(part).replace(r"\.\.\.", r"[^\n]*") for part in parts) + "\n"
    lines = [" ".join(line.split()) for line in printed.splitlines() if line.strip()]
    both = "shown:\n{}\nprinted:\n{}".format("\n".join(shown), printed)
    assert re.fullmatch(pattern, "".join(f"{line}\n" for line in lines)), both


def look_up(text: str) -> None:
    """Raise AssertionError for a `vibrocast` command with a subcommand or an option that does not exist."""
    tokens = shlex.shlex(text.replace("\\\n", " "), posix=True, punctuation_chars="|;&<>")
    tokens.whitespace_split = True
    for _, part in itertools.groupby(tokens, lambda token: set(token) <= set("|;&")):
        words = list(part)
        if words[0].endswith("vibrocast"):
            command: click.Command | None = main
            while isinstance(command, click.Group) and words[1:] and not words[1].startswith("-"):
                command = command.get_command(click.Context(command), words.pop(1))
            assert command is not None, text
            known = {"--help", *(name for each in command.params for name in (*each.opts, *each.secondary_opts))}
            assert {word.partition("=")[0] for word in words if word.startswith("--")} <= known, text


def commands(content: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the commands of a console block, and the lines of output that the page shows."""
    before, *parts = re.split(r"^\$ ", content, flags=re.MULTILINE)
    assert parts and not before, "a console block begins with a command after `$ `"
    for part in parts:
        text = re.match(r"(?:.*\\\n)*.*", part)[0]  # type: ignore[index]
        yield text, part[len(text) + 1 :].splitlines()


def run(page: Path, folder: Path) -> None:
    """Run the blocks of a page in a folder. Raises AssertionError for the first that does not do what the page says."""
    tokens = MarkdownIt("commonmark").disable("code").parse(page.read_text(encoding="utf-8"))
    with contextlib.closing(Session(folder)) as session:
        for token, below in itertools.zip_longest(tokens, tokens[1:]):
            language, _, title = token.info.partition(" ") if token.type == "fence" else ("", "", "")
            assert language not in ("console", "python") or title in ("", *MARKS), title
            if language == "console":
                for text, shown in commands(token.content):
                    if title:
                        look_up(text)
                    else:
                        session.command(text, shown)
            elif language == "python" and not title:
                output = below.content if below and below.type == "fence" and below.info == "text" else ""
                session.python(token.content, output.splitlines())


@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_the_page_run(page: str, tmp_path: Path) -> None:
    run(ROOT / page, tmp_path)
