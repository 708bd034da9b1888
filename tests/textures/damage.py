"""Damages files: whatever is changed in them, they load or are rejected in one line."""

from pathlib import Path

import numpy as np

from vibrocast.textures import TextureError, load


def check_damaged(path: Path, changes: list[tuple[int, int]], cut: int) -> None:
    """Change bytes of a file, each a position and its value, cut the file's end off, and load the file."""
    data = bytearray(path.read_bytes())
    for position, value in changes:
        data[position % len(data)] = value
    path.write_bytes(data[: len(data) - cut])
    try:
        assert np.isfinite(load(path).samples).all()
    except TextureError as error:
        assert "\n" not in str(error)
