"""What another package adds by entry points: a command and a simulated board."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

MODULE = '''"""A package that adds a command and a board."""

import click

from vibrocast.host.cli.commands import Subcommand
from vibrocast.host.devices import FirmwareDevice
from vibrocast.simulated_device.controller import Controller

BOARD = FirmwareDevice(summary="a board of another package", board=Controller, channels=8)


@click.command()
def greet() -> None:
    """Say hello."""
    click.echo("hello")


COMMANDS = (Subcommand("greet", "Play", "other:greet", "Say hello."),)
'''
ENTRY_POINTS = (
    "[vibrocast.commands]\nbroken = other:NOTHING\nother = other:COMMANDS\n[vibrocast.devices]\nmine = other:BOARD\n"
)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a folder that holds an installed package."""
    (tmp_path / "other.py").write_text(MODULE)
    about = tmp_path / "other-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--help"], "greet        Say hello."),
        (["greet"], "hello"),
        (["devices"], "a board of another package"),
        (["status", "--device", "mine"], "hardware       simulated"),
    ],
)
def test_a_command_and_a_board_are_found(package: Path, arguments: list[str], told: str) -> None:
    code = "from vibrocast.host.cli.entry import main; main()"
    environment = {**os.environ, "PYTHONPATH": str(package)}
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, check=True
    )
    assert told in done.stdout
    assert "the commands of broken cannot be loaded" in done.stderr
