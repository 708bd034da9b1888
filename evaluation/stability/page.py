"""Writes what the trials showed: data and a picture for each map, and the page that names the boundaries."""

import csv
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from evaluation.stability.known_causes import explanation
from evaluation.stability.maps import Map
from evaluation.stability.trials import Cell, Outcome
from host.output_files import whole_file

FOLDER = "stability"
_SUMMARY_HEADER = "| method | map | holds for | boundary | what a person gets | remedy |"
_MAP_HEADER = "| method | outcome | where | what a person gets | cause | remedy |"
_BAD_FIRST = sorted(Outcome, key=list(Outcome).index, reverse=True)
_LONGEST_EFFECT = 160

Item = TypeVar("Item")


def write(out: Path, maps: Sequence[Map], cells: Sequence[Cell]) -> None:
    """Write stability.md into `out` and, into a folder there, each map's CSV and PNG files and stability.json.

    Raises OSError.
    """
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [(each, [cell for cell in cells if cell.map == each.name]) for each in maps]
    drawn = [(each, own) for each, own in drawn if own]
    for each, own in drawn:
        write_csv(folder / f"{each.name}.csv", own)
        each.draw(folder / f"{each.name}.png", own)
    with whole_file(folder / "stability.json") as partial:
        records = ",\n".join(json.dumps(_record(cell), allow_nan=False) for cell in cells)
        partial.write_text(f"[\n{records}\n]\n", "utf-8")
    with whole_file(out / "stability.md") as partial:
        partial.write_text(markdown(drawn), "utf-8")


def write_csv(path: Path, cells: Sequence[Cell]) -> None:
    """Write cells, a row each, their figures in columns of their own. Raises OSError."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.figures))
    with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["method", "case", "setting", "value", "outcome", *names, "effect"])
        for cell in cells:
            figures = ("" if cell.figures.get(name) is None else cell.figures[name] for name in names)
            value = "" if cell.value is None else cell.value
            table.writerow([cell.method, cell.case, cell.setting, value, cell.outcome, *figures, cell.effect])


def markdown(maps: Sequence[tuple[Map, Sequence[Cell]]]) -> str:
    """Return the page."""
    lines = [
        "# Where methods hold and where they fail",
        "",
        "Written by `vibrocast stability`. Every boundary here is of that run, on generated signals and the simulated",
        "controller; beside each picture lie its data, as CSV of the same name.",
        "",
        _SUMMARY_HEADER,
        "|---" * (_SUMMARY_HEADER.count("|") - 1) + "|",
        *(row for each, cells in maps if each.in_summary for row in _summary_rows(each, cells)),
        "",
    ]
    for each, cells in maps:
        lines += ["", f"## {each.title}", "", each.about, "", f"![{each.title}]({FOLDER}/{each.name}.png)", ""]
        methods = _grouped(cells, lambda cell: cell.method)
        held = [method for method, own in methods.items() if all(cell.sound for cell in own)]
        if held:
            lines += [f"Holds everywhere: {', '.join(held)}.", ""]
        if rows := _map_rows(each, cells):
            lines += [_MAP_HEADER, "|---" * (_MAP_HEADER.count("|") - 1) + "|", *rows, ""]
    return "\n".join(lines)


def where(each: Map, cells: Sequence[Cell], method_cells: Sequence[Cell]) -> str:
    """Return in words where some of a method's cells lie: ranges of what is varied by case, or cases by settings."""
    if each.varied:
        parts = []
        for case, own in _grouped(cells, lambda cell: cell.case).items():
            of_case = [cell.value or 0.0 for cell in method_cells if cell.case == case]
            parts.append((ranges([cell.value or 0.0 for cell in own], of_case), case))
        if len({cell.case for cell in method_cells}) == 1:
            return f"{parts[0][0]} {each.varied}"
        joined = _grouped(parts, lambda part: part[0])
        return "; ".join(f"{', '.join(case for _, case in own)}: {text} {each.varied}" for text, own in joined.items())
    settings: dict[str, list[str]] = {}
    for case, own in _grouped(cells, lambda cell: cell.case).items():
        levels = [cell.setting.partition(":")[0] for cell in own]
        everywhere = len(own) == sum(cell.case == case for cell in method_cells)
        settings.setdefault("" if everywhere else f" ({', '.join(levels)})", []).append(case)
    return "; ".join(f"{', '.join(cases)}{levels}" for levels, cases in sorted(settings.items()))


