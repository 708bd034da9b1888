"""Runs the command blocks of a page, in their order, as a reader would who types them.

A block is a fence. A ```console block holds commands, each after `$ `; a `\\` at the end continues a line, and the
lines below a command are its output. A ```python block is code. All blocks of a page share one folder, and its Python
blocks one interpreter. `title="needs data"`, `title="needs hardware"` or `title="needs other programs"` marks a block
that cannot run there: its `vibrocast` commands are only parsed. Other fences are text.

Commands:

- `COMMAND &` runs until `kill %1` or the end of the page. Its first line of output is awaited. Where the page shows
  that line, such as an address, later commands get the real one in its place.
- `make TARGET`: the Makefile must have the target. `pip install '.[EXTRA]'`: the project must have the extra.
  `pip install ./FOLDER` installs for this page alone. `pytest` collects the tests and runs none.
- `cd`, `git clone`, `source` and `python -m venv` are accepted without running: the folder is prepared.

Output:

- A command fails if, and only if, the page shows a line that begins with `error:`, and that line must be the same.
- Where the page shows output, all of it must be there, word by word. `...` stands for any text, on a line by itself
  for any lines. Numbers may differ, except in the output of commands that compute the same everywhere, where 5 % may.
- A ```text block directly below a ```python block is its output.
"""

import contextlib
import itertools
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import click

from vibrocast.host.cli.command_line import main

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 300
"""Of one command, or one block of Python."""
MARKS = ("needs data", "needs hardware", "needs other programs")
DETERMINISTIC = ("codecs", "decode", "encode", "generate", "info", "models")
TOLERANCE = 0.05
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
ON_STDERR = ("error:", "warning:", "note:")
ACCEPTED = re.compile(r"(cd|git clone|source|python3? -m venv)\b")
PIP = re.compile(r"(\S*\bpython3? -m )?\S*\b(pip|pipx) install\b")
PYTEST = re.compile(r"(\S*\bpython3? -m )?(\S*/)?pytest\b")
MAX_SHOWN = 3000  # characters of the output of a command that fails
END_OF_BLOCK = "--- end of block ---"
# Runs blocks of Python, one a line of JSON, in one namespace.
INTERPRETER = f"""
import json, sys
names = {{"__name__": "__main__"}}
for line in sys.stdin:
    page, lines_before, source = json.loads(line)
    exec(compile("\\n" * lines_before + source, page, "exec"), names)
    print({END_OF_BLOCK!r}, flush=True)
"""


class PageError(Exception):
    """A block of the page is not as it should be, or does not do what the page says."""


class Block(NamedTuple):
    """A fence of a page. `line`: of its first line of content, from 1. `follows`: stands directly below another."""

    line: int
    language: str
    title: str
    lines: list[str]
    follows: bool


class Command(NamedTuple):
    """A command of a block, with the lines of output that the page shows."""

    line: int
    text: str
    output: list[str]


def blocks(text: str) -> list[Block]:
    """Return the fences of a page. Raises PageError for commands outside fences, or in fences of no language."""
    found: list[Block] = []
    opened: tuple[int, str, str, str] | None = None
    lines = text.splitlines()
    content: list[str] = []
    last_end = 0
    for number, line in enumerate(lines, 1):
        fence = re.match(r"\s*(```+)\s*(\w*)(.*)$", line)
        if opened is None:
            if fence:
                opened = (number, fence[1], fence[2], fence[3])
                content = []
            elif re.match(r" {4,}\$ | {4,}(vibrocast|python -m|make|pip) (?!.* \|)", line):
                raise PageError(f"line {number}: an indented command; put it into a ```console block")
        elif line.strip() == opened[1]:
            start, _, language, rest = opened
            title = re.search(r'title="([^"]*)"', rest)
            follows = bool(found) and not any(each.strip() for each in lines[last_end : start - 1])
            indent = len(lines[start - 1]) - len(lines[start - 1].lstrip())
            content = [each[indent:] for each in content]
            found.append(Block(start + 1, language, title[1] if title else "", content, follows))
            opened, last_end = None, number
        else:
            content.append(line)
    if opened:
        raise PageError(f"line {opened[0]}: a fence without an end")
    for block in found:
        if block.language in ("", "sh", "bash", "shell") and any(line.startswith("$ ") for line in block.lines):
            raise PageError(f"line {block.line}: commands in a fence of another language; call it ```console")
    return found


