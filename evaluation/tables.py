"""Tables of polars: made of rows of dataclasses, taken apart into rows and groups of rows, written as CSV."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, get_type_hints

import polars as pl

from vibrocast.evaluation.points import Record, Row
from vibrocast.files import atomic_write

Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)
_COLUMN_TYPES: Mapping[Any, Any] = {
    str: pl.String,
    int: pl.Int64,
    float: pl.Float64,
    int | None: pl.Int64,
    float | None: pl.Float64,
}


def columns(kind: type[Record]) -> dict[str, Any]:
    """Return the columns of a table of a dataclass's rows, and the type of each in polars."""
    hints = get_type_hints(kind)
    return {field.name: _COLUMN_TYPES[hints[field.name]] for field in fields(kind)}


def frame(rows: Iterable[Row], kind: type[Row]) -> pl.DataFrame:
    """Return rows of a dataclass as a table, which has its columns even without rows."""
    schema = columns(kind)
    return pl.DataFrame([[getattr(row, name) for name in schema] for row in rows], schema, orient="row")


def as_rows(table: pl.DataFrame) -> list[Any]:
    """Return the rows of a table, with an attribute for each column."""
    return [SimpleNamespace(**row) for row in table.iter_rows(named=True)]


def by(table: pl.DataFrame, *names: str) -> Iterator[tuple[tuple[Any, ...], pl.DataFrame]]:
    """Return the values of columns, with the part of a table that has them, in the order of the table."""
    return iter(table.group_by(*names, maintain_order=True))


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return objects that are no table by their key, in their order."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table as CSV, whole or not at all. Raises OSError."""
    as_python = pl.col(pl.Boolean).replace_strict({True: "True", False: "False"}, return_dtype=pl.String)
    with atomic_write(path) as partial:
        table.with_columns(as_python, pl.col(pl.String).replace("", None)).write_csv(partial)
