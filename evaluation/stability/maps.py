"""The parts of a map: rows of trials, the rule of their outcomes, its words, and the table of what they showed."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import polars as pl

from vibrocast.codec import CODECS
from vibrocast.errors import InputError
from vibrocast.evaluation.cells import Method, RatePoint, families
from vibrocast.evaluation.stability.known_causes import explanation
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial
from vibrocast.models import Model
from vibrocast.pages import listed
from vibrocast.textures import Recording
from vibrocast.toml_tables import Table, convert, read_toml

LEVELS = ("low", "middle", "high")
"""The names of a method's three rate points: a quarter of the way up, half of it, and the finest."""
WORDS = Path(__file__).with_name("maps.toml")
_MAX_NAMED = 4
Item = TypeVar("Item")
Cells: TypeAlias = pl.DataFrame
"""A row for each trial: `method`, `case`, `setting`, `value`, `required` and `outcome`, a column for each figure, and
`effect`. Explained ones also have `failure`, `cause`, `remedy`, and `sound`: whether the outcome is the required one.
"""


@dataclass(frozen=True)
class Scope:
    """How much to try: codecs and families of models, all conditions or a few, and the user's recordings."""

    methods: tuple[Method, ...]
    quick: bool
    recordings: tuple[Recording, ...] = ()

    @property
    def learned(self) -> tuple[Method, ...]:
        """The methods with trained models."""
        return tuple(method for method in self.methods if method.models)

    def has(self, codec: str) -> bool:
        """Return whether a codec is among the methods, with its built-in tables."""
        return any(method.name == codec for method in self.methods)

    def some(self, values: Sequence[Item], step: int) -> Sequence[Item]:
        """Return values: all, or in a quick run every `step`-th of them."""
        return values[::step] if self.quick else values


def at_levels(scope: Scope) -> Iterator[Trial]:
    """Yield the beginnings of trials of every method at its three rate points."""
    for method in scope.methods:
        for level, rate_point in three_rate_points(method).items():
            yield Trial(method.name, setting=f"{level}: {rate_point.text}", rate_points=(rate_point,))


def at_middle(scope: Scope) -> Iterator[Trial]:
    """Yield those of at_levels that are of the middle rate point."""
    return (begun for begun in at_levels(scope) if begun.level == LEVELS[1])


def at_level(level: str, methods: Iterable[Method]) -> Iterator[Trial]:
    """Yield the beginnings of trials of methods at one of LEVELS."""
    for method in methods:
        rate_point = three_rate_points(method)[level]
        yield Trial(method.name, setting=rate_point.text, rate_points=(rate_point,))


@dataclass(frozen=True)
class Row:
    """A row of a map: what `measure` tries, on each beginning of a trial, in each case, with each value.

    Without `cases` or `values`, those of the beginnings count. A quick run tries every `case_step`-th case and every
    `value_step`-th value. `rejected`: the cases that must be rejected.
    """

    measure: Callable[[Trial], Measured]
    beginnings: Callable[[Scope], Iterable[Trial]]
    cases: Sequence[str] = ()
    values: Sequence[float] = ()
    case_step: int = 1
    value_step: int = 1
    rejected: Collection[str] = ()

    def trials(self, scope: Scope) -> Iterator[Trial]:
        """Yield the trials of the row."""
        for begun in self.beginnings(scope):
            for case in scope.some(self.cases, self.case_step) or [begun.case]:
                for value in scope.some(self.values, self.value_step) or [begun.value]:
                    rejected = case in self.rejected
                    yield replace(begun, case=case, value=value, measure=self.measure, to_be_rejected=rejected)


class Group(StrEnum):
    """A section of the page."""

    SIGNALS = "Signals"
    SETTINGS = "Settings"
    LINK = "The link"
    OUTPUT = "Hand and actuator"
    LEARNED = "Learned codecs"
    OTHERS = "Other codecs"


class Words(Table, frozen=True):
    """The words of a map, a table of maps.toml; braces hold constants of the map's module, or what `Map.message` says.

    `tried`: one or two sentences about the trials. `measured`: which figure decides an outcome, with its limits in
    words; what lies between them is degraded. `message`: what the cells show, the picture's title; `noun`: a method.
    `caption`: of the columns. `row`, `column`, `heading`: where the picture shows a cell; without `column`, the value,
    or else the case. `label`: the figure in a cell; without one, the letter of its outcome. `value_name`: the CSV
    column of the varied value, with its unit; `varied`: how a sentence says such a value.
    """

    group: Group
    title: str
    tried: str
    measured: str
    holds: str
    fails: str
    message: str
    caption: str = ""
    noun: str = "codec"
    row: str = "{method}"
    column: str = ""
    heading: str = ""
    label: str = ""
    value_name: str = "value"
    varied: str = ""


_WORDS = {name: convert(table, Words) for name, table in read_toml(WORDS, "table of maps").items()}


