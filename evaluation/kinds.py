"""Kinds of textures, such as "fingertip": the kind of each recording, by a table of files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vibrocast.evaluation.points import read_rows
from vibrocast.textures.dataset import DatasetEntry

TABLE = Path(__file__).parent / "data" / "kinds.csv"
"""Kinds by the names that the recordings of known sets have."""


@dataclass(frozen=True)
class FileKind:
    """A kind of texture, such as "fingertip", and which files hold it: the end of their paths, or a pattern of it."""

    file: str
    kind: str


@dataclass(frozen=True)
class TraceKind:
    """The kind of a recording's texture."""

    trace: str
    kind: str


def kinds(everything: Sequence[DatasetEntry], table: Path = TABLE) -> list[TraceKind]:
    """Return the kinds of the recordings that a CSV file with columns `file` and `kind` names; the first row counts.

    Raises InputError where it is no such file, OSError where it cannot be read.
    """
    rows = [row for row in read_rows(table, FileKind) if row.file]
    found = ((trace, next((row.kind for row in rows if trace.path.match(row.file)), "")) for trace in everything)
    return [TraceKind(trace.name, kind) for trace, kind in found if kind]
