"""The cells of a benchmark, one recording at one setting of one codec, and how each is measured."""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast import codec, textures
from vibrocast.codec import Setting, Signal, metrics, plugins
from vibrocast.codec.stream import Stream
from vibrocast.codec.timing import time_coding
from vibrocast.device_protocol import coded_stream
from vibrocast.errors import InputError
from vibrocast.evaluation import cost, external, trained
from vibrocast.evaluation.peers import measured_codecs
from vibrocast.evaluation.points import MEASURED, PROGRAM, Point, Timing
from vibrocast.firmware import native_core
from vibrocast.models import Model
from vibrocast.workers import digest_of, program_version

DECIMALS = 6
"""Of a quality, so that the arithmetic of another machine gives the same file."""

_OWN = {*codec.BUILT_IN, *codec.PEERS}


@dataclass(frozen=True, eq=False)
class RatePoint:
    """A codec, by its name, at a setting, perhaps with a trained model; or a program of the user's with a setting.

    Equal where all three are equal.
    """

    coder: str | external.Program
    setting: Setting | str
    model: Model | None = None

    @property
    def text(self) -> str:
        """The setting as text."""
        return self.setting if isinstance(self.setting, str) else setting_text(self.setting)

    @property
    def parameters(self) -> Setting:
        """The setting of a codec."""
        assert not isinstance(self.setting, str), "programs have no parameters"
        return self.setting

    @property
    def codec(self) -> str:
        """The name of a codec."""
        assert isinstance(self.coder, str), "a program is no codec"
        return self.coder

    @property
    def image(self) -> bytes | None:
        """The packed model image, None without a model."""
        return self.model.image if self.model else None

    @property
    def trained(self) -> Model:
        """The model, at a rate point of a learned method."""
        assert self.model is not None, "a learned method has models"
        return self.model

    def encode(self, recording: textures.Recording) -> bytes:
        """Return a recording coded by the codec, as the bytes of a .vct file. Raises CodecError."""
        samples, rate_hz, model = recording.samples, round(recording.rate_hz), self.model
        return bytes(
            codec.encode(samples, rate_hz, self.parameters, codec=self.codec, unit=recording.unit, model=model)
        )

    def decode(self, file: bytes, runtime: str | None = None) -> Signal:
        """Return the samples of a .vct file, in their unit; by one of codec.RUNTIMES, or as the model prefers.

        Raises CodecError, or StreamError.
        """
        header, packets = coded_stream.unpack_file(file)
        return Stream(header, tuple(packets), self.image, runtime).decode()

    @property
    def key(self) -> tuple[str | external.Program, str, tuple[str, str] | None]:
        """What decides the figures: codec or program, setting, and name and digest of the model."""
        model = None if self.model is None else (self.model.name, trained.digest(self.model))
        return self.coder, self.text, model

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RatePoint) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@dataclass(frozen=True)
class Method:
    """One curve: the rate points of a codec, of a family of models, or of a program that the user has.

    `physical`: it is for traces in a physical unit, and left out for others.
    """

    name: str
    rate_points: tuple[RatePoint, ...]
    physical: bool = False

    @property
    def coder(self) -> str | external.Program:
        """The codec, by its name, or the program."""
        return self.rate_points[0].coder

    @property
    def models(self) -> dict[str, Model]:
        """The trained models of the rate points by name; none where the codec uses its built-in tables."""
        return {each.model.name: each.model for each in self.rate_points if each.model}

    def text(self, rate_point: RatePoint) -> str:
        """Return a rate point's setting as text; with the model, where the method has several."""
        return f"{rate_point.text} model={rate_point.trained.name}" if len(self.models) > 1 else rate_point.text


@dataclass(frozen=True)
class Measured:
    """The figures of one cell; no timing where none was asked for."""

    point: Point
    timing: Timing | None


@dataclass(frozen=True, eq=False)
class Cell:
    """One recording at one setting of a method. `repeats`: the runs of which times are the median, 0 for no times.

    Times of a program are of one run, by the wall clock and with process start.
    """

    trace: str
    recording: textures.Recording
    method: Method
    rate_point: RatePoint
    repeats: int

    @property
    def names(self) -> tuple[str, str, str]:
        """Trace, method and setting as they stand in tables; with the model, where the method has several."""
        return self.trace, self.method.name, self.method.text(self.rate_point)

    @property
    def key(self) -> str:
        """A hash of all that decides the figures: name and signal of the trace, method, setting, model, program."""
        recording = self.recording
        digest = hashlib.sha256(recording.samples.tobytes())
        signal_format = recording.samples.shape, recording.rate_hz, recording.unit
        coder = self.rate_point.coder
        source = "" if isinstance(coder, external.Program) or coder in _OWN else _other_packages()
        work = self.method.name, source, self.rate_point.key, self.rate_point.setting, self.repeats
        digest.update(repr((self.trace, signal_format, work, program_version(), _core())).encode())
        return digest.hexdigest()

    def measure(self) -> Measured:
        """Code the trace into a whole file, a codec's into the bytes of a .vct file, decode that, and compare.

        Raises whatever the codec or program raises.
        """
        recording, rate_point = self.recording, self.rate_point
        samples, rate_hz = recording.samples, round(recording.rate_hz)
        delay_ms = times = None
        if isinstance(rate_point.coder, external.Program):
            coded = external.run(rate_point.coder, rate_point.text, samples, rate_hz)
            decoded, size_bytes = coded.decoded, coded.size_bytes
            times = coded.encode_s * 1e6 / samples.size, coded.decode_s * 1e6 / samples.size
        else:
            encode = partial(rate_point.encode, recording)
            file = encode()
            decoded, size_bytes = rate_point.decode(file), len(file)
            source = codec.Source.of(samples, rate_hz, rate_point.coder, recording.unit, model=rate_point.model)
            settled = source.resolved(rate_point.parameters)
            delay_ms = cost.delay_ms(
                rate_point.coder, settled, rate_hz, recording.channels, recording.unit, rate_point.model
            )
            if self.repeats:
                times = time_coding(encode, rate_point.decode, samples.size, self.repeats)
        figures = {**asdict(metrics.measure(samples, decoded, rate_hz, recording.unit)), "delay_ms": delay_ms}
        rounded: dict[str, Any] = {
            name: None if value is None else round(value, DECIMALS) for name, value in figures.items()
        }
        origin = PROGRAM if isinstance(rate_point.coder, external.Program) else MEASURED
        point = Point(*self.names, samples.size, size_bytes, rate_hz=rate_hz, source=origin, **rounded)
        return Measured(point, Timing(*self.names, *times, origin) if times and self.repeats else None)


