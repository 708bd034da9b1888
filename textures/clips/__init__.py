"""Reads haptic clips, which describe a vibration by events and envelopes, as signals at a stated rate."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from vibrocast.textures.arrays import parsing
from vibrocast.textures.clips import ahap, haps, haptic, hjif, hmpg
from vibrocast.textures.clips.synthesis import RATE_HZ, Clip, Envelope, rendered
from vibrocast.textures.recording import Contents, TextureError, unusable


class Writer(NamedTuple):
    """How clips of a format are written. `range_hz`: its lowest and its highest frequency."""

    write: Callable[[Envelope], bytes]
    range_hz: tuple[float, float]


READERS: Mapping[str, Callable[[bytes], Clip]] = {
    ".ahap": ahap.read,
    ".haptic": haptic.read,
    ".haps": haps.read,
    ".hjif": hjif.read,
    ".hmpg": hmpg.read,
}
"""The reader of each suffix. It may raise any error for a file of another kind."""
WRITERS = {
    ".ahap": Writer(ahap.write, (ahap.LOWEST_HZ, ahap.HIGHEST_HZ)),
    ".haptic": Writer(haptic.write, haptic.FREQUENCY_HZ),
}
SUFFIXES = tuple(READERS)
MAX_BYTES = 5_000_000
"""Of a clip; those of programs have some kilobytes."""

_log = logging.getLogger(__name__)


def read(path: Path, rate_hz: float | None) -> Contents:
    """Read a clip as its signal at `rate_hz`, by default RATE_HZ; log its notes. Raises TextureError, OSError."""
    if path.stat().st_size > MAX_BYTES:
        raise unusable(path, f"longer than {MAX_BYTES} bytes, the most in a clip", "cut it into parts")
    suffix = path.suffix.lower()
    with parsing(path, f"a clip ({suffix})"):
        try:
            clip = READERS[suffix](path.read_bytes())
        except TextureError as error:
            error.problem = f"{path}: {error.problem}"
            raise
        contents = rendered(clip, rate_hz or RATE_HZ, path)
    _log.info("%s: %s", path, "; ".join(contents.notes))
    return contents
