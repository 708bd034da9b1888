"""Tests of the entry: interrupted while it loads, and what it need not load."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest

from vibrocast.host.command_line import SUBCOMMANDS, main

ROOT = Path(__file__).parents[2]

# A command line that is interrupted while it is being imported.
INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "vibrocast.host.command_line":
            os.kill(os.getpid(), {number})

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupting())
from vibrocast.host.entry import main
main()
"""


def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_while_loading(number: signal.Signals) -> None:
    result = run(INTERRUPTED_IMPORT.format(number=int(number)))
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "error: interrupted\n")


def test_a_hangup_that_is_to_be_ignored_is() -> None:
    code = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    result = run(code + INTERRUPTED_IMPORT.format(number=int(signal.SIGHUP)), "--version")
    assert result.returncode == 0
    assert "version" in result.stdout


def test_help_loads_nothing_that_only_playing_needs() -> None:
    code = "import sys; from vibrocast.host.entry import main\ntry: main()\nexcept SystemExit: print(*sys.modules)"
    loaded = set(run(code, "--help").stdout.split())
    assert "vibrocast.host.command_line" in loaded
    assert loaded.isdisjoint({"matplotlib", "vibrocast.host.end_to_end", "vibrocast.simulated_device.controller"})


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_the_list_of_subcommands_shows_the_first_paragraph_of_each_help(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None and command.name == name
    assert " ".join((command.help or "").split("\n\n")[0].split()) == SUBCOMMANDS[name].summary


def test_prints_names_that_are_no_text(tmp_path: Path) -> None:
    out = tmp_path / "\udcff.vct"
    arguments = "encode", str(ROOT / "examples" / "taps.wav"), str(out)
    result = run("from vibrocast.host.entry import main; main()", *arguments)
    assert (result.returncode, result.stderr) == (0, "")
    assert "\\udcff.vct: " in result.stdout
    assert out.exists()
