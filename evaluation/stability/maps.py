"""What a map of trials is made of: its trials, its picture, and the words that explain it."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vibrocast import pages
from vibrocast.codec import CODECS
from vibrocast.codec.interface import Setting
from vibrocast.evaluation import trained
from vibrocast.evaluation.cells import BenchError, Method, families, setting_text
from vibrocast.evaluation.stability.trials import Trial, Verdict
from vibrocast.models import Model
from vibrocast.textures import Recording


@dataclass(frozen=True, eq=False)
class RatePoint:
    """A codec at a setting, perhaps with a trained model: alike and hashed by what they are."""

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

    def _key(self) -> tuple[str, str, str]:
        return self.codec, self.text, trained.digest(self.model) if self.model else ""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RatePoint) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


@dataclass(frozen=True)
class Scope:
    """How much to try. `methods`: of codecs and families of models; `quick`: a grid of few conditions.

    `recordings`: a person's own, by name.
    """

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


@dataclass(frozen=True)
class Map:
    """One map. `name`: of its files. `varied`: how a cell's value is said, such as "{} dB"; "" without.

    `rules`: the figures by which an outcome follows, for the words about the map: the template of its name in `folder`.
    `judged`: what makes of the cells those of the map, where an outcome depends on others. `draw`: writes the picture.
    `in_summary`: whether the page begins with it.
    """

    name: str
    title: str
    rules: Mapping[str, object]
    varied: str
    trials: Callable[[Scope], list[Trial]]
    draw: Callable[[Path, Sequence[Verdict]], None]
    judged: Callable[[list[Verdict]], list[Verdict]] = lambda cells: cells
    in_summary: bool = True
    folder: Path = Path(__file__).parent / "about"

    @property
    def about(self) -> str:
        """What is tried and by which rules an outcome follows."""
        return pages.render(self.folder / f"{self.name}.md.jinja", **self.rules)


def methods(names: Collection[str] | None, models: Sequence[Model]) -> tuple[Method, ...]:
    """Return the codecs of these names, each with its first set of rate points, and the families of models.

    A name is that of a codec, which stands for its families too, or of a family; None = all. Raises BenchError for
    other names, and where nothing is left to try.
    """
    of_codecs = [
        Method(name, next(iter(codec.rate_point_sets.values())), name)
        for name, codec in CODECS.items()
        if not codec.needs_model
    ]
    every = [*of_codecs, *families(models)]
    known = {name for method in every for name in (method.name, str(method.coder))}
    if names is not None and not (names and set(names) <= known):
        raise BenchError(f"{','.join(names)!r} is no list of codecs; choose from {', '.join(sorted(known))}")
    return tuple(method for method in every if names is None or {method.name, method.coder} & set(names))


def rate_points(method: Method) -> list[RatePoint]:
    """Return all rate points of a codec's method, the coarsest first."""
    assert isinstance(method.coder, str), "programs are not tried"
    return [
        RatePoint(method.coder, setting, model) for setting, model in method.rate_points if not isinstance(setting, str)
    ]


def three_rate_points(method: Method) -> dict[str, RatePoint]:
    """Return rate points of a method: a quarter of the way up, half of it, and the finest."""
    rate_point_set = rate_points(method)
    return {
        "low": rate_point_set[len(rate_point_set) // 4],
        "middle": rate_point_set[len(rate_point_set) // 2],
        "high": rate_point_set[-1],
    }


def middle_rate_point(method: Method) -> RatePoint:
    """Return the middle rate point of a method."""
    return three_rate_points(method)["middle"]
