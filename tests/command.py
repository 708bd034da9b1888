"""Runs the `vibrocast` command in this process or in one of its own, as the tests of commands do."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from vibrocast.host.cli.command_line import main

ROOT = Path(__file__).parents[1]
OAK = ROOT / "examples" / "oak.wav"
STARTED = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    "signal.signal(signal.SIGHUP, signal.SIG_DFL);"
    "from vibrocast.host.cli.entry import main; main()"
)


def run(*arguments: object, data: bytes = b"") -> Result:
    """Return the result of the command with these arguments and this standard input."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments], input=data)


def succeeds(*arguments: object, data: bytes = b"") -> str:
    """Return the standard output of a command that ends without an error."""
    result = run(*arguments, data=data)
    assert result.exit_code == 0, result.output
    return result.stdout


def fails(exit_code: int, *arguments: object, data: bytes = b"") -> str:
    """Return the error, which is one line, for a person, without a traceback."""
    result = run(*arguments, data=data)
    assert result.exit_code == exit_code, result.output
    # On a busy machine, lines of progress come before it.
    (error,) = [line for line in result.stderr.splitlines(keepends=True) if line.startswith("error: ")]
    assert result.stderr.endswith(error)
    assert "unexpected" not in error
    return error


def answer(*arguments: object, data: bytes = b"") -> Any:
    """Return the answer in JSON of a command that ends without an error."""
    return json.loads(succeeds(*arguments, "--json", data=data))


def failure(exit_code: int, *arguments: object, data: bytes = b"") -> Any:
    """Return the answer in JSON of a command that fails."""
    result = run(*arguments, "--json", data=data)
    assert result.exit_code == exit_code, result.output
    told = json.loads(result.stdout)
    assert told["exit_code"] == exit_code
    return told


def started(*arguments: object, folder: Path = ROOT, session: bool = False) -> subprocess.Popen[str]:
    """Start the command as a process of its own, which signals end even where the tests run in the background.

    `session`: with its own processes, which a signal then reaches together.
    """
    return subprocess.Popen(
        [sys.executable, "-c", STARTED, *map(str, arguments)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=session,
    )


def titles(text: str) -> list[str]:
    """Return the titles of the sections in a help."""
    return [line for line in text.splitlines() if re.fullmatch(r"[A-Z][\w ]+:", line)]
