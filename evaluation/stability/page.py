"""Writes what the trials showed: CSV files and a picture for each map, and the page with failures and remedies."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import polars as pl

from vibrocast import pages
from vibrocast.codec import CODECS
from vibrocast.errors import InputError
from vibrocast.evaluation.points import read_row, write_rows
from vibrocast.evaluation.stability import pictures
from vibrocast.evaluation.stability.known_causes import CRASH, known_causes
from vibrocast.evaluation.stability.maps import Cells, Map, explained, ranges
from vibrocast.evaluation.stability.trials import Outcome
from vibrocast.evaluation.tables import write_table
from vibrocast.files import atomic_write

PAGE, FOLDER = "stability.md", "stability"
TITLE = "# Where codecs hold and where they fail"
WITHOUT_WAVEFORM = tuple(name for name, known in CODECS.items() if not known.keeps_waveform)
"""Codecs that lose the waveform by design: most maps compare waveforms, so that their shares say nothing."""
_MAX_CASES = 2
"""Cases that a sentence names; the CSV files have all."""
_MAX_METHODS = 5
_FEW = 3
"""So many methods are named, rather than the others."""
_WORST_FIRST = tuple(reversed(Outcome))
Results: TypeAlias = Mapping[Map, Cells]
"""The maps that have cells, each with these."""


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


def write(out: Path, results: Results, command: str, redrawn: bool = False) -> list[Failure]:
    """Write stability.md into `out` and, into a folder there, each map's CSV file and picture; return the failures.

    `command`: what was run. `redrawn`: the page there is of these cells. Raises OSError, and as folder_in.
    """
    folder = folder_in(out)
    known = {each: explained(each.name, cells) for each, cells in results.items() if len(cells)}
    for each, cells in known.items():
        empty = [] if each.words.varied else ["value"]
        with atomic_write(folder / f"{each.name}.csv") as partial:
            write_table(
                partial, cells.drop("failure", "sound", *empty).rename({"value": each.words.value_name}, strict=False)
            )
        pictures.write(folder / f"{each.name}.svg", each, cells)
    write_rows(folder / "description.csv", [Description(command)], Description)
    write_table(folder / "boundaries.csv", pl.concat([boundaries(*each) for each in known.items()]))
    pages.write_figures(out / PAGE, markdown(known, command), redrawn)
    return failures(known)


def read_cells(path: Path, each: Map) -> Cells:
    """Return the cells of a map's CSV file. Raises InputError where it is none, OSError."""
    try:
        table = pl.read_csv(path, infer_schema=False).rename({each.words.value_name: "value"}, strict=False)
        if not each.words.varied:
            table = table.with_columns(value=pl.lit(None, pl.String))
        names = ("method", "case", "setting", "value", "required", "outcome")
        texts = [name for name in table.columns if name in (*names, "effect") and name != "value"]
        figures = [name for name in table.columns if name not in (*names, "effect", "cause", "remedy")]
        table = table.select(*names, *figures, "effect").with_columns(
            pl.col(texts).fill_null(""), pl.col("value", *figures).cast(pl.Float64)
        )
        if unknown := {*table["required"], *table["outcome"]}.difference(Outcome):
            raise ValueError(f"unknown outcomes {unknown}")
        return table
    except (pl.exceptions.PolarsError, ValueError) as error:
        raise InputError(f"{path}: no cells of this map ({error!r}); run `vibrocast stability` again") from error


def redraw(out: Path, maps: Sequence[Map]) -> list[Failure]:
    """Write the page and its pictures again from the CSV files of an earlier run; return the failures.

    Raises OSError where one cannot be read or written, InputError where one is no such file, and as folder_in.
    """
    folder = folder_in(out)
    description = read_row(folder / "description.csv", Description)
    found = {each: path for each in maps if (path := folder / f"{each.name}.csv").exists()}
    return write(out, {each: read_cells(path, each) for each, path in found.items()}, description.command, redrawn=True)


def markdown(results: Results, command: str) -> str:
    """Return the page."""
    every = pl.concat([cells.select("method", "sound") for cells in results.values()])
    shares = _shares(results)
    groups: dict[str, list[tuple[Map, bool]]] = {}
    rules: dict[tuple[str, str, str], list[str]] = {}
    for each, cells in results.items():
        groups.setdefault(each.words.group, []).append((each, cells["sound"].all()))
        rules.setdefault(each.rule, []).append(each.words.title)
    return pages.render(
        Path(__file__).with_name("stability.md.jinja"),
        title=TITLE,
        command=command,
        folder=FOLDER,
        link=_link,
        conditions=len(every),
        held=every["sound"].sum(),
        shares=shares,
        left_out=[name for name in WITHOUT_WAVEFORM if name in every["method"]],
        failures=failures(results),
        of_first=failures(results, shares[0][0]) if len(shares) > 1 else [],
        rules=rules,
        groups=groups,
        messages={each.name: each.message(cells) for each, cells in results.items()},
    )


