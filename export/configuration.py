"""The configuration of a training (TOML); every key and value is checked before any work is done."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from vibrocast import textures
from vibrocast.errors import InputError, located
from vibrocast.toml_tables import Table, convert, one_of, read_toml, within

_HOP_SAMPLES = 16  # as export.eva, which needs torch

Lambda = Annotated[float, within(1e-3, 1e6)]
Width = Annotated[int, within(16, 128)]
Seed = Annotated[int, within(0, 2**31)]
Steps = Annotated[int, within(1, 10**8)]
Share = Annotated[float, within(0, 1)]
Dropped = Annotated[float, within(0, 1e3, "seconds to drop from the beginning")]
HighPass = Annotated[float, within(0, 1e3, "corner of a high-pass in Hz")]
About = Annotated[str, Meta(max_length=200)]


class ModelChoice(Table, frozen=True):
    """[model]: the model to train.

    `lambda`: the weight of squared error against bits. `width`: the filters of each layer, as many as latents. `start`:
    random weights, or those of a lapped transform (export.lapped_start).
    """

    lambda_: Lambda = msgspec.field(name="lambda")
    kind: Literal["eva"] = "eva"
    width: Width = 128
    start: Literal["random", "lapped"] = "random"


class ArchiveSource(Table, frozen=True):
    """[[archive]]: an NPZ archive of recordings named MATERIAL_TAKE, with their `rate_hz`; `about`: for the card."""

    archive: str
    about: About = ""
    drop_s: Dropped = 0.0
    high_pass_hz: HighPass = 0.0

    @property
    def name(self) -> str:
        """Name of the source in the names of materials."""
        return Path(self.archive).stem


class FolderSource(Table, frozen=True):
    """[[folder]]: a folder of recordings, such as IEEE P1918.1.1, or a manifest; options as in `vibrocast bench`."""

    folder: str
    about: About = ""
    part: Literal["all", "train", "test"] = "all"
    split_by: Literal["auto", "recording", "material", "subject"] = "auto"
    seed: Seed = 0
    drop_s: Dropped = 0.0
    high_pass_hz: HighPass = 0.0
    rate_hz: Annotated[float, within(1, 1e6)] | None = None
    unit: str | None = None
    full_scale: Annotated[float, within(1e-12, 1e12)] | None = None
    columns: str | None = None
    reduce: str | None = None
    hand_speed_mm_s: Annotated[float, within(1e-3, 1e4)] | None = None

    @property
    def name(self) -> str:
        """Name of the source in the names of materials."""
        path = Path(self.folder)
        return (path.stem if path.suffix.lower() == ".csv" else path.name) or self.folder

    @property
    def options(self) -> dict[str, Any]:
        """Options of `textures.load` for every recording."""
        names = ("rate_hz", "unit", "full_scale", "columns", "reduce", "hand_speed_mm_s")
        return {name: getattr(self, name) for name in names}


class GeneratorSource(Table, frozen=True):
    """[generator]: textures of this project's own generators, each kind a material, at many hand speeds."""

    kinds: tuple[Annotated[str, one_of(textures.GENERATORS)], ...] = tuple(sorted(textures.GENERATORS))
    recordings: Annotated[int, within(1, 10_000)] = 30
    seconds: Annotated[float, within(0.1, 1e3)] = 4.0
    high_pass_hz: HighPass = 30.0
    seed: Seed = 0

    @property
    def name(self) -> str:
        """Name of the source in the names of materials."""
        return "generator"

    @property
    def about(self) -> str:
        """Text about the source on the model's card."""
        return "this project's generated textures"


Source: TypeAlias = ArchiveSource | FolderSource | GeneratorSource


class HeldBack(Table, frozen=True):
    """[held_back]: what validates: materials by name (SOURCE/MATERIAL), or a seeded share of each source's.

    With `by` "trace", the test part of each folder instead, as `vibrocast bench --split test` draws it.
    """

    materials: tuple[str, ...] = ()
    share: Annotated[float, within(0.01, 0.9)] = 0.15
    by: Literal["material", "trace"] = "material"


class Augmentation(Table, frozen=True):
    """[augmentation]: how much excerpts vary at random."""

    gain_db: Annotated[float, within(0, 40)] = 12.0
    rate_octaves: Annotated[float, within(0, 2)] = 0.5
    polarity: bool = True
    tilt_db_per_octave: Annotated[float, within(0, 12)] = 3.0
    filter_share: Share = 0.3
    noise_share: Share = 0.15


