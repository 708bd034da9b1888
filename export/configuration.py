"""What a training is: the configuration file (TOML), every key and value checked before any work is done."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeAlias, TypeVar, cast, get_args, get_origin, get_type_hints

from vibrocast import textures

Table = TypeVar("Table")
MAX_FILE_BYTES = 2**20
MAX_RATES = 16
_HOP_SAMPLES = 16  # as export.eva, which needs torch
_KINDS = {float: "number", int: "whole number", str: "text", bool: "true or false"}


class ConfigurationError(ValueError):
    """A configuration that cannot be used; the message says where, why and what to do."""


def within(low: float, high: float, default: Any = MISSING) -> Any:
    """Return a field whose number, or every number in it, lies from `low` to `high`."""
    return field(default=default, metadata={"range": (low, high)})


@dataclass(frozen=True)
class ModelChoice:
    """[model]: widths and latents, the prior, and lambda - the weight of squared error against bits - of each rate.

    With one lambda it is the paper's model, with several one model serves all rates between the first and the last.
    `start`: "random" as the paper, or "lapped": a lapped transform with its channels ordered by frequency.
    """

    lambdas: tuple[float, ...] = within(1e-3, 1e6)
    width: int = within(8, 128, 128)
    latents: int = within(16, 128, 128)
    prior: Literal["factorised", "contexts"] = "factorised"
    start: Literal["random", "lapped"] = "random"


@dataclass(frozen=True)
class ArchiveSource:
    """[[archive]]: an NPZ archive of recordings named MATERIAL_TAKE, with their `rate_hz`."""

    archive: str
    drop_s: float = within(0, 1e3, 0.0)
    high_pass_hz: float = within(0, 1e3, 0.0)

    @property
    def name(self) -> str:
        """What the source is called in the names of materials."""
        return Path(self.archive).stem


@dataclass(frozen=True)
class FolderSource:
    """[[folder]]: a folder of recordings, such as IEEE P1918.1.1, or a manifest; options as in `vibrocast bench`."""

    folder: str
    part: Literal["all", "train", "test"] = "all"
    split_by: Literal["auto", "trace", "material", "subject"] = "auto"
    seed: int = within(0, 2**31, 0)
    drop_s: float = within(0, 1e3, 0.0)
    high_pass_hz: float = within(0, 1e3, 0.0)
    rate_hz: float | None = within(1, 1e6, None)
    unit: str | None = None
    full_scale: float | None = within(1e-12, 1e12, None)
    axis: str | None = None
    reduce: str | None = None
    hand_speed_mm_s: float | None = within(1e-3, 1e4, None)

    @property
    def name(self) -> str:
        """What the source is called in the names of materials."""
        path = Path(self.folder)
        return (path.stem if path.suffix.lower() == ".csv" else path.name) or self.folder

    @property
    def options(self) -> dict[str, Any]:
        """What `textures.load` is told of every recording."""
        names = ("rate_hz", "unit", "full_scale", "axis", "reduce", "hand_speed_mm_s")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class GeneratorSource:
    """[generator]: textures of this project's own generators, each kind a material, at many speeds of the hand."""

    kinds: tuple[str, ...] = tuple(sorted(textures.GENERATORS))
    recordings: int = within(1, 10_000, 30)
    seconds: float = within(0.1, 1e3, 4.0)
    high_pass_hz: float = within(0, 1e3, 30.0)
    seed: int = within(0, 2**31, 0)

    @property
    def name(self) -> str:
        """What the source is called in the names of materials."""
        return "generator"


Source: TypeAlias = ArchiveSource | FolderSource | GeneratorSource


@dataclass(frozen=True)
class HeldBack:
    """[held_back]: materials for validation, by name (SOURCE/MATERIAL), or a seeded share of each source's."""

    materials: tuple[str, ...] = ()
    share: float = within(0.01, 0.9, 0.15)


@dataclass(frozen=True)
class Augmentation:
    """[augmentation]: how far excerpts are varied at random."""

    gain_db: float = within(0, 40, 12.0)
    rate_octaves: float = within(0, 2, 0.5)
    polarity: bool = True
    tilt_db_per_octave: float = within(0, 12, 3.0)
    filter_share: float = within(0, 1, 0.3)
    noise_share: float = within(0, 1, 0.15)


@dataclass(frozen=True)
class Schedule:
    """[training]: the loop. `distortion`: of the signal, or weighted by the threshold of detection, as g_p."""

    steps: int = within(1, 10**8, 40_000)
    batch: int = within(1, 4096, 16)
    excerpt_samples: int = within(256, 2**16, 2048)
    rate_hz: int = within(100, 100_000, 2800)
    learning_rate: float = within(1e-6, 0.1, 1e-3)
    warm_up_steps: int = within(0, 10**6, 200)
    gradient_norm: float = within(1e-3, 1e3, 1.0)
    validate_every: int = within(1, 10**8, 1000)
    validation_excerpts: int = within(1, 10**4, 48)
    patience: int = within(1, 10**6, 20)
    rounding: Literal["noise", "straight-through"] = "noise"
    dead_zone: float = within(0, 0.5, 0.0)
    distortion: Literal["plain", "acceleration", "displacement"] = "plain"


@dataclass(frozen=True)
class Sweep:
    """[sweep]: a training for every width, and one for every lambda alone."""

    widths: tuple[int, ...] = within(8, 128, ())
    lambdas: tuple[float, ...] = within(1e-3, 1e6, ())


