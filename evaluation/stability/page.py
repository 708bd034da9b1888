"""Writes what the trials showed: CSV files and a picture for each map, and the page with failures and remedies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vibrocast import pages
from vibrocast.codec import CODECS
from vibrocast.errors import InputError
from vibrocast.evaluation.points import read_row, write_rows
from vibrocast.evaluation.stability import pictures
from vibrocast.evaluation.stability.cell_files import read_cells, write_cells
from vibrocast.evaluation.stability.known_causes import CRASH, explanation, known_causes
from vibrocast.evaluation.stability.maps import Group, Map, ranges
from vibrocast.evaluation.stability.trials import Outcome, Verdict
from vibrocast.evaluation.tables import grouped

PAGE, FOLDER = "stability.md", "stability"
TITLE = "# Where codecs hold and where they fail"
WITHOUT_WAVEFORM = tuple(name for name, known in CODECS.items() if not known.keeps_waveform)
"""Codecs that lose the waveform by design: most maps compare waveforms, so that their shares say nothing."""
_MAX_CASES = 2
"""Cases that a sentence names; the CSV files have all."""
_MAX_METHODS = 5
_FAMILY = 3
"""So many methods of one prefix are named together."""
_BAD_FIRST = sorted(Outcome, key=list(Outcome).index, reverse=True)


@dataclass(frozen=True)
class Description:
    """The command that a page was made by."""

    command: str


@dataclass(frozen=True)
class Failure:
    """A failure on a map in words: with which methods, under which conditions, and the remedy."""

    map: Map
    failure: str
    methods: str
    boundary: str
    remedy: str


@dataclass(frozen=True)
class Boundary:
    """Where a method has an outcome for one reason; `conditions` of `all_conditions` of the map."""

    map: str
    method: str
    outcome: str
    conditions: int
    all_conditions: int
    where: str
    worst_effect: str
    failure: str
    cause: str
    remedy: str


def folder_in(out: Path) -> Path:
    """Make the folder of the maps in `out` and return it. Raises InputError where a page of other origin stands there,
    OSError where the folder cannot be made.
    """
    page = out / PAGE
    if page.exists() and not page.read_bytes().startswith(TITLE.encode()):
        raise InputError(f"{page}: would be overwritten, but is no page of stability; choose another --out")
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write(
    out: Path, maps: Sequence[Map], cells: Sequence[Verdict], command: str, redrawn: bool = False
) -> list[Failure]:
    """Write stability.md into `out` and, into a folder there, each map's CSV file and picture; return the failures.

    `command`: what was run. `redrawn`: the page there is of these cells. Raises OSError, and as folder_in.
    """
    folder = folder_in(out)
    drawn = [(each, own) for each in maps if (own := [cell for cell in cells if cell.map == each.name])]
    for each, own in drawn:
        write_cells(folder / f"{each.name}.csv", each, own)
    names = {each.name: pictures.write(folder, each, own) for each, own in drawn}
    write_rows(folder / "description.csv", [Description(command)], Description)
    write_rows(folder / "boundaries.csv", [row for each, own in drawn for row in boundaries(each, own)], Boundary)
    pages.write_figures(out / PAGE, markdown(drawn, names, command), redrawn)
    return failures(drawn)


def redraw(out: Path, maps: Sequence[Map]) -> list[Failure]:
    """Write the page and its pictures again from the CSV files of an earlier run; return the failures.

    Raises OSError where one cannot be read or written, InputError where one is no such file, and as folder_in.
    """
    folder = folder_in(out)
    description = read_row(folder / "description.csv", Description)
    found = [(each, path) for each in maps if (path := folder / f"{each.name}.csv").exists()]
    cells = [cell for each, path in found for cell in read_cells(path, each)]
    return write(out, maps, cells, description.command, redrawn=True)


def markdown(maps: Sequence[tuple[Map, Sequence[Verdict]]], names: dict[str, str], command: str) -> str:
    """Return the page. `names`: of the pictures' files, by map."""
    every = [cell for _, cells in maps for cell in cells]
    in_group: dict[Group, list[tuple[Map, bool]]] = {}
    for each, cells in maps:
        in_group.setdefault(each.group, []).append((each, all(cell.sound for cell in cells)))
    rules: dict[tuple[str, str, str], list[str]] = {}
    for each, _ in maps:
        rules.setdefault(each.rule, []).append(each.title)
    return pages.render(
        Path(__file__).with_name("stability.md.jinja"),
        title=TITLE,
        command=command,
        folder=FOLDER,
        link=_link,
        conditions=len(every),
        held=sum(cell.sound for cell in every),
        shares=_shares(maps),
        left_out=[name for name in WITHOUT_WAVEFORM if any(cell.method == name for cell in every)],
        failures=failures(maps),
        rules=rules,
        groups=in_group,
        names=names,
        messages={each.name: each.message(cells) for each, cells in maps},
    )


def _shares(maps: Sequence[tuple[Map, Sequence[Verdict]]]) -> list[tuple[str, int]]:
    """Return in how many percent of the conditions of the maps that all have in common each method holds.

    The first method stays first; the others are in the order of their shares. WITHOUT_WAVEFORM is left out.
    """
    of_maps = [frozenset(cell.method for cell in cells) for _, cells in maps]
    methods = max(of_maps, key=lambda own: (of_maps.count(own), len(own)), default=frozenset())
    common = [cell for (_, cells), own in zip(maps, of_maps, strict=True) if methods <= own for cell in cells]
    kept = [cell for cell in common if cell.method in methods.difference(WITHOUT_WAVEFORM)]
    shares = [
        (method, math.floor(100 * sum(cell.sound for cell in own) / len(own)))
        for method, own in grouped(kept, lambda cell: cell.method).items()
    ]
    return [*shares[:1], *sorted(shares[1:], key=lambda each: -each[1])]


