"""Files: input of the wanted kind and size alone, output whole or not at all."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from vibrocast import models
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.trace import read_trace
from vibrocast.errors import InputError
from vibrocast.files import atomic_folder, atomic_write, read_input
from vibrocast.textures import load


def read(path: Path) -> bytes:
    return read_input(path, "test file", b"TEST", 10)


@pytest.mark.parametrize("content", [b"TEST", b"TEST123456"])
def test_the_whole_file_is_read(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    assert read(path) == content


@pytest.mark.parametrize(
    "reader",
    [models.load, read_stream, lambda path: next(read_trace(path)), lambda path: load(path.rename(f"{path}.csv"))],
    ids=["image", "stream", "trace", "recording"],
)
def test_a_file_beyond_a_tenth_of_the_free_memory_is_not_read(
    reader: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(101))
    monkeypatch.setattr("vibrocast.memory.available_bytes", lambda: 1000)
    with pytest.raises(InputError, match=r"needs .* GiB of memory, .* close other programs, or cut it into parts"):
        reader(path)


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "does not begin"), (b"TES", "does not begin"), (b"WAVE12", "does not begin"), (b"TEST1234567", "longer")],
)
def test_other_files_are_rejected(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(InputError, match=reason):
        read(path)


def test_a_pipe_or_device_is_rejected_without_waiting_for_it(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(InputError, match="no file"):
            read(path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none")


def test_a_file_is_replaced_only_on_success(tmp_path: Path) -> None:
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


def test_a_link_stays_and_a_pipe_is_written_directly(tmp_path: Path) -> None:
    target, link, pipe = (tmp_path / name for name in ("target", "link", "pipe"))
    link.symlink_to(target)
    with atomic_write(link) as partial:
        partial.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    os.mkfifo(pipe)
    with atomic_write(pipe) as partial:
        assert partial == pipe
    assert set(tmp_path.iterdir()) == {target, link, pipe}


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


def test_what_a_killed_process_has_left_is_removed_or_taken_back(tmp_path: Path) -> None:
    killed = 2**22 + 1  # more than any process has
    (tmp_path / f".out.{killed}.partial.wav").touch()
    (tmp_path / f".out.{os.getppid()}.partial.wav").touch()
    (tmp_path / f".model.{killed}.before").mkdir()
    (tmp_path / f".model.{killed}.before" / "card").touch()
    with atomic_write(tmp_path / "out.wav") as partial:
        partial.write_text("new")
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "model"):
        raise RuntimeError
    assert sorted(path.name for path in tmp_path.iterdir()) == [f".out.{os.getppid()}.partial.wav", "model", "out.wav"]
    assert (tmp_path / "model" / "card").exists()