def commands(block: Block) -> list[Command]:
    """Return the commands of a console block."""
    found: list[Command] = []
    continues = False
    for number, line in enumerate(block.lines, block.line):
        if continues:
            found[-1] = found[-1]._replace(text=f"{found[-1].text}\n{line}")
        elif line.startswith("$ "):
            found.append(Command(number, line[2:], []))
        elif found:
            found[-1].output.append(line)
        else:
            raise PageError(f"line {number}: a console block begins with a command after `$ `")
        continues = line.endswith("\\") and (continues or line.startswith("$ "))
    if not found:
        raise PageError(f"line {block.line}: a console block without a command")
    return found


def run(page: Path, folder: Path) -> None:
    """Run the blocks of a page in a folder. Raises PageError for the first that does not do what the page says."""
    found = blocks(page.read_text(encoding="utf-8"))
    for block in found:
        if block.language in ("console", "python") and block.title not in ("", *MARKS):
            raise PageError(f"line {block.line}: the title is none of {', '.join(MARKS)}")
    with (
        tempfile.TemporaryFile("w+") as errors,
        contextlib.closing(Session(str(page), folder, errors)) as session,
    ):
        for block, below in itertools.zip_longest(found, found[1:]):
            if block.language == "console":
                for command in commands(block):
                    if block.title:
                        check_syntax(command)
                    else:
                        session.command(command)
            elif block.language == "python" and not block.title:
                session.python(block, below if below and below.follows and below.language == "text" else None)


