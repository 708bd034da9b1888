"""Checks the types of arguments; the error for a wrong type names the parameter."""

import os
from pathlib import Path
from typing import Any

from vibrocast.textures.recording import TextureError


def wrong_type(name: str, value: Any, required: str) -> TextureError:
    """Return the error for a value of a wrong type. `required`: the right types in words."""
    return TextureError(f"`{name}` is of type {type(value).__name__}", action=f"pass {required}", parameter=name)


def of_type(name: str, value: Any, types: type | tuple[type, ...], required: str) -> None:
    """Raise TextureError unless the value is None or of one of the types. `required`: the types in words."""
    if value is not None and not isinstance(value, types):
        raise wrong_type(name, value, required)


def number(name: str, value: Any) -> float:
    """Return a number of any type as a float. Raises TextureError for anything else, including text."""
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError
        return float(value)
    except (TypeError, ValueError):
        raise wrong_type(name, value, "a number") from None


def optional_number(name: str, value: Any) -> float | None:
    """Return None unchanged, anything else as `number` does."""
    return None if value is None else number(name, value)


def whole_number(name: str, value: Any, low: int, high: int) -> int:
    """Return a whole number of any type from low to high. Raises TextureError for anything else."""
    given = number(name, value)
    if not (low <= given <= high and given.is_integer()):
        raise TextureError(f"`{name}` is {value}", action=f"pass a whole number from {low} to {high}", parameter=name)
    return int(given)


def file_path(name: str, value: Any) -> Path:
    """Return the path of a file. Raises TextureError for any other type."""
    if not isinstance(value, str | os.PathLike):
        raise wrong_type(name, value, "the path of a file")
    return Path(value)
