"""Extras: what works without them, and how the error says which one to install."""

import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from vibrocast import extras
from vibrocast.firmware import keys

ROOT = Path(__file__).parents[1]
# Hides the packages of all extras.
HIDDEN = f"""
from importlib.machinery import PathFinder
find_spec = PathFinder.find_spec
def find_other(name, *arguments):
    return None if name.partition(".")[0] in {set(extras.EXTRAS)} else find_spec(name, *arguments)
PathFinder.find_spec = find_other
"""
# Runs commands, one a line of standard input; prints exit code and errors of each.
COMMANDS = f"""{HIDDEN}
import json, sys
from click.testing import CliRunner
from vibrocast.host.cli.command_line import main
for line in sys.stdin:
    result = CliRunner().invoke(main, json.loads(line))
    print(json.dumps([result.exit_code, result.stderr]))
"""


def run_without_extras(*commands: list[str]) -> list[tuple[int, str]]:
    """Run commands in one process where no package of an extra can be imported; return exit code and errors of each."""
    lines = "".join(json.dumps(command) + "\n" for command in commands)
    done = subprocess.run([sys.executable, "-c", COMMANDS], cwd=ROOT, input=lines, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [(code, errors) for code, errors in map(json.loads, done.stdout.splitlines())]


def test_the_base_encodes_decodes_plays_and_uploads(tmp_path: Path) -> None:
    wav, stream, out = (str(tmp_path / name) for name in ("taps.wav", "taps.vct", "decoded.wav"))
    learned = str(tmp_path / "learned.vct")
    commands = [
        ["encode", str(ROOT / "examples" / "taps.wav"), learned, "--model", "eva-16-4"],
        ["generate", "taps", wav, "--seconds", "0.5"],
        ["decode", learned, out],
        ["encode", wav, stream],
        ["info", stream],
        ["decode", stream, out],
        ["play", stream, "--report", str(tmp_path / "taps.json")],
        ["play", wav, "--snr-db", "10"],
        ["encode", wav, stream, "--codec", "slp", "--snr-db", "10"],
        ["live", "taps", "--seconds", "0.5", "--playout-delay-ms", "300"],
        ["codecs"],
        ["models"],
        ["devices"],
        ["status"],
        ["flash", "eva-16-4"],
    ]
    for command, (code, errors) in zip(commands, run_without_extras(*commands), strict=True):
        assert code == 0, (command, errors)


def test_the_base_simulates() -> None:
    code = f"{HIDDEN}\nfrom vibrocast.host.cli.entry import main\nmain()"
    with subprocess.Popen([sys.executable, "-c", code, "simulate"], cwd=ROOT, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        address = run.stdout.readline().strip()
        try:
            assert run_without_extras(["status", "--device", address]) == [(0, "")]
        finally:
            run.terminate()


def test_a_command_names_the_extra_that_it_needs(tmp_path: Path) -> None:
    oak, out = "examples/oak.wav", str(tmp_path / "out")
    keys.write_public_key(tmp_path / "vendor.pub.pem", b"\x02" * 32)
    cases = [
        ("bench", ["bench", "examples", "--out", out]),
        ("bench", ["stability", "--out", out]),
        ("bench", ["measure", "--bench", "examples/bench.toml", "--out", out]),
        ("bench", ["conformance"]),
        ("plan", ["plan", "examples/scenes/glove.toml", "--out", out]),
        ("train", ["train", "examples/eva.toml", "--out", out]),
        ("train", ["export", "best.pt", "--out", out]),
        ("firmware", ["play", oak, "--device", "cortex-m4"]),
        ("firmware", ["play", oak, "--device", "stm32f405"]),
        ("firmware", ["status", "--device", "host"]),
        ("keys", ["keys", "new", f"{out}.pem"]),
        ("keys", ["simulate", "--public-key", str(tmp_path / "vendor.pub.pem")]),
        ("plot", ["play", oak, "--plot", f"{out}.png"]),
    ]
    for (extra, command), (code, errors) in zip(cases, run_without_extras(*(case[1] for case in cases)), strict=True):
        message = errors.removeprefix("error: ")
        assert code == 2, (command, errors)
        assert errors.count("\n") == 1 and re.match(rf"this needs [\w, ]+; install the extra \[{extra}\]: ", message), (
            command,
            errors,
        )


@pytest.mark.parametrize(
    ("origin", "requirement"),
    [
        ({"url": "file:///home/me/a%20b", "dir_info": {"editable": True}}, "-e '/home/me/a b[bench]'"),
        ({"url": "file:///home/me/vibrocast", "dir_info": {}}, "'/home/me/vibrocast[bench]'"),
        ({"url": "file:///w/v.whl", "archive_info": {}}, "'vibrocast[bench] @ file:///w/v.whl'"),
        (
            {"url": "https://a.example/v", "vcs_info": {"vcs": "git", "commit_id": "12ab"}},
            "'vibrocast[bench] @ git+https://a.example/v@12ab'",
        ),
        (None, "'.[bench]'"),
    ],
)
def test_the_command_installs_from_where_vibrocast_came_from(
    origin: dict[str, Any] | None, requirement: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Installed:
        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return None if origin is None else json.dumps(origin)

    monkeypatch.setattr(metadata, "distribution", lambda name: Installed())
    command = extras.install_command("bench")
    assert command.endswith(f" -m pip install {requirement}")
    assert command.startswith("in vibrocast's sources, ") == (origin is None)


def test_other_missing_modules_are_no_extra() -> None:
    assert extras.explained(ModuleNotFoundError(name="vibrocast.nothing")) is None
    assert "[plot]" in str(extras.explained(ModuleNotFoundError(name="matplotlib.figure")))


def test_the_table_agrees_with_the_project() -> None:
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    del groups["test"], groups["docs"]  # of developers
    brought: dict[str, set[str]] = {}
    for extra, requirements in groups.items():
        pending = list(requirements)
        while pending:
            name, own = re.match(r"([\w-]+)(?:\[(\w+)\])?", pending.pop()).groups()  # type: ignore[union-attr]
            if own:
                pending += groups[own]
            else:
                brought.setdefault(
                    {"mat-io": "matio", "pyelftools": "elftools", "python-osc": "pythonosc"}.get(name, name), set()
                ).add(extra)
    assert {module: set(named) for module, named in extras.EXTRAS.items()} == brought