class Session:
    """The folder, the background commands and the interpreter of a page. `errors`: a file for their errors."""

    def __init__(self, page: str, folder: Path, errors: TextIO) -> None:
        self._page, self._folder = page, folder
        self._background: dict[int, subprocess.Popen[str]] = {}
        self._printed: dict[str, str] = {}  # the line that the page shows: the line printed here
        self._trained = False  # the weights of a training, and all that they code, differ by processor
        self._interpreter: subprocess.Popen[str] | None = None
        self._errors = errors
        shutil.copytree(ROOT / "examples", folder / "examples")
        for name in ("firmware", "models", "tests"):
            (folder / name).symlink_to(ROOT / name)
        (folder / ".venv").symlink_to(sys.prefix)
        packages = folder / "packages"
        self._environment = {
            **os.environ,
            "COLUMNS": "120",
            "MPLBACKEND": "Agg",
            "NO_COLOR": "1",
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "PIP_NO_BUILD_ISOLATION": "0",
            "PIP_NO_DEPS": "1",
            "PIP_NO_INDEX": "1",
            "PIP_TARGET": str(packages),
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(packages)]),
        }

    def close(self) -> None:
        """End what still runs."""
        for process in (*self._background.values(), *filter(None, [self._interpreter])):
            end(process)

    def command(self, command: Command) -> None:
        """Run a command, and compare what it prints with the page."""
        text = self._as_printed(command.text)
        command = Command(command.line, text, [self._as_printed(line) for line in command.output])
        words = shlex.split(text.replace("\\\n", " "), comments=True)
        number = re.fullmatch(r"kill %(\d+)", " ".join(words))
        if number:
            if int(number[1]) not in self._background:
                raise PageError(f"line {command.line}: there is no background command {number[1]}")
            end(self._background.pop(int(number[1])))
        elif words[-1] == "&":
            self._start(command)
        elif words[0] == "make":
            check_targets(command, words[1:])
        elif PIP.match(text):
            local = check_requirements(command, words[words.index("install") + 1 :])
            if local:
                self._run(Command(command.line, f"python -m pip install --quiet {local}", []))
        elif words[0] == "sudo":
            raise PageError(f"line {command.line}: the test runs nothing as root; mark the block")
        elif PYTEST.match(text):
            self._run(Command(command.line, shlex.join([*words, "--collect-only", "-q"]), []), allowed=(0, 5))
        elif not ACCEPTED.match(text):
            self._run(command)

    def _as_printed(self, text: str) -> str:
        for shown, printed in self._printed.items():
            text = text.replace(shown, printed)
        return text

    def _start(self, command: Command) -> None:
        number = max(self._background, default=0) + 1
        process = self._open(f"exec {command.text.rstrip().removesuffix('&')}")
        self._background[number] = process
        assert process.stdout is not None
        with limited(process):
            printed = process.stdout.readline().rstrip("\n")
        if not printed:
            raise PageError(f"line {command.line}: {command.text}: ended without a line of output")
        if command.output:
            shown = command.output[0]
            if shown.partition(":")[0] != printed.partition(":")[0]:
                raise PageError(f"line {command.line}: {command.text}: printed {printed!r}, not {shown!r}")
            self._printed[shown] = printed

    def _run(self, command: Command, allowed: Sequence[int] = (0,)) -> None:
        process = self._open(f"set -o pipefail\n{command.text}", stderr=subprocess.PIPE)
        with limited(process) as late:
            printed, errors = process.communicate()
        where = f"line {command.line}: {command.text}"
        if late:
            raise PageError(f"{where}: took more than {TIMEOUT_S} s")
        must_fail = any(line.startswith("error:") for line in command.output)
        if must_fail != (process.returncode not in allowed):
            raise PageError(f"{where}: exit code {process.returncode}\n{(printed + errors)[-MAX_SHOWN:]}")
        shown = [line for line in command.output if line.strip()]
        for line in shown:
            if line.startswith(ON_STDERR) and line not in errors.splitlines():
                raise PageError(f"{where}: shown {line!r}, printed\n{errors}")
        shown = [line for line in shown if not line.startswith(ON_STDERR)]
        words = command.text.split()
        subcommand = words[1] if words[0].endswith("vibrocast") and words[1:] else ""
        exact = subcommand in DETERMINISTIC and not self._trained
        self._trained |= subcommand == "train"
        if shown and (difference := differs(shown, printed, TOLERANCE if exact else None)):
            raise PageError(f"{where}: {difference}")

    def python(self, block: Block, output: Block | None) -> None:
        """Run a block of Python, and compare what it prints with the block below it."""
        if self._interpreter is None:
            self._interpreter = self._open(
                f"exec {shlex.quote(sys.executable)} -c {shlex.quote(INTERPRETER)}", stdin=subprocess.PIPE
            )
        process = self._interpreter
        assert process.stdin is not None and process.stdout is not None
        printed: list[str] = []
        with limited(process):
            process.stdin.write(
                json.dumps([self._page, block.line - 1, self._as_printed("\n".join(block.lines))]) + "\n"
            )
            process.stdin.flush()
            while (line := process.stdout.readline()) not in ("", f"{END_OF_BLOCK}\n"):
                printed.append(line)
        if not line:
            self._errors.seek(0)
            raise PageError(f"line {block.line}: Python failed\n{''.join(printed)}{self._errors.read()}")
        if output and (difference := differs(output.lines, "".join(printed), None)):
            raise PageError(f"line {output.line}: {difference}")

    def _open(self, script: str, **extra: Any) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", "-c", script],
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            start_new_session=True,
            text=True,
            **{"stdin": subprocess.DEVNULL, "stderr": self._errors, **extra},
        )


@contextlib.contextmanager
def limited(process: subprocess.Popen[str]) -> Iterator[list[bool]]:
    """Kill a process that takes too long; the yielded list is then no longer empty."""
    late: list[bool] = []

    def kill() -> None:
        late.append(True)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)

    timer = threading.Timer(TIMEOUT_S, kill)
    timer.start()
    try:
        yield late
    finally:
        timer.cancel()