def _shares(results: Results) -> list[tuple[str, int]]:
    """Return in how many percent of the conditions of the maps that all have in common each method holds.

    The first method stays first; the others are in the order of their shares. WITHOUT_WAVEFORM is left out.
    """
    of_maps = [frozenset(cells["method"]) for cells in results.values()]
    methods = max(of_maps, key=lambda own: (of_maps.count(own), len(own)))
    common = [
        cells.select("method", "sound") for cells, own in zip(results.values(), of_maps, strict=True) if methods <= own
    ]
    kept = pl.concat(common).filter(pl.col("method").is_in(methods.difference(WITHOUT_WAVEFORM)))
    shares = kept.group_by("method", maintain_order=True).agg((100 * pl.mean("sound")).floor().cast(int)).rows()
    return [*shares[:1], *sorted(shares[1:], key=lambda each: -each[1])]


def failures(results: Results, only: str = "") -> list[Failure]:
    """Return the failures that have words: crashes, then in the order of known_causes.csv, then those not known.

    `only`: those of this method and of its variants, such as "mdct, its own pace", each with its own limits.
    """
    order = [(known.map, known.failure) for known in known_causes()]

    def place(row: Failure) -> int:
        key = row.map.name, row.failure
        return -1 if row.failure == CRASH.failure else order.index(key) if key in order else len(order)

    found = []
    for each, cells in results.items():
        unsound = cells.filter(~pl.col("sound") & (pl.col("failure") != ""))
        keys = ["failure"]
        if only:
            unsound = unsound.filter(pl.col("method").str.split(", ").list.first() == only)
            keys.append("method")
        for (failure, *_), own in unsound.group_by(keys, maintain_order=True):
            where = boundary(each, own, cells)
            found.append(Failure(each, str(failure), _named(own, cells), where, own["remedy"][0]))
    return sorted(found, key=place)


def _named(own: Cells, cells: Cells) -> str:
    """Return the methods of some cells in words, against all of the map's."""
    every = cells["method"].unique(maintain_order=True).to_list()
    affected = [method for method in every if method in own["method"]]
    missing = [method for method in every if method not in affected]
    if not missing and len(every) > 1:
        return "both" if len(every) == 2 else f"all {len(every)}"
    if len(missing) < len(affected) and len(missing) <= _MAX_METHODS and len(affected) > _FEW:
        return f"all but {pages.listed(missing)}"
    return pages.listed(affected) if len(affected) <= _MAX_METHODS else f"{len(affected)} of {len(every)}"


def boundary(each: Map, own: Cells, cells: Cells) -> str:
    """Return in words under which conditions a failure's cells lie, the worst outcome first."""
    parts, named, cases = [], set[Hashable](), cells["case"].n_unique()
    key = "value" if each.words.varied else "case"
    for outcome in _WORST_FIRST:
        keys = own.filter(outcome=outcome)[key].unique(maintain_order=True)
        new = [one for one in keys if one not in named]
        named.update(new)
        if each.words.varied and new:
            parts.append(f"{outcome}: {each.varied(ranges(new, _values(cells)))}")
        elif len(new) > max(_MAX_CASES + 1, cases / 2):
            parts.append(f"{outcome}: {len(new)} of {cases} cases")
        elif new:
            # "1 more" would take the room of the one.
            named_cases = new if len(new) <= _MAX_CASES + 1 else [*new[:_MAX_CASES], f"{len(new) - _MAX_CASES} more"]
            parts.append(f"{outcome}: {', '.join(named_cases)}")
    return "; ".join(parts)


def boundaries(each: Map, cells: Cells) -> pl.DataFrame:
    """Return a row for each method, outcome and cause: where the method has the outcome for that reason, and how bad.

    `conditions` of `all_conditions` of the map. `worst_effect`: of the lowest SNR, or without one the highest figure.
    """
    height = pl.col("snr_db") if "snr_db" in cells.columns else -pl.nth(cells.columns.index("outcome") + 1)
    known = ("failure", "cause", "remedy")
    order = (pl.col("outcome").cast(pl.Enum(Outcome)), *known)
    rows = []
    for (method,), every in cells.group_by("method", maintain_order=True):
        in_order = every.sort(order, maintain_order=True)
        for (outcome, *causes), own in in_order.group_by("outcome", *known, maintain_order=True):
            effect = own.sort(height, nulls_last=True, maintain_order=True)["effect"][0]
            counts = len(own), len(every)
            rows.append((each.name, method, outcome, *counts, where(each, own, every), effect, *causes))
    columns = ("map", "method", "outcome", "conditions", "all_conditions", "where", "worst_effect", *known)
    return pl.DataFrame(rows, columns, orient="row")


def where(each: Map, cells: Cells, method_cells: Cells) -> str:
    """Return in words where some of a method's cells lie: ranges of the varied value by case, or cases by settings."""
    if len(cells) == len(method_cells):
        return "everywhere"
    named: dict[str, list[str]] = {}
    for (case,), own in cells.group_by("case", maintain_order=True):
        of_case = method_cells.filter(case=case)
        if _values(own):
            values = each.varied(ranges(_values(own), _values(of_case)))
        else:
            values = "" if len(own) == len(of_case) else ", ".join(text.partition(":")[0] for text in own["setting"])
        named.setdefault(values, []).append(str(case))
    if each.words.varied and method_cells["case"].n_unique() == 1:
        return next(iter(named))
    return "; ".join(f"{', '.join(some)} ({values})" if values else ", ".join(some) for values, some in named.items())


def _values(cells: Cells) -> list[float]:
    return cells["value"].drop_nulls().to_list()


def _link(text: str, title: str) -> str:
    return f"[{text}](#{title.lower().replace(' ', '-')})"