class Schedule(Table, frozen=True):
    """[training]: the loop; see export.training.

    `cost`: bits by the static prior, or by a coder that has adapted to the excerpt. `distortion`: of the signal, or
    after the perceptual transform g_p.
    """

    steps: Steps = 40_000
    batch: Annotated[int, within(1, 4096)] = 16
    excerpt_samples: Annotated[int, within(256, 2**16)] = 2048
    rate_hz: Annotated[int, within(100, 100_000)] = 2800
    learning_rate: Annotated[float, within(1e-6, 0.1)] = 1e-3
    warm_up_steps: Annotated[int, within(0, 10**6)] = 200
    gradient_norm: Annotated[float, within(1e-3, 1e3)] = 1.0
    validate_every: Annotated[int, within(1, 10**8)] = 1000
    validation_excerpts: Annotated[int, within(1, 10**4)] = 48
    rounding: Literal["noise", "straight-through"] = "noise"
    dead_zone: Annotated[float, within(0, 0.5)] = 0.0
    cost: Literal["static", "adaptive"] = "static"
    distortion: Literal["plain", "acceleration", "displacement"] = "plain"

    def __post_init__(self) -> None:
        if self.excerpt_samples % _HOP_SAMPLES:
            raise ValueError(f"excerpt_samples must be a multiple of {_HOP_SAMPLES}, not {self.excerpt_samples}")


class Sweep(Table, frozen=True):
    """[sweep]: one training for every width and every lambda, each lambda perhaps with `steps` of its own."""

    widths: tuple[Width, ...] = ()
    lambdas: tuple[Lambda, ...] = ()
    steps: tuple[Steps, ...] = ()

    def __post_init__(self) -> None:
        if self.steps and len(self.steps) != len(self.lambdas):
            raise ValueError(f"{len(self.steps)} steps for {len(self.lambdas)} lambdas; give one for each, or none")


_NAME = r"\A[a-z0-9][a-z0-9-]{0,40}\Z"


class Configuration(Table, frozen=True):
    """A training, or a sweep of trainings."""

    name: Annotated[str, Meta(pattern=_NAME, description="at most 41 small letters, digits and hyphens")]
    model: ModelChoice
    seed: Seed = 1
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

    def __post_init__(self) -> None:
        if self.held_back.by == "trace":
            if self.archive or self.generator or self.held_back.materials:
                raise ValueError("traces are held back from folders alone; remove other sources and named materials")
            if any((source.part, source.split_by) != ("all", "recording") for source in self.folder):
                raise ValueError('held back by trace, a folder needs split_by = "recording" and no part; correct it')
        if not self.sources:
            raise ValueError("there is nothing to train on; give [[archive]], [[folder]] or [generator]")
        names = [source.name for source in self.sources]
        if len(set(names)) < len(names):
            raise ValueError(f"two sources have the name {max(names, key=names.count)!r}; rename one")

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration as plain tables, as a checkpoint stores it and `parsed` reads it."""
        tables: dict[str, Any] = msgspec.to_builtins(self)
        return tables


def read(path: Path) -> Configuration:
    """Read a configuration file. Raises InputError if it is invalid, OSError if it cannot be read."""
    if not path.exists():
        raise InputError(f"{path}: no such file; begin with a copy of examples/eva.toml")
    with located(path):
        return parsed(read_toml(path, "configuration"))


def parsed(values: Mapping[str, Any]) -> Configuration:
    """Return the configuration in plain tables, such as those of a TOML file. Raises InputError."""
    configuration = convert(values, Configuration)
    for one in each_of(configuration):
        convert(one.as_dict(), Configuration)  # checks the name of each
    return configuration


def by_trace(configuration: Configuration) -> Configuration:
    """Return the training on all recordings of the data folder, a fifth of them held back, as in the EVA paper."""
    folder = FolderSource(".", about="split by trace", split_by="recording")
    return replace(configuration, archive=(), generator=None, folder=(folder,), held_back=HeldBack(by="trace"))


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
            replace(
                one,
                name=f"{one.name}-{number}",
                model=replace(one.model, lambda_=lambda_),
                training=replace(one.training, steps=steps),
            )
            for one in chosen
            for number, (lambda_, steps) in enumerate(
                zip(sweep.lambdas, sweep.steps or [one.training.steps] * len(sweep.lambdas), strict=True), 1
            )
        ]
    return [replace(one, sweep=Sweep()) for one in chosen]
