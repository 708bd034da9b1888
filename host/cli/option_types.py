"""The types of options: numbers with units and ranges, files and folders; no file is written over another."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click


def described(kind: click.FloatRange | click.IntRange) -> str:
    """Return the range of a type as help prints it; empty without limits."""
    if kind.min is None:
        return ""
    if kind.max is None:
        return f">{kind.min:g}" if kind.min_open else f">={kind.min:g}"
    return f"{kind.min} to {kind.max}" if isinstance(kind, click.IntRange) else f"{kind.min:g} to {kind.max:g}"


def limits(kind: click.FloatRange | click.IntRange) -> str:
    """Return the range of a type as errors state it, after a space; empty without limits."""
    if kind.max is not None:
        return f" from {described(kind)}"
    return "" if kind.min is None else f" {'above' if kind.min_open else 'of at least'} {kind.min:g}"


class Number(click.FloatRange):
    """A finite number in a range, whose unit stands in help. `above`: `low` is no part of the range."""

    def __init__(self, unit: str, low: float | None = None, high: float | None = None, *, above: bool = False) -> None:
        super().__init__(low, high, min_open=above)
        self.name = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, or raise click.BadParameter."""
        try:
            number = super().convert(value, param, ctx)
        except click.BadParameter:
            number = math.nan
        if not math.isfinite(number):
            self.fail(f"{value} cannot be used; give a finite number{limits(self)}", param, ctx)
        return number

    def _describe_range(self) -> str:
        """Return the range as click prints it in help."""
        return described(self)


class Whole(click.IntRange):
    """A whole number in a range, whose unit stands in help."""

    def __init__(self, unit: str, low: int, high: int | None = None) -> None:
        super().__init__(low, high)
        self.name = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or raise click.BadParameter."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"{value} cannot be used; give a whole number{limits(self)}", param, ctx)

    def _describe_range(self) -> str:
        """Return the range as click prints it in help."""
        return described(self)


def positive(unit: str) -> Number:
    """Return the type of a number above 0."""
    return Number(unit, 0, above=True)


class OutputFile(click.Path):
    """A file to write, rejected before any work is done when it cannot be written."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)
        self.suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path, or raise click.BadParameter with what to do."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if not path.parent.is_dir():
            self.fail(f"{path}: the folder {path.parent} does not exist; make it first", param, ctx)
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            self.fail(f"{path}: the name must end in {' or '.join(self.suffixes)}; rename it", param, ctx)
        return path


class _Folder(click.Path):
    """A folder to write into; click would name it a directory."""

    def __init__(self) -> None:
        super().__init__(file_okay=False, path_type=Path)
        self.name = "folder"


INPUT = click.Path(path_type=Path)
"""A file or folder to read; what reads it rejects what it cannot take."""
FOLDER = _Folder()


def reject_overwriting(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Raise click.UsageError where a file to write is also one to read, or two to write are the same."""
    used = [path for path in inputs if path]
    for output in filter(None, outputs):
        for other in used:
            same = os.path.realpath(output) == os.path.realpath(other)
            if same or (output.exists() and other.exists() and output.samefile(other)):
                raise click.UsageError(f"{output} and {other} are the same file; give the output another name")
        used.append(output)
