"""The sidecar of a recorded WAV file: a JSON file next to it that states unit, rate, axes, sensor and losses."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vibrocast.textures.axes import AXES
from vibrocast.textures.recording import UNITS, TextureError

MARK = "vibrocast recording"
"""The value of the key `kind`, by which a sidecar is known from any other JSON file."""
_MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class Stated:
    """The facts on the samples that a sidecar states. `axes`: small letters of AXES, one for each channel, or none."""

    unit: str
    rate_hz: float
    channels: int
    axes: str


def path_of(path: Path) -> Path:
    """Return where the sidecar of a WAV file is."""
    return path.with_suffix(".json")


def write(path: Path, facts: Mapping[str, Any]) -> None:
    """Write the sidecar of a WAV file, with its `unit`, `rate_hz`, `channels` and `axes` among the facts.

    Raises OSError.
    """
    path.write_text(json.dumps({"kind": MARK, **facts}, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read(path: Path) -> Stated | None:
    """Return what the sidecar of a WAV file states; None if the file has none.

    Raises TextureError for a sidecar with wrong values.
    """
    file = path_of(path)
    facts = _facts(file)
    if facts is None:
        return None
    unit, rate_hz, channels, axes = (facts.get(key) for key in ("unit", "rate_hz", "channels", "axes"))
    if (
        unit not in UNITS
        or isinstance(rate_hz, bool)
        or not isinstance(rate_hz, int | float)
        or not isinstance(channels, int)
        or not isinstance(axes, str)
        or not is_axes(axes)
        or len(axes) not in (0, channels)
    ):
        raise TextureError(f"{file}: wrong unit, rate_hz, channels or axes; correct the file, or delete it")
    return Stated(unit, float(rate_hz), channels, axes.lower())


def is_one(file: Path) -> bool:
    """Return whether a file is a sidecar."""
    return _facts(file) is not None


def _facts(file: Path) -> dict[str, Any] | None:
    """Return the content of a sidecar; None for any other file."""
    try:
        if not file.is_file() or file.stat().st_size > _MAX_BYTES:
            return None
        facts = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) and facts.get("kind") == MARK else None


def is_axes(text: str) -> bool:
    """Return whether a text consists of different letters of AXES, in their order, or of none."""
    return text.upper() == "".join(axis for axis in AXES if axis in text.upper())
