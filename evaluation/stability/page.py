"""Writes what the trials showed: data and a picture for each map, and the page that names the boundaries."""

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from vibrocast import pages
from vibrocast.evaluation.stability.known_causes import explanation
from vibrocast.evaluation.stability.maps import Map
from vibrocast.evaluation.stability.trials import Outcome, Verdict
from vibrocast.files import atomic_write

PAGE, FOLDER = "stability.md", "stability"
_TITLE = "# Where methods hold and where they fail"
_MAX_CASES = 6
"""Cases that a row names; the CSV has all."""
_BAD_FIRST = sorted(Outcome, key=list(Outcome).index, reverse=True)
_MAX_EFFECT = 160

Item = TypeVar("Item")


class PageError(ValueError):
    """The page cannot be written where it should be; the message says why."""


def folder_in(out: Path) -> Path:
    """Make the folder of the maps in `out` and return it. Raises PageError where a page of other origin stands there,
    OSError where the folder cannot be made.
    """
    page = out / PAGE
    if page.exists() and not page.read_bytes().startswith(_TITLE.encode()):
        raise PageError(f"{page}: would be overwritten, but is no page of stability; choose another --out")
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write(out: Path, maps: Sequence[Map], cells: Sequence[Verdict], methods: Sequence[str], command: str) -> None:
    """Write stability.md into `out` and, into a folder there, each map's CSV and PNG files.

    `methods`: those that were tried on all maps. `command`: what was run. Raises OSError, and as folder_in.
    """
    folder = folder_in(out)
    drawn = [(each, [cell for cell in cells if cell.map == each.name]) for each in maps]
    drawn = [(each, own) for each, own in drawn if own]
    for each, own in drawn:
        write_csv(folder / f"{each.name}.csv", own)
        each.draw(folder / f"{each.name}.png", own)
    with atomic_write(out / PAGE) as partial:
        partial.write_text(markdown(drawn, methods, command), "utf-8")


def write_csv(path: Path, cells: Sequence[Verdict]) -> None:
    """Write cells, a row each, their figures in columns of their own. Raises OSError."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.figures))
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["method", "case", "setting", "value", "outcome", *names, "effect"])
        for cell in cells:
            figures = ("" if cell.figures.get(name) is None else cell.figures[name] for name in names)
            value = "" if cell.value is None else cell.value
            table.writerow([cell.method, cell.case, cell.setting, value, cell.outcome, *figures, cell.effect])


def markdown(maps: Sequence[tuple[Map, Sequence[Verdict]]], methods: Sequence[str], command: str) -> str:
    """Return the page."""
    summed_up = [(each, cells) for each, cells in maps if each.in_summary]
    # What each method holds for is said of the maps that all of them are on.
    grouped = [(each, _grouped(cells, lambda cell: cell.method)) for each, cells in summed_up]
    common = [(each, of_map) for each, of_map in grouped if set(methods) <= set(of_map)]
    return pages.render(
        Path(__file__).with_name("stability.md.jinja"),
        title=_TITLE,
        command=command,
        folder=FOLDER,
        link=_link,
        common=[each for each, _ in common],
        codecs=[(name, [_held(each, of_map[name]) for each, of_map in common]) for name in methods],
        worst=[_worst_row(each, cells) for each, cells in summed_up],
        maps=[{"map": each, "held": _held_everywhere(cells), "rows": _map_rows(each, cells)} for each, cells in maps],
    )


def _held_everywhere(cells: Sequence[Verdict]) -> list[str]:
    of_methods = _grouped(cells, lambda cell: cell.method)
    return [method for method, own in of_methods.items() if all(cell.sound for cell in own)]


def where(each: Map, cells: Sequence[Verdict], method_cells: Sequence[Verdict], most: int = _MAX_CASES) -> str:
    """Return in words where some of a method's cells lie: ranges of what is varied by case, or cases by settings.

    No more than `most` cases are named, the others counted.
    """
    cases = list(_grouped(cells, lambda cell: cell.case).items())
    named: dict[str, list[str]] = {}
    for case, own in cases[:most]:
        of_case = [cell for cell in method_cells if cell.case == case]
        if each.varied:
            values = each.varied.format(ranges(_values(own), _values(of_case)))
        else:
            values = "" if len(own) == len(of_case) else ", ".join(cell.setting.partition(":")[0] for cell in own)
        named.setdefault(values, []).append(case)
    if each.varied and len({cell.case for cell in method_cells}) == 1:
        return next(iter(named))
    parts = [f"{', '.join(some)} ({values})" if values else ", ".join(some) for values, some in sorted(named.items())]
    return "; ".join(parts + [f"{len(cases) - most} more"] * (len(cases) > most))


def _values(cells: Sequence[Verdict]) -> list[float]:
    return [cell.value or 0.0 for cell in cells]


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


def _held(each: Map, cells: Sequence[Verdict]) -> str:
    """Return in a few words for which of a method's cells it holds: a range, where all cases share it, or a count."""
    held = [cell for cell in cells if cell.sound]
    if not held or len(held) == len(cells):
        return "all" if held else "none"
    if each.varied and len({cell.case for cell in cells}) == 1:
        return where(each, held, cells)
    return f"{len(held)} of {len(cells)}"