@dataclass(frozen=True, eq=False)
class Map:
    """One map: its name, as of its files; its rows; the constants of its module; its words.

    `judged` corrects outcomes that depend on other cells.
    """

    name: str
    constants: Mapping[str, Any] = field(repr=False)
    rows: Sequence[Row] = ()
    judged: Callable[[Cells], Cells] = lambda cells: cells

    @property
    def words(self) -> Words:
        """The words of the map, as they stand in maps.toml."""
        return _WORDS[self.name]

    @property
    def tried(self) -> str:
        """One or two sentences about the trials."""
        return self.words.tried.format_map(self.constants)

    @property
    def rule(self) -> tuple[str, str, str]:
        """What is measured, when a trial holds, and when it fails."""
        measured, holds, fails = (
            text.format_map(self.constants) for text in (self.words.measured, self.words.holds, self.words.fails)
        )
        return measured, holds, fails

    def trials(self, scope: Scope) -> list[Trial]:
        """Return the trials of the map."""
        return [replace(trial, map=self.name) for row in self.rows for trial in row.trials(scope)]

    def message(self, cells: Cells) -> str:
        """Return what the cells show, in words.

        {methods}: with which methods all cells are sound. {hardest}: the cases at which most are not. {values}: the
        values at which every cell is sound; {most}: at which at least half are.
        """
        shares = cells.drop_nulls("value").group_by("value").agg(pl.mean("sound")).sort("value")
        every = shares["value"].to_list()
        values, most = (
            self.varied(ranges(shares.filter(pl.col("sound") >= least)["value"].to_list(), every)) for least in (1, 0.5)
        )
        found = {"methods": with_methods(cells, self.words.noun), "hardest": hardest(cells)}
        return self.words.message.format_map({**self.constants, **found, "values": values, "most": most})

    def varied(self, values: str) -> str:
        """Return how a sentence says values of the map."""
        return self.words.varied.format(values or "no")


def table(trials: Sequence[Trial], measured: Sequence[Measured]) -> Cells:
    """Return the cells of one map's trials, each with its cause and remedy."""
    figures = dict.fromkeys(name for each in measured for name in each.figures)
    rows = [
        {
            **{name: getattr(trial, name) for name in ("method", "case", "setting", "value")},
            "required": Outcome.REJECTED if trial.to_be_rejected else Outcome.HOLDS,
            "outcome": each.outcome,
            # A zero is added because a small negative figure would be rounded to -0.0.
            **{name: None if value is None else round(float(value), 4) + 0.0 for name, value in each.figures.items()},
            "effect": each.effect,
        }
        for trial, each in zip(trials, measured, strict=True)
    ]
    before, numbers = ("method", "case", "setting"), dict.fromkeys(figures, pl.Float64)
    schema = {**dict.fromkeys(before, pl.String), "value": pl.Float64, "required": pl.String, "outcome": pl.String}
    return pl.DataFrame(rows, {**schema, **numbers, "effect": pl.String}).with_columns(pl.col("value").fill_nan(None))


def explained(name: str, cells: Cells) -> Cells:
    """Return the cells of a map, with what is known of each outcome, and whether it is sound."""
    known = [explanation(name, *cell) for cell in cells.select("method", "case", "outcome", "effect").iter_rows()]
    return cells.with_columns(
        *(pl.Series(each, map(attrgetter(each), known), pl.String) for each in ("failure", "cause", "remedy")),
        sound=pl.col("outcome") == pl.col("required"),
    )


def methods(names: Collection[str] | None, models: Sequence[Model]) -> tuple[Method, ...]:
    """Return the codecs of these names, each with its first set of rate points, and the families of models.

    A name is that of a family, or of a codec, which includes its families; None means all. Raises InputError for other
    names, and where no method is left.
    """
    of_codecs = [
        Method(name, tuple(RatePoint(name, setting) for setting in codec.rate_points))
        for name, codec in CODECS.items()
        if not codec.needs_model
    ]
    every = [*of_codecs, *families(models)]
    known = {name for method in every for name in (method.name, str(method.coder))}
    if names is not None and not (names and set(names) <= known):
        raise InputError(f"{','.join(names)!r} is no list of codecs; choose from {', '.join(sorted(known))}")
    return tuple(method for method in every if names is None or {method.name, method.coder} & set(names))


def three_rate_points(method: Method) -> dict[str, RatePoint]:
    """Return rate points of a method by LEVELS."""
    points = method.rate_points
    return dict(zip(LEVELS, (points[len(points) // 4], points[len(points) // 2], points[-1]), strict=True))


def with_methods(cells: Cells, noun: str = "codec") -> str:
    """Return in words for which methods all cells are sound: "with every codec", "with flac and g726 only"."""
    methods = cells.group_by("method", maintain_order=True).agg(pl.all("sound"))
    sound = methods.filter("sound")["method"].to_list()
    if len(sound) in (0, len(methods)):
        return f"with {'every' if sound else 'no'} {noun}"
    if len(sound) > _MAX_NAMED:
        return f"with {len(sound)} of {len(methods)} {noun}s"
    return f"with {listed(sound)} only"


def hardest(cells: Cells) -> str:
    """Return the three cases at which most methods are not sound, with their counts, in words."""
    unsound = cells.filter(~pl.col("sound")).group_by("case", maintain_order=True).agg(pl.n_unique("method"))
    ranked = unsound.sort("method", descending=True, maintain_order=True).head(3).rows()
    if not ranked:
        return "none of them is hard for any"
    of = f" of {cells['method'].n_unique()} codecs"
    return listed(f"{case} ({count}{of if place == 0 else ''})" for place, (case, count) in enumerate(ranked))


def ranges(values: Sequence[float], all_values: Sequence[float]) -> str:
    """Return values as ranges of neighbours among all values: "0.1 to 0.3, 1"."""
    order = sorted(set(all_values))
    runs: list[list[float]] = []
    for value in sorted(set(values)):
        follows = runs and order.index(value) == order.index(runs[-1][-1]) + 1
        if follows:
            runs[-1].append(value)
        else:
            runs.append([value])
    return ", ".join(f"{run[0]:g}" if len(run) == 1 else f"{run[0]:g} to {run[-1]:g}" for run in runs)
