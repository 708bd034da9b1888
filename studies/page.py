"""Shared by the scripts: options, errors in one line, and pages and tables that are written whole."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from vibrocast import pages
from vibrocast.errors import VibrocastError
from vibrocast.evaluation import points
from vibrocast.evaluation.points import Row
from vibrocast.files import atomic_write

FOLDER = click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
OUT = click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Write the page and its tables into this folder.",
)


write = pages.write_figures


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Turn errors that a person can act on into those of a command."""
    try:
        yield
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}" if error.filename else str(error)) from error
    except VibrocastError as error:
        raise click.ClickException(str(error)) from error


def results_folder(out: Path) -> Path:
    """Make the folder OUT/results and return it. Raises OSError."""
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_rows(path: Path, rows: Iterable[Row], kind: type[Row]) -> None:
    """Write rows of a dataclass as CSV, whole or not at all. Raises OSError."""
    with atomic_write(path) as partial:
        points.write_rows(partial, rows, kind)


def render(name: str, **values: object) -> str:
    """Return the page of the template of this name, filled with values."""
    return pages.render(Path(__file__).with_name(f"{name}.md.jinja"), **values)
