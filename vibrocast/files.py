"""Reads whole input files of a known kind, and writes files and folders whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with the same suffix; it takes the place of `path` when the block succeeds.

    What is no regular file (a terminal, /dev/stdout) is written directly. Raises OSError, which names `path`, when it
    cannot be written.
    """
    target = Path(os.path.realpath(path))
    try:
        if target.exists() and not target.is_file():
            yield target
            return
        partial = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
        try:
            partial.touch()
            yield partial
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside `path`; it takes the place of `path`, and of all in it, when the block succeeds.

    Raises OSError, which names `path`, when it cannot be written.
    """
    target = Path(os.path.realpath(path))
    partial, before = (target.with_name(f".{target.name}.{os.getpid()}.{state}") for state in ("partial", "before"))
    try:
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


class InputFileError(ValueError):
    """A file that is not of the wanted kind; the message says why and what to do."""


def read_input(path: Path, kind: str, magic: bytes, max_bytes: int) -> bytes:
    """Return the bytes of a regular file that begins with `magic` and is at most `max_bytes` long.

    `kind`: what a person calls such a file. Raises InputFileError for any other file, OSError when it cannot be read.
    """
    # Opening a pipe would wait for its writer, and a device may never end.
    if path.exists() and not path.is_file():
        raise InputFileError(f"{path}: no file; give a {kind}")
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            raise InputFileError(f"{path}: not a {kind}: it does not begin with {magic.decode()!r}; give another file")
        if path.stat().st_size > max_bytes:
            raise InputFileError(f"{path}: longer than any {kind} of {max_bytes} bytes at most; give another file")
        return magic + file.read()
