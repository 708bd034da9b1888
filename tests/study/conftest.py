"""A folder and stimuli for the tests of studies; servers that end at once."""

from pathlib import Path

import pytest

from tests.study.small_study import stimuli_of
from vibrocast.study.trials import Stimulus


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for study files."""
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def made(folder: Path) -> tuple[Stimulus, ...]:
    """The stimuli of the small study by ABX."""
    return stimuli_of("abx", folder)


@pytest.fixture
def no_lingering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a server close its pages soon after the end of its run."""
    monkeypatch.setattr("vibrocast.study.server._LINGER_S", 0.3)