@dataclass(frozen=True)
class Configuration:
    """A training, or a sweep of trainings."""

    name: str
    model: ModelChoice
    seed: int = within(0, 2**31, 1)
    archive: tuple[ArchiveSource, ...] = ()
    folder: tuple[FolderSource, ...] = ()
    generator: GeneratorSource | None = None
    held_back: HeldBack = HeldBack()
    augmentation: Augmentation = Augmentation()
    training: Schedule = Schedule()
    sweep: Sweep = Sweep()

    @property
    def sources(self) -> tuple[Source, ...]:
        """All sources of recordings."""
        return (*self.archive, *self.folder, *((self.generator,) if self.generator else ()))

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration as plain tables, as a checkpoint stores it and `parsed` takes it."""
        return asdict(self, dict_factory=lambda pairs: {name: value for name, value in pairs if value is not None})


def read(path: Path) -> Configuration:
    """Read a configuration file. Raises ConfigurationError for what cannot be used, OSError where it cannot be read."""
    if not path.is_file():
        raise ConfigurationError(f"{path}: no such file; examples/eva-16.toml is one to begin with")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigurationError(f"{path}: longer than any configuration; give another file")
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path}: not a TOML file: {error}") from error
    try:
        return parsed(values)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from error


def parsed(values: Mapping[str, Any]) -> Configuration:
    """Return the configuration of plain tables, such as those of a TOML file. Raises ConfigurationError."""
    configuration: Configuration = _table(Configuration, values, "")
    for one in each_of(configuration):
        if not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,40}", one.name):
            raise ConfigurationError(f"name {one.name!r}: use at most 41 small letters, digits and hyphens")
    if not configuration.sources:
        raise ConfigurationError("nothing to train on; give [[archive]], [[folder]] or [generator]")
    names = [source.name for source in configuration.sources]
    if len(set(names)) < len(names):
        raise ConfigurationError(f"two sources are called {max(names, key=names.count)!r}; rename one")
    lambdas = configuration.model.lambdas
    if not 1 <= len(lambdas) <= MAX_RATES or list(lambdas) != sorted(set(lambdas)):
        raise ConfigurationError(f"[model] lambdas: 1 to {MAX_RATES} numbers that rise")
    if configuration.training.excerpt_samples % _HOP_SAMPLES:
        raise ConfigurationError(f"[training] excerpt_samples: a multiple of {_HOP_SAMPLES} is needed")
    if unknown := set(configuration.generator.kinds if configuration.generator else ()) - set(textures.GENERATORS):
        raise ConfigurationError(f"[generator] kinds: no {min(unknown)!r}; known are {', '.join(textures.GENERATORS)}")
    return configuration


def each_of(configuration: Configuration) -> list[Configuration]:
    """Return the trainings of a sweep: NAME-WIDTH for several widths, NAME-NUMBER for several lambdas, or both."""
    chosen, sweep = [configuration], configuration.sweep
    if sweep.widths:
        chosen = [
            replace(one, name=f"{one.name}-{width}", model=replace(one.model, width=width))
            for one in chosen
            for width in sweep.widths
        ]
    if sweep.lambdas:
        chosen = [
            replace(one, name=f"{one.name}-{number}", model=replace(one.model, lambdas=(weight,)))
            for one in chosen
            for number, weight in enumerate(sweep.lambdas, 1)
        ]
    return [replace(one, sweep=Sweep()) for one in chosen]


def _table(kind: type[Table], values: Any, place: str) -> Table:
    """Return a table of the configuration as its dataclass, every value checked."""
    if not isinstance(values, Mapping):
        raise ConfigurationError(f"{place}: a table is needed, not {values!r}")
    known = {each.name: each for each in fields(kind)}  # type: ignore[arg-type]
    where = f"[{place}] " if place else ""
    if unknown := sorted(set(values) - set(known)):
        raise ConfigurationError(f"{where}{unknown[0]}: no such key; known are {', '.join(known)}")
    if missing := [each.name for each in known.values() if each.default is MISSING and each.name not in values]:
        raise ConfigurationError(f"{where}{missing[0]} is missing; give it")
    types = get_type_hints(kind)
    return kind(
        **{
            name: _value(types[name], value, f"{where}{name}", known[name].metadata.get("range"))
            for name, value in values.items()
        }
    )


def _value(kind: Any, value: Any, place: str, limits: tuple[float, float] | None) -> Any:
    if get_origin(kind) is UnionType:  # an optional value, which is left out where there is none
        kind = get_args(kind)[0]
    if is_dataclass(kind):
        return _table(cast("type[Any]", kind), value, place)
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigurationError(f"{place}: a list is needed, not {value!r}")
        return tuple(_value(get_args(kind)[0], each, place, limits) for each in value)
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise ConfigurationError(f"{place}: {value!r} is not one of {', '.join(get_args(kind))}")
        return value
    if kind is float and type(value) is int:
        value = float(value)
    if kind is int and type(value) is float and value.is_integer():
        value = int(value)
    if type(value) is not kind:
        raise ConfigurationError(f"{place}: {value!r} is no {_KINDS[kind]}")
    if limits and not limits[0] <= value <= limits[1]:
        raise ConfigurationError(f"{place}: {value!r} is not within {limits[0]:g} and {limits[1]:g}")
    return value