def failures(maps: Sequence[tuple[Map, Sequence[Verdict]]]) -> list[Failure]:
    """Return the failures that have words: crashes, then in the order of known_causes.csv, then those not known."""
    order = [(known.map, known.failure) for known in known_causes()]

    def place(row: Failure) -> int:
        key = row.map.name, row.failure
        return -1 if row.failure == CRASH.failure else order.index(key) if key in order else len(order)

    found = []
    for each, cells in maps:
        unsound = [cell for cell in cells if not cell.sound]
        for failure, own in grouped(unsound, lambda cell: explanation(cell).failure).items():
            if failure:
                methods, remedy = _named(own, cells), explanation(own[0]).remedy
                found.append(Failure(each, failure, methods, boundary(each, own, cells), remedy))
    return sorted(found, key=place)


def _named(own: Sequence[Verdict], cells: Sequence[Verdict]) -> str:
    """Return the methods of some cells in words, against all of the map's."""
    every = list(dict.fromkeys(cell.method for cell in cells))
    affected = {cell.method for cell in own}
    if len(affected) == len(every) > 1:
        return "both" if len(every) == 2 else f"all {len(every)}"
    missing = [method for method in every if method not in affected]
    if len(missing) < len(affected) and len(missing) <= _MAX_METHODS and len(affected) > _FAMILY:
        return f"all but {pages.listed(_families(missing, every))}"
    names = _families([method for method in every if method in affected], every)
    return pages.listed(names) if len(names) <= _MAX_METHODS else f"{len(affected)} of {len(every)}"


def _families(methods: Sequence[str], every: Sequence[str]) -> list[str]:
    """Return methods, those of one prefix together where all of them are among these."""
    names: dict[str, None] = {}
    for method in methods:
        prefix = method.partition("-")[0] + "-"
        family = [each for each in every if each.startswith(prefix)]
        together = len(family) >= _FAMILY and set(family) <= set(methods)
        names[f"{prefix}*" if together else method] = None
    return list(names)


def boundary(each: Map, own: Sequence[Verdict], cells: Sequence[Verdict]) -> str:
    """Return in words under which conditions a failure's cells lie, the worst outcome first."""
    parts, named, cases = [], set(), len({cell.case for cell in cells})
    for outcome in _BAD_FIRST:
        of_outcome = [cell for cell in own if cell.outcome is outcome]
        keys = dict.fromkeys(cell.value if each.varied else cell.case for cell in of_outcome)
        new = [key for key in keys if key not in named]
        named.update(new)
        if each.varied and new:
            values = ranges([key for key in new if isinstance(key, float)], _values(cells))
            parts.append(f"{outcome}: {each.varied.format(values)}")
        elif len(new) > max(_MAX_CASES + 1, cases / 2):
            parts.append(f"{outcome}: {len(new)} of {cases} cases")
        elif new:
            # "1 more" would take the room of the one.
            named_cases = new if len(new) <= _MAX_CASES + 1 else [*new[:_MAX_CASES], f"{len(new) - _MAX_CASES} more"]
            parts.append(f"{outcome}: {', '.join(map(str, named_cases))}")
    return "; ".join(parts)


def boundaries(each: Map, cells: Sequence[Verdict]) -> list[Boundary]:
    """Return a row for each method, outcome and cause."""
    rows = []
    for method, own in grouped(cells, lambda cell: cell.method).items():
        kinds = grouped(own, lambda cell: (list(Outcome).index(cell.outcome), explanation(cell)))
        for (place, known), some in sorted(kinds.items()):
            worst = min(some, key=_worst_first)
            rows.append(
                Boundary(
                    each.name,
                    method,
                    list(Outcome)[place],
                    len(some),
                    len(own),
                    where(each, some, own),
                    worst.effect,
                    *known,
                )
            )
    return rows


def where(each: Map, cells: Sequence[Verdict], method_cells: Sequence[Verdict]) -> str:
    """Return in words where some of a method's cells lie: ranges of the varied value by case, or cases by settings."""
    if len(cells) == len(method_cells):
        return "everywhere"
    named: dict[str, list[str]] = {}
    for case, own in grouped(cells, lambda cell: cell.case).items():
        of_case = [cell for cell in method_cells if cell.case == case]
        if each.varied and any(cell.value is not None for cell in own):
            values = each.varied.format(ranges(_values(own), _values(of_case)))
        else:
            values = "" if len(own) == len(of_case) else ", ".join(cell.setting.partition(":")[0] for cell in own)
        named.setdefault(values, []).append(case)
    if each.varied and len({cell.case for cell in method_cells}) == 1:
        return next(iter(named))
    return "; ".join(f"{', '.join(some)} ({values})" if values else ", ".join(some) for values, some in named.items())


def _values(cells: Sequence[Verdict]) -> list[float]:
    return [cell.value for cell in cells if cell.value is not None]


def _link(text: str, title: str) -> str:
    return f"[{text}](#{title.lower().replace(' ', '-')})"


def _worst_first(cell: Verdict) -> float:
    """Return what sorts cells of one outcome by SNR, or where they have none by the first figure."""
    first = next(iter(cell.figures), "")
    height = cell.figure("snr_db") if "snr_db" in cell.figures else -cell.figure(first)
    return math.inf if math.isnan(height) else height