def _worst_row(each: Map, cells: Sequence[Verdict]) -> list[str]:
    """Return a map's row: how much of it holds, its worst method and where, what that gives, the remedy."""
    bad = [cell for cell in cells if not cell.sound]
    held = f"{len(cells) - len(bad)} of {len(cells)}"
    if not bad:
        return [_link(each), held, "none found", "", ""]
    worst = min(bad, key=_worst_first)
    alike = [cell for cell in bad if cell.method == worst.method and _kind(cell) == _kind(worst)]
    alike.sort(key=lambda cell: cell.case != worst.case)
    own = [cell for cell in cells if cell.method == worst.method]
    boundary = f"{worst.method} {worst.outcome}: {where(each, alike, own, 1)}"
    return [_link(each), held, boundary, _short(worst.effect), explanation(worst)[1]]


def _kind(cell: Verdict) -> tuple[Outcome, str]:
    return cell.outcome, explanation(cell)[0]


def _link(each: Map) -> str:
    return f"[{each.title}](#{each.title.lower().replace(' ', '-')})"


def _map_rows(each: Map, cells: Sequence[Verdict]) -> list[list[str]]:
    """Return a row for each cause, outcome and set of methods with the same boundary."""
    methods = _grouped(cells, lambda cell: cell.method)
    rows: dict[tuple[Outcome, str, str], list[Verdict]] = {}
    for own in methods.values():
        kinds: dict[tuple[Outcome, str], list[Verdict]] = {}
        for cell in own:
            if cell.outcome is not Outcome.HOLDS:
                kinds.setdefault(_kind(cell), []).append(cell)
        for (outcome, cause), some in sorted(kinds.items(), key=lambda kind: _BAD_FIRST.index(kind[0][0])):
            rows.setdefault((outcome, where(each, some, own), cause), []).append(min(some, key=_worst_first))
    table = []
    for (outcome, boundary, cause), of_methods in rows.items():
        worst = min(of_methods, key=_worst_first)
        names = [cell.method for cell in of_methods]
        together = "all" if len(names) == len(methods) > 1 else ", ".join(names)
        effect = _short(worst.effect) + (f" ({worst.method})" if len(names) > 1 and not worst.to_be_rejected else "")
        table.append([together, outcome, boundary, effect, cause, explanation(worst)[1]])
    return table


def _worst_first(cell: Verdict) -> tuple[int, float]:
    """Return what sorts cells of a map by outcome, then by SNR, or where it has none by the first figure."""
    first = next(iter(cell.figures), "")
    height = cell.figure("snr_db") if "snr_db" in cell.figures else -cell.figure(first)
    return _BAD_FIRST.index(cell.outcome), math.inf if math.isnan(height) else height


def _short(effect: str) -> str:
    text = effect.replace("|", "/")
    return text if len(text) <= _MAX_EFFECT else text[: _MAX_EFFECT - 1] + "…"