def _grouped(items: Sequence[Item], key: Callable[[Item], str]) -> dict[str, list[Item]]:
    groups: dict[str, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def ranges(values: Sequence[float], all_values: Sequence[float]) -> str:
    """Return values as ranges of neighbours among all values: "0.1 to 0.3, 1"."""
    order = sorted(all_values)
    runs: list[list[float]] = []
    for value in sorted(values):
        follows = runs and order.index(value) == order.index(runs[-1][-1]) + 1
        if follows:
            runs[-1].append(value)
        else:
            runs.append([value])
    return ", ".join(f"{run[0]:g}" if len(run) == 1 else f"{run[0]:g} to {run[-1]:g}" for run in runs)


def _summary_rows(each: Map, cells: Sequence[Cell]) -> list[str]:
    """Return a row for each set of methods with the same boundary."""
    rows: dict[tuple[str, str, str], list[tuple[str, Cell | None]]] = {}
    for method, own in _grouped(cells, lambda cell: cell.method).items():
        bad = [cell for cell in own if not cell.sound]
        boundary = "; ".join(
            f"{outcome}: {where(each, some, own)}"
            for outcome in _BAD_FIRST
            if (some := [cell for cell in bad if cell.outcome is outcome])
        )
        held = f"{len(own) - len(bad)} of {len(own)}" if bad else "all"
        key = (each.title, held, boundary or "none found")
        rows.setdefault(key, []).append((method, min(bad, key=_worst_first, default=None)))
    return [_row([*(method for method, _ in some)], key, [worst for _, worst in some]) for key, some in rows.items()]


def _map_rows(each: Map, cells: Sequence[Cell]) -> list[str]:
    """Return a row for each cause, outcome and set of methods with the same boundary."""
    rows: dict[tuple[str, str, str], list[tuple[str, Cell]]] = {}
    for method, own in _grouped(cells, lambda cell: cell.method).items():
        groups: dict[tuple[Outcome, str], list[Cell]] = {}
        for cell in own:
            if cell.outcome is not Outcome.HOLDS:
                groups.setdefault((cell.outcome, explanation(cell)[0]), []).append(cell)
        for (outcome, cause), some in sorted(groups.items(), key=lambda group: _BAD_FIRST.index(group[0][0])):
            key = (outcome, where(each, some, own), cause)
            rows.setdefault(key, []).append((method, min(some, key=_worst_first)))
    return [
        _row([method for method, _ in some], key[:2], [worst for _, worst in some], key[2])
        for key, some in rows.items()
    ]


def _row(methods: Sequence[str], columns: Sequence[str], worst: Sequence[Cell | None], *cause: str) -> str:
    """Return a row of a table: what the worst cell of all methods gave, and the remedy."""
    known = [cell for cell in worst if cell is not None]
    effect, remedy = "", ""
    if known:
        cell = min(known, key=_worst_first)
        effect, remedy = _short(cell.effect), explanation(cell)[1]
        if len(methods) > 1 and not cell.to_be_refused:
            effect += f" ({cell.method})"
    return f"| {' | '.join([', '.join(methods), *columns, effect, *cause, remedy])} |"


def _worst_first(cell: Cell) -> tuple[int, float]:
    snr_db = cell.figure("snr_db")
    return _BAD_FIRST.index(cell.outcome), math.inf if math.isnan(snr_db) else snr_db


def _short(effect: str) -> str:
    text = effect.replace("|", "/")
    return text if len(text) <= _LONGEST_EFFECT else text[: _LONGEST_EFFECT - 1] + "…"


def _record(cell: Cell) -> dict[str, object]:
    """Return a cell for JSON, which has no infinity: as text."""
    figures = {
        name: value if value is None or math.isfinite(value) else str(value) for name, value in cell.figures.items()
    }
    return {**vars(cell), "figures": figures}
