"""Shared by the scripts: options, errors in one line, progress, and pages, tables and charts that are written whole."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

from vibrocast import pages, progress
from vibrocast.errors import VibrocastError
from vibrocast.evaluation import points
from vibrocast.evaluation.points import Record, Row

Item = TypeVar("Item")

EXISTING = click.Path(exists=True, file_okay=False, path_type=Path)
FOLDER = click.argument("folder", type=EXISTING)
FROM_TABLES = click.option("--from-tables", is_flag=True, help="Write the page from its tables, without measurements.")


def study(main: Callable[..., None]) -> click.Command:
    """Make a command of a function: it gets the option `out`, and its errors are one line."""

    @wraps(main)
    def command(**options: Any) -> None:
        with errors_in_one_line():
            main(**options)

    kind = click.Path(file_okay=False, path_type=Path)
    out = click.option("--out", type=kind, required=True, help="Write the page and its tables into this folder.")
    return click.command()(out(command))


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Turn errors that a person can act on into those of a command."""
    try:
        yield
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}" if error.filename else str(error)) from error
    except VibrocastError as error:
        raise click.ClickException(str(error)) from error


def collected(title: str, items: Iterable[Item], total: int | None, name: Callable[[Item], str]) -> list[Item]:
    """Return items that take long to come, with a progress bar. `total`: None = not known. `name`: shows each."""
    found: list[Item] = []
    with progress.bar(title) as update:
        for item in items:
            found.append(item)
            update(len(found) / total if total else None, name(item))
    return found


def results_folder(out: Path) -> Path:
    """Make the folder OUT/results and return it. Raises OSError."""
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def rounded(row: Row, form: str) -> Row:
    """Return a row with its numbers in a form of Python's format strings, such as ".4g"."""
    values = {
        name: float(f"{value:{form}}") if isinstance(value, float) else value for name, value in vars(row).items()
    }
    return type(row)(**values)


def write(out: Path, name: str, text: str, redrawn: bool = False) -> None:
    """Write a part of OUT/NAME.md; `redrawn` as `pages.write_figures` has it. Raises OSError."""
    pages.write_figures(out / f"{name}.md", text, redrawn)
    click.echo(str(out / f"{name}.md"))


def render(name: str, script: Mapping[str, Any], **values: object) -> str:
    """Return the page of the template of this name, filled with values and with the constants of a script's globals."""
    constants = {key: value for key, value in script.items() if key.isupper()}
    return pages.render(Path(__file__).with_name(f"{name}.md.jinja"), **constants, **values)


def publish(out: Path, name: str, text: str, tables: Sequence[tuple[str, Sequence[Record], type[Record]]]) -> None:
    """Write a part of OUT/NAME.md, and each table of (file, rows, kind) in OUT/results. Raises OSError."""
    for file, rows, kind in tables:
        points.write_rows(results_folder(out) / file, rows, kind)
    write(out, name, text)
