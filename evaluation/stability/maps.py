"""The parts of a map: its trials, its rule, its picture's rows and columns, and its words."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, TypeVar

from vibrocast.codec import CODECS
from vibrocast.codec.interface import Setting
from vibrocast.errors import InputError
from vibrocast.evaluation import trained
from vibrocast.evaluation.cells import Method, families, setting_text
from vibrocast.evaluation.stability.trials import Outcome, Trial, Verdict
from vibrocast.models import Model
from vibrocast.pages import listed
from vibrocast.textures import Recording

LEVELS = ("low", "middle", "high")
"""The names of a method's three rate points."""
_MAX_NAMED = 4
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class RatePoint:
    """A codec at a setting, perhaps with a trained model; equal where all three are equal."""

    codec: str
    setting: Setting
    model: Model | None = None

    @property
    def text(self) -> str:
        """The setting as text."""
        return setting_text(self.setting)

    @property
    def image(self) -> bytes | None:
        """The packed model image, None without a model."""
        return self.model.image if self.model else None

    @property
    def trained(self) -> Model:
        """The model, at a rate point of a learned method."""
        assert self.model is not None, "a learned method has models"
        return self.model

    def _key(self) -> tuple[str, str, str]:
        return self.codec, self.text, trained.digest(self.model) if self.model else ""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RatePoint) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


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

    def three_rate_points(self) -> Iterator[tuple[str, str, "RatePoint"]]:
        """Return the name of each method, with each of its three rate points and the name of that."""
        for method in self.methods:
            for level, rate_point in three_rate_points(method).items():
                yield method.name, level, rate_point


class Group(StrEnum):
    """A section of the page."""

    SIGNALS = "Signals"
    SETTINGS = "Settings"
    LINK = "The link"
    OUTPUT = "Hand and actuator"
    LEARNED = "Learned codecs"
    OTHERS = "Other codecs"


class Rule(NamedTuple):
    """Which figure decides an outcome, and its limits, in words; what lies between them is degraded."""

    measured: str
    holds: str
    fails: str


class Place(NamedTuple):
    """Where a picture shows a cell. `group`: a heading above several columns."""

    row: str
    column: str | float
    group: str = ""


def by_value(cell: Verdict) -> Place:
    """Return the place of a cell: methods downwards, values across."""
    return Place(cell.method, cell.value or 0.0)


def by_value_and_case(cell: Verdict) -> Place:
    """Return the place of a cell: methods downwards, values across, for each case anew."""
    return Place(cell.method, cell.value or 0.0, cell.case)


def letter(cell: Verdict) -> str:
    """Return the letter of a cell's outcome, nothing where it holds."""
    return "" if cell.outcome is Outcome.HOLDS else cell.outcome.letter


def figure(name: str, form: str = ".0f", factor: float = 1.0) -> Callable[[Verdict], str]:
    """Return what writes a figure of a cell into a picture, or the outcome's letter where the figure has no value."""

    def text(cell: Verdict) -> str:
        value = cell.figures.get(name)
        return letter(cell) if value is None else f"{factor * value:z{form}}"

    return text


@dataclass(frozen=True)
class Map:
    """One map.

    `name`: of its files. `tried`: one or two sentences about the trials. `message`: what the cells show, the picture's
    title. `caption`: of the columns. `conditions`: its trials within a scope. `label`: the text within a cell.
    `value_name`: the CSV column of the varied value, with its unit; `varied`: how a sentence says such a value, as in
    "{} dB". Both are empty where nothing is varied. `judged`: corrects outcomes that depend on other cells.
    """

    name: str
    group: Group
    title: str
    tried: str
    rule: Rule
    conditions: Callable[[Scope], Iterable[Trial]]
    message: Callable[[Sequence[Verdict]], str]
    caption: str
    place: Callable[[Verdict], Place] = by_value
    label: Callable[[Verdict], str] = letter
    value_name: str = ""
    varied: str = ""
    judged: Callable[[list[Verdict]], list[Verdict]] = lambda cells: cells

    def trials(self, scope: Scope) -> list[Trial]:
        """Return the trials of the map."""
        return [replace(trial, map=self.name) for trial in self.conditions(scope)]


def methods(names: Collection[str] | None, models: Sequence[Model]) -> tuple[Method, ...]:
    """Return the codecs of these names, each with its first set of rate points, and the families of models.

    A name is that of a family, or of a codec, which includes its families; None means all. Raises InputError for other
    names, and where no method is left.
    """
    of_codecs = [
        Method(name, next(iter(codec.rate_point_sets.values())), name)
        for name, codec in CODECS.items()
        if not codec.needs_model
    ]
    every = [*of_codecs, *families(models)]
    known = {name for method in every for name in (method.name, str(method.coder))}
    if names is not None and not (names and set(names) <= known):
        raise InputError(f"{','.join(names)!r} is no list of codecs; choose from {', '.join(sorted(known))}")
    return tuple(method for method in every if names is None or {method.name, method.coder} & set(names))


def rate_points(method: Method) -> list[RatePoint]:
    """Return all rate points of a codec's method, the coarsest first."""
    assert isinstance(method.coder, str), "programs are not tried"
    return [
        RatePoint(method.coder, setting, model) for setting, model in method.rate_points if not isinstance(setting, str)
    ]


def three_rate_points(method: Method) -> dict[str, RatePoint]:
    """Return rate points of a method by LEVELS: a quarter of the way up, half of it, and the finest."""
    points = rate_points(method)
    return dict(zip(LEVELS, (points[len(points) // 4], points[len(points) // 2], points[-1]), strict=True))


def middle_rate_point(method: Method) -> RatePoint:
    """Return the middle rate point of a method."""
    return three_rate_points(method)["middle"]


def with_methods(cells: Sequence[Verdict], noun: str = "codec") -> str:
    """Return in words for which methods all cells are sound: "with every codec", "with flac and g726 only"."""
    methods = list(dict.fromkeys(cell.method for cell in cells))
    unsound = {cell.method for cell in cells if not cell.sound}
    sound = [method for method in methods if method not in unsound]
    if not unsound or not sound:
        return f"with every {noun}" if sound else f"with no {noun}"
    if len(sound) > _MAX_NAMED:
        return f"with {len(sound)} of {len(methods)} {noun}s"
    return f"with {listed(sound)} only"


def hardest(cells: Sequence[Verdict], noun: str = "codecs", most: int = 3) -> str:
    """Return the cases at which most methods are not sound, with their counts, in words."""
    methods = {cell.method for cell in cells}
    unsound: dict[str, set[str]] = {}
    for cell in cells:
        if not cell.sound:
            unsound.setdefault(cell.case, set()).add(cell.method)
    ranked = sorted(unsound.items(), key=lambda case: -len(case[1]))[:most]
    if not ranked:
        return "none of them is hard for any"
    counts = [
        f"{case} ({len(some)}{f' of {len(methods)} {noun}' if case == ranked[0][0] else ''})" for case, some in ranked
    ]
    return listed(counts)


def sound_values(cells: Sequence[Verdict]) -> list[float]:
    """Return the values at which every cell is sound, rising."""
    unsound = {cell.value for cell in cells if not cell.sound}
    return sorted({cell.value for cell in cells if cell.value is not None} - unsound)


def most_hold_up_to(cells: Sequence[Verdict]) -> float | None:
    """Return the greatest value up to which at least half of the methods are sound; None where there is no such."""
    best = None
    for value in sorted({cell.value for cell in cells if cell.value is not None}):
        of_value = [cell for cell in cells if cell.value == value]
        if 2 * sum(cell.sound for cell in of_value) < len(of_value):
            break
        best = value
    return best


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
