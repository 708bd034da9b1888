"""Tests of writing files whole or not at all."""

import errno
import os
from pathlib import Path

import pytest

from vibrocast.files import atomic_write


def test_replaces_only_on_success(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    with atomic_write(path) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_follows_a_link(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    link.symlink_to(target)
    with atomic_write(link) as partial:
        partial.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_writes_directly_to_what_is_no_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with atomic_write(pipe) as partial:
        assert partial == pipe
    assert list(tmp_path.iterdir()) == [pipe]


def test_an_error_names_the_requested_file(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with pytest.raises(OSError, match="No space left") as caught, atomic_write(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(path)
    unwritable = tmp_path / "none" / "out.txt"
    with pytest.raises(FileNotFoundError) as missing, atomic_write(unwritable):
        pass
    assert missing.value.filename == str(unwritable)
    assert list(tmp_path.iterdir()) == []
