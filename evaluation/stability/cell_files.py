"""A map's cells as a CSV file: written with cause and remedy, and read again to draw the page without measuring."""

import csv
from collections.abc import Sequence
from pathlib import Path

from vibrocast.errors import InputError
from vibrocast.evaluation.stability.known_causes import explanation
from vibrocast.evaluation.stability.maps import Map
from vibrocast.evaluation.stability.trials import Outcome, Verdict
from vibrocast.files import atomic_write

_BEFORE = ("method", "case", "setting")
_AFTER = ("effect", "cause", "remedy")


def write_cells(path: Path, each: Map, cells: Sequence[Verdict]) -> None:
    """Write cells, a row each.

    The column `required` states the outcome that is right, and each figure has a column. Raises OSError.
    """
    figures = list(dict.fromkeys(name for cell in cells for name in cell.figures))
    varied = [each.value_name] if each.value_name else []
    columns = [*_BEFORE, *varied, "required", "outcome", *figures, *_AFTER]
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        for cell in cells:
            known = explanation(cell)
            row = {
                **vars(cell),
                **cell.figures,
                each.value_name: cell.value,
                "cause": known.cause,
                "remedy": known.remedy,
            }
            table.writerow("" if row.get(name) is None else row[name] for name in columns)


def read_cells(path: Path, each: Map) -> list[Verdict]:
    """Return the cells of a file of write_cells. Raises InputError where it is none, OSError."""
    with path.open(newline="", encoding="utf-8") as file:
        try:
            return [_cell(each, row) for row in csv.DictReader(file)]
        except (csv.Error, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: no cells of this map ({error!r}); run `vibrocast stability` again") from error


def _cell(each: Map, row: dict[str, str]) -> Verdict:
    method, case, setting = (row.pop(name) for name in _BEFORE)
    effect, *_ = (row.pop(name) for name in _AFTER)
    value = row.pop(each.value_name) if each.value_name else ""
    required, outcome = Outcome(row.pop("required")), Outcome(row.pop("outcome"))
    figures = {name: float(text) if text else None for name, text in row.items()}
    return Verdict(
        each.name,
        method,
        case,
        setting,
        float(value) if value else None,
        outcome,
        figures,
        effect,
        required,
    )
