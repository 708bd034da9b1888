"""What the tests of the evaluation share: two short recordings, and a run in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from vibrocast import textures
from vibrocast.evaluation import bench
from vibrocast.textures.generate import rough, wood


def here(tasks: Iterator[bench.Task]) -> bench.Outcomes:
    """Run tasks one after another, as the functions of workers do in processes."""
    for key, work in tasks:
        try:
            yield key, work()
        except Exception as error:
            yield key, error


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two recordings, rough.wav and wood.wav."""
    (tmp_path / "recordings").mkdir()
    textures.save(tmp_path / "recordings" / "rough.wav", rough(0, 0.3))
    textures.save(tmp_path / "recordings" / "wood.wav", wood(1, 0.3))
    return tmp_path / "recordings"
