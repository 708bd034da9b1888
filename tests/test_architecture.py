"""The rooms: which may import which, and that every file says what it is for."""

import ast
import subprocess
from pathlib import Path

import pytest

from vibrocast import textures
from vibrocast.codec import core, interface
from vibrocast.device_protocol import coded_stream
from vibrocast.textures import recording

ROOT = Path(__file__).parents[1]
ALLOWED = {
    "textures": set[str](),
    "device_protocol": set[str](),
    "codec": set[str](),
    "models": {"device_protocol"},
    "firmware": set[str](),
    "simulated_device": {"codec", "device_protocol", "firmware"},
    "export": {"codec", "textures", "device_protocol"},
    "evaluation": {"codec", "device_protocol", "export", "firmware", "host", "models", "simulated_device", "textures"},
    "host": {"codec", "device_protocol", "evaluation", "export", "firmware", "models", "simulated_device", "textures"},
}
SOURCES = [path for room in ALLOWED for path in sorted((ROOT / room).rglob("*.py"))]


def imported_rooms(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    assert not {name.split(".")[0] for name in names} & set(ALLOWED), "packages are imported as vibrocast.PACKAGE"
    return {name.split(".")[1] for name in names if name.startswith("vibrocast.")} & set(ALLOWED)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows_point_one_way(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    assert imported_rooms(path) <= ALLOWED[room] | {room}


def test_rooms_that_may_not_import_each_other_agree() -> None:
    assert textures.UNITS == coded_stream.UNITS
    assert recording.MAX_CHANNELS == coded_stream.MAX_CHANNELS == interface.MAX_CHANNELS
    assert core.MAX_PACKET_BYTES == coded_stream.MAX_PACKET_BYTES


def tracked(*patterns: str) -> list[str]:
    listed = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    return listed.stdout.split()


def test_every_file_opens_with_its_purpose() -> None:
    silent = [name for name in tracked("*.py") if ast.get_docstring(ast.parse((ROOT / name).read_text())) is None]
    silent += [name for name in tracked("*.c", "*.h") if not (ROOT / name).read_text().startswith("/* ")]
    assert silent == []


def test_every_dependency_has_its_reason_and_an_upper_bound() -> None:
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    requirements = [line for line in lines if line.startswith('    "') and any(sign in line for sign in (">=", "=="))]
    assert len(requirements) > 10
    assert [line for line in requirements if "# " not in line] == []
    assert [line for line in requirements if "<" not in line and "==" not in line] == []
