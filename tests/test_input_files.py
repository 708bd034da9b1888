"""Tests of reading input files: only regular files of the wanted kind and size."""

import os
from pathlib import Path

import pytest

from vibrocast.errors import InputError
from vibrocast.files import read_input


def read(path: Path) -> bytes:
    return read_input(path, "test file", b"TEST", 10)


@pytest.mark.parametrize("content", [b"TEST", b"TEST123456"])
def test_reads_the_whole_file(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    assert read(path) == content


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "does not begin"), (b"TES", "does not begin"), (b"WAVE12", "does not begin"), (b"TEST1234567", "longer")],
)
def test_rejects_other_files(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(InputError, match=reason):
        read(path)


def test_rejects_a_pipe_or_device_without_waiting_for_it(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(InputError, match="no file"):
            read(path)


def test_says_that_there_is_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none")
