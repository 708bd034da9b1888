"""The build hook: which processor the core is compiled for."""

import subprocess
from pathlib import Path

import pytest

import hatch_build


@pytest.mark.parametrize(("named", "flag"), [(None, "-mcpu=native"), ("baseline", "-mcpu=baseline")])
def test_the_core_is_compiled_for_this_processor_or_for_the_one_named(
    named: str | None, flag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, check: commands.append(command))
    if named is None:
        monkeypatch.delenv("VIBROCAST_CPU", raising=False)
    else:
        monkeypatch.setenv("VIBROCAST_CPU", named)
    hatch_build.compile_core(tmp_path)
    assert flag in commands[0]
