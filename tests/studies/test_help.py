"""Every module and script that can be run prints help, and does nothing else."""

import ast
import runpy
import sys
from pathlib import Path

import pytest

from tests import words

ROOT = Path(__file__).parents[2]


def is_run(path: Path) -> bool:
    """Return whether a file has a part that runs only as a program."""
    return any(
        isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'"
        for node in ast.parse(path.read_text(encoding="utf-8")).body
    )


PROGRAMS = [
    path for path in words.sources() if path.endswith(".py") and not path.startswith("tests/") and is_run(ROOT / path)
]


def test_programs_are_found() -> None:
    assert {"studies/speed.py", "hatch_build.py", "host/conformance/page.py"} <= set(PROGRAMS)


@pytest.mark.parametrize("path", PROGRAMS)
def test_help_is_all_that_a_program_does(
    path: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(*_arguments: object, **_options: object) -> None:
        raise AssertionError("a file is written")

    monkeypatch.setattr(Path, "write_text", write)
    monkeypatch.setattr(Path, "write_bytes", write)
    monkeypatch.setattr(sys, "argv", [path, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / path), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.lower().startswith("usage: ")
