"""Reads the tables of a TOML file key by key, so that what is wrong is told with its file, table and key."""

import math
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any

from vibrocast.files import InputFileError

MAX_BYTES = 1 << 20
_MAX_SHOWN = 80


def read_toml(path: Path, kind: str, error: type[InputFileError]) -> dict[str, Any]:
    """Return what a TOML file says; `kind`: what a person calls such a file.

    Raises `error` for what is no such file, OSError where it cannot be read.
    """
    if path.exists() and not path.is_file():
        raise error(f"{path}: no file; give a {kind} in TOML")
    if path.stat().st_size > MAX_BYTES:
        raise error(f"{path}: longer than any {kind}; give another")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as reason:
        raise error(f"{path}: not a TOML file: {reason}") from reason


class Table:
    """A table of the file, whose values are taken out one by one; what is left at the end is a mistake.

    `where`: what the file calls it, such as "[[textures]] 1". `error`: what every method raises for a wrong value.
    """

    def __init__(self, path: Path, where: str, table: Mapping[str, Any], error: type[InputFileError]) -> None:
        self.path = path
        self._where = where
        self._left = dict(table)
        self._error = error
        self._known: list[str] = []

    def reject(self, what: str) -> InputFileError:
        """Return the error that names the file and the table."""
        return self._error(f"{self.path}: {self._where}: {what}")

    def take(self, key: str, read: Callable[[Any], Any], expected: str, default: Any = MISSING) -> Any:
        """Return a value as `read` makes it of what the file says; raise `error`, which says what is right."""
        self._known.append(key)
        if key not in self._left:
            if default is MISSING:
                raise self.reject(f"{key} is missing; it must be {expected}")
            return default
        value = self._left.pop(key)
        try:
            return read(value)
        except (TypeError, ValueError) as reason:
            raise self.reject(f"{key} must be {expected}, not {_shown(value)}") from reason

    def text(self, key: str, default: Any = MISSING) -> Any:
        """Return a text that is not empty."""
        return self.take(key, text, "a text in one line", default)

    def number(self, key: str, default: Any = MISSING) -> Any:
        """Return a positive number."""
        return self.take(key, _positive, "a positive number", default)

    def within(self, key: str, low: float, high: float, meaning: str, default: Any = MISSING) -> Any:
        """Return a number from `low` to `high`. `meaning`: what it is, so that a slip of units is seen at once."""
        value = self.take(key, number, f"{meaning}, a number from {low:g} to {high:g}", default)
        if value is not None and value is not default:
            self.check(key, value, low, high, meaning)
        return value

    def check_given(self, key: str, low: float, high: float, meaning: str) -> None:
        """Check a number that is still to be taken; what is none is left to whatever takes it."""
        value = self._left.get(key)
        if isinstance(value, (int, float)):
            self.check(key, value, low, high, meaning)

    def check(self, key: str, value: float, low: float, high: float, meaning: str) -> None:
        """Raise `error` for a value outside a range; where another prefix of the unit would bring it in, say so."""
        if low <= value <= high:
            return
        meant = next((value * factor for factor in (1e3, 1e-3, 1e6, 1e-6) if low <= value * factor <= high), None)
        slip = "" if meant is None else f"; are the units mixed up? {meant:.9g} would be possible"
        raise self.reject(f"{key} = {value:.9g} is out of range: {meaning}, from {low:g} to {high:g}{slip}")

    def whole(self, key: str, low: int, high: int, default: Any = MISSING) -> Any:
        """Return a whole number in a range."""
        return self.take(key, lambda value: _whole(value, low, high), f"a whole number from {low} to {high}", default)

    def switch(self, key: str, default: Any = MISSING) -> Any:
        """Return true or false."""
        return self.take(key, _switch, "true or false", default)

    def word(self, key: str, words: Collection[str], default: Any = MISSING) -> Any:
        """Return one of some words."""
        return self.take(key, lambda value: _one_of(value, words), f"one of {', '.join(words)}", default)

    def end(self) -> None:
        """Raise `error` for a key that was not taken."""
        for key in self._left:
            raise self.reject(f"there is no key {key}; choose from {', '.join(self._known)}")


def _shown(value: Any) -> str:
    """Return what a file says in a form short enough for an error."""
    shown = repr(value)
    return shown if len(shown) <= _MAX_SHOWN else f"{shown[:_MAX_SHOWN]}..."


def text(value: Any) -> str:
    """Return a text that is not empty, without control characters. Raises TypeError."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise TypeError(value)
    return value


def number(value: Any) -> float:
    """Return a finite number. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise ValueError(value)
    return float(value)


def _positive(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ValueError(value)
    return float(value)


def _whole(value: Any, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(value)
    return value


def _switch(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(value)
    return value


def _one_of(value: Any, words: Collection[str]) -> str:
    if not isinstance(value, str) or value not in words:
        raise ValueError(value)
    return value