def setting_text(setting: Setting) -> str:
    """Return a codec's setting as text, such as "levels=14 quantiser=log"."""
    texts = {
        name: value if isinstance(value, str) else ",".join(f"{part:.6g}" for part in np.atleast_1d(value))
        for name, value in setting.items()
    }
    return " ".join(f"{name}={text}" for name, text in texts.items())


def methods(
    names: Collection[str], programs: Sequence[external.Program] = (), models: Sequence[Model] = ()
) -> list[Method]:
    """Return the methods of these names, in a fixed order: sets of rate points of codecs, families of models, then the
    programs.

    A name is that of a codec, which stands for all its sets of rate points and families, or of one of these; no name at
    all stands for all codecs. Some sets are measured only where their own name stands. A set of rate points that needs
    a physical unit is left out of traces without one, unless it is named. Raises InputError for unknown names, for
    those of codecs that need a model where there is none, and for programs or families that are called like a codec or
    set of rate points.
    """
    of_codecs = [
        Method(
            rate_point_set,
            tuple(RatePoint(known.name, setting) for setting in points.settings),
            points.is_physical and rate_point_set not in names,
        )
        for known in measured_codecs().values()
        if not known.needs_model
        for rate_point_set, points in known.rate_point_sets.items()
        if not points.is_variant or rate_point_set in names
    ]
    taken = {*measured_codecs(), *(method.name for method in of_codecs)}
    every = [*of_codecs, *families(models)]
    for kind, own in (("family of models", every[len(of_codecs) :]), ("program", programs)):
        for each in own:
            if each.name in taken:
                raise InputError(
                    f"a codec, set of rate points or family is called {each.name!r}; give the {kind} another name"
                )
            taken.add(each.name)
    coders = {method.coder for method in every}
    for name in sorted(names):
        if name in measured_codecs() and name not in coders:
            raise InputError(f"the codec {name} needs a model, and there is none; give a folder of models: --models")
        if name not in {*coders, *(method.name for method in every)}:
            known_names = sorted({*measured_codecs(), *(method.name for method in every)})
            raise InputError(f"there is no codec or set of rate points {name!r}; choose from {', '.join(known_names)}")
    chosen = [method for method in every if not names or method.name in names or method.coder in names]
    of_programs = (
        Method(program.name, tuple(RatePoint(program, setting) for setting in program.settings)) for program in programs
    )
    return [*chosen, *of_programs]


def families(models: Sequence[Model]) -> list[Method]:
    """Return a method for each family of models, in their order: its models by name, of each all rate points that
    differ.
    """
    rate_points: dict[tuple[str, str], list[RatePoint]] = {
        (model.family, trained.codec_name(model)): [] for model in models
    }
    for model in sorted(models, key=lambda model: model.name):
        coder = trained.codec_name(model)
        own = (RatePoint(coder, setting, model) for setting in trained.rate_point_set(model))
        rate_points[model.family, coder].extend(own)
    return [Method(family, tuple(points)) for (family, _), points in rate_points.items()]


def coders(chosen: Sequence[Method]) -> dict[str, tuple[str, list[Model]]]:
    """Return the codecs of methods, each by its own name, with the models of a family by that of the family."""
    found: dict[str, tuple[str, list[Model]]] = {}
    for method in chosen:
        if isinstance(method.coder, str):
            found[method.name if method.models else method.coder] = method.coder, list(method.models.values())
    return found


@cache
def _other_packages() -> str:
    """Return the names that other packages register as codecs, these packages' versions, and a hash of the modules."""
    points = sorted(plugins.registered(), key=lambda each: each.name)
    specs = {each.name: find_spec(each.module) for each in points}
    modules = digest_of({name: Path(spec.origin) for name, spec in specs.items() if spec and spec.origin})
    return repr([(each.name, each.dist and each.dist.version) for each in points]) + modules


@cache
def _core() -> str:
    """Return a hash of the compiled C core, whose bytes, unlike its results, differ from machine to machine."""
    files = {path.name: path for path in Path(native_core.__file__).parent.glob("vibrocast_core.*")}
    assert files, "the codecs need the core"
    return digest_of(files)