def end(process: subprocess.Popen[str]) -> None:
    """End a process and all that it started, as Ctrl-C does, and then by force."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGINT)
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe:
            pipe.close()


def differs(shown: Sequence[str], printed: str, tolerance: float | None) -> str:
    """Return how printed text differs from a page, "" if not. `tolerance`: of numbers; None = any number."""
    pattern, expected = "", []
    for line in filter(str.strip, shown):
        if line.strip() == "...":
            pattern += r"(?:[^\n]*\n)*?"
            continue
        words = " ".join(line.split())
        expected += NUMBER.findall(words)
        parts = [re.escape(part).replace(r"\.\.\.", r"[^\n]*") for part in NUMBER.split(words)]
        pattern += f"({NUMBER.pattern})".join(parts) + "\n"
    lines = [" ".join(line.split()) for line in printed.splitlines() if line.strip()]
    match = re.fullmatch(pattern, "".join(f"{line}\n" for line in lines))
    if match is None:
        return "shown:\n{}\nprinted:\n{}".format("\n".join(shown), printed)
    if tolerance is not None:
        for wanted, found in zip(expected, match.groups(), strict=True):
            last_digit = 10.0 ** -len(wanted.partition(".")[2].partition("e")[0])
            if abs(float(wanted) - float(found)) > tolerance * abs(float(wanted)) + last_digit:
                return f"shown {wanted}, printed {found}:\n{printed}"
    return ""


def check_targets(command: Command, arguments: Sequence[str]) -> None:
    """Raise PageError for a target that the Makefile does not have."""
    makefile = (ROOT / "Makefile").read_text()
    for target in arguments:
        if "=" not in target and not re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE):
            raise PageError(f"line {command.line}: the Makefile has no target {target}")


def check_requirements(command: Command, arguments: Sequence[str]) -> str | None:
    """Raise PageError for an extra or a file that does not exist; return the folder of another package, if any."""
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    local = None
    for argument in arguments:
        path, _, extras = argument.rstrip("]").partition("[")
        if path == "vibrocast":
            raise PageError(f"line {command.line}: vibrocast is on no package index")
        for extra in extras.split(",") if path == "." and extras else ():
            if extra not in groups:
                raise PageError(f"line {command.line}: there is no extra {extra}")
        if path.endswith(".txt") and not (ROOT / path).is_file():
            raise PageError(f"line {command.line}: there is no {path}")
        if path.startswith("./"):
            local = path
    return local


def check_syntax(command: Command) -> None:
    """Raise PageError for a `vibrocast` command with a subcommand, an option or a choice that does not exist."""
    tokens = shlex.shlex(command.text.replace("\\\n", " "), posix=True, punctuation_chars="|;&<>")
    tokens.whitespace_split = True
    tokens.commenters = "#"
    part: list[str] = []
    for token in [*tokens, ";"]:
        if re.fullmatch(r"[|;&]+", token):
            if part and part[0].rpartition("/")[2] == "vibrocast":
                try:
                    parse(part[1:])
                except click.ClickException as error:
                    raise PageError(f"line {command.line}: {command.text}: {error.format_message()}") from error
            part = []
        else:
            part.append(token)


def parse(words: Sequence[str]) -> None:
    """Parse the arguments of `vibrocast`, without looking at files. Raises click.UsageError."""
    with click.Context(main, info_name="vibrocast", **main.context_settings) as context:
        group: click.Command = main
        words = [word for word in words if word != "--debug"]
        while isinstance(group, click.Group) and words and not words[0].startswith("-"):
            found = group.get_command(context, words[0])
            if found is None:
                raise click.UsageError(f"no command {words[0]!r}")
            group, words = found, words[1:]
    with click.Context(group, info_name=group.name, **main.context_settings) as context:
        values, rest, _ = group.make_parser(context).parse_args(list(words))
        if rest:
            raise click.UsageError(f"unexpected arguments: {' '.join(rest)}")
        if context.help_option_names and values.get("help"):
            return
        for parameter in group.params:
            value = values.get(parameter.name or "")
            given = [value] if isinstance(value, str) else list(value) if isinstance(value, list | tuple) else []
            if not given and isinstance(parameter, click.Argument) and parameter.required:
                raise click.UsageError(f"missing {parameter.human_readable_name}")
            if isinstance(parameter.type, click.Choice | click.IntRange | click.FloatRange):
                for each in given:
                    parameter.type(each, parameter, context)
