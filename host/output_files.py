"""Writes a file whole or not at all, so that a failed run never leaves half a file or spoils a good one."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with the same suffix; it takes the place of `path` when the block succeeds.

    What is no regular file (a terminal, /dev/stdout) is written directly. Raises OSError as writing does.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        yield path
        return
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
