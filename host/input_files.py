"""Reads whole input files of a known kind, without being held up or filled up by what is no such file."""

from pathlib import Path


class InputFileError(ValueError):
    """A file that is not of the wanted kind; the message says why and what to do."""


def read_input(path: Path, kind: str, magic: bytes, largest_bytes: int) -> bytes:
    """Return the bytes of a regular file that begins with `magic` and is at most `largest_bytes` long.

    `kind`: what a person calls such a file. Raises InputFileError for any other file, OSError when it cannot be read.
    """
    # Opening a pipe would wait for its writer, and a device may never end.
    if path.exists() and not path.is_file():
        raise InputFileError(f"{path}: no file; give a {kind}")
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            raise InputFileError(f"{path}: not a {kind}: it does not begin with {magic.decode()!r}; give another file")
        if path.stat().st_size > largest_bytes:
            raise InputFileError(f"{path}: longer than any {kind} of {largest_bytes} bytes at most; give another file")
        return magic + file.read()
