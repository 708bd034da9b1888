"""Reads whole input files of a known kind, and writes files and folders completely or not at all."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vibrocast.errors import InputError, VibrocastError
from vibrocast.memory import shortage

_partial: set[Path] = set()
"""Files and folders that are being written."""


def remove_partial() -> None:
    """Remove all that is written in part: before a process ends without leaving its blocks."""
    for path in list(_partial):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _beside(target: Path, state: str) -> Path:
    return target.with_name(f".{target.stem}.{os.getpid()}.{state}{target.suffix}")


def _remove_abandoned(target: Path) -> None:
    """Remove what processes that were killed have left of a file or folder; take a folder's former content back."""
    name = re.compile(rf"\.{re.escape(target.stem)}\.(\d+)\.(partial|before){re.escape(target.suffix)}")
    with suppress(OSError):  # a folder that can be written can perhaps not be listed
        for path in target.parent.iterdir():
            found = name.fullmatch(path.name)
            if found is None or runs(int(found[1])):
                continue
            if found[2] == "before" and not target.exists():
                path.rename(target)
            elif path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def runs(process: int) -> bool:
    """Return whether there is a process of this number."""
    import psutil  # which most files never need

    return bool(psutil.pid_exists(process))


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`, with the same suffix; it replaces `path` when the block succeeds.

    Removes what a killed process has left of `path`. Anything but a regular file (a terminal, /dev/stdout) is written
    directly. An error of the block names `path`, too. Raises OSError, which names `path`, when it cannot be written.
    """
    target = Path(os.path.realpath(path))
    try:
        if target.exists() and not target.is_file():
            yield target
            return
        _remove_abandoned(target)
        partial = _beside(target, "partial")
        _partial.add(partial)
        try:
            partial.touch()
            yield partial
            os.replace(partial, target)
        except VibrocastError as error:
            error.problem = error.problem.replace(str(partial), str(path))
            raise
        finally:
            partial.unlink(missing_ok=True)
            _partial.discard(partial)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder next to `path`; it replaces `path`, and all in it, when the block succeeds.

    Raises OSError, which names `path`, when it cannot be written.
    """
    target = Path(os.path.realpath(path))
    partial, before = _beside(target, "partial"), _beside(target, "before")
    _partial.add(partial)
    try:
        _remove_abandoned(target)
        partial.mkdir()
        yield partial
        if target.exists():
            target.rename(before)
        partial.rename(target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        if before.exists() and not target.exists():
            before.rename(target)
        for folder in (partial, before):
            shutil.rmtree(folder, ignore_errors=True)
        _partial.discard(partial)


def read_input(path: Path, kind: str, magic: bytes, max_bytes: int) -> bytes:
    """Return the bytes of a regular file that begins with `magic` and is at most `max_bytes` long.

    `kind`: name of such a file, for people. Raises InputError for any other file, and for one that the free memory does
    not hold, OSError when it cannot be read.
    """
    # Opening a pipe would wait for its writer, and a device may never end.
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: no file; give a {kind}")
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            raise InputError(f"{path}: not a {kind}: it does not begin with {magic.decode()!r}; give another file")
        if path.stat().st_size > max_bytes:
            raise InputError(f"{path}: longer than {max_bytes} bytes, the most in a {kind}; give another file")
        if lack := shortage(path.stat().st_size):
            raise InputError(f"{path}: {lack}")
        return magic + file.read()


def plain(text: str) -> str:
    """Return a text with an escape in place of each character that cannot be seen: controls, line ends, directions."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
