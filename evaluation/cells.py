"""The cells of a benchmark, one recording at one setting of one codec, and how each is measured."""

import hashlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib.util import find_spec
from itertools import zip_longest
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


@dataclass(frozen=True)
class Method:
    """One curve: the settings of a codec, by its name, or of a program that the user has.

    `physical`: it is for traces in a physical unit, and left out for others. `models`: the trained model of each
    setting; none where the codec uses its built-in tables.
    """

    name: str
    settings: tuple[Setting | str, ...]
    coder: str | external.Program
    physical: bool = False
    models: tuple[Model, ...] = ()

    @property
    def rate_points(self) -> Iterator[tuple[Setting | str, Model | None]]:
        """Each setting with its model, if any."""
        return zip_longest(self.settings, self.models)


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
    setting: Setting | str
    repeats: int
    model: Model | None = None

    @property
    def names(self) -> tuple[str, str, str]:
        """Trace, method and setting as they stand in tables; with the model, where the method has several."""
        return self.trace, self.method.name, rate_point_text(self.method, self.setting, self.model)

    @property
    def key(self) -> str:
        """A hash of all that decides the figures: name and signal of the trace, method, setting, model, program."""
        recording = self.recording
        digest = hashlib.sha256(recording.samples.tobytes())
        signal_format = recording.samples.shape, recording.rate_hz, recording.unit
        model = self.model and (self.model.name, trained.digest(self.model))
        coder = self.method.coder
        source = "" if isinstance(coder, external.Program) or coder in _OWN else _other_packages()
        work = self.method.name, coder, source, self.setting, model, self.repeats
        digest.update(repr((self.trace, signal_format, work, program_version(), _core())).encode())
        return digest.hexdigest()

    def measure(self) -> Measured:
        """Code the trace into a whole file, a codec's into the bytes of a .vct file, decode that, and compare.

        Raises whatever the codec or program raises.
        """
        recording, coder = self.recording, self.method.coder
        samples, rate_hz = recording.samples, round(recording.rate_hz)
        delay_ms = times = None
        if isinstance(coder, external.Program):
            coded = external.run(coder, str(self.setting), samples, rate_hz)
            decoded, size_bytes = coded.decoded, coded.size_bytes
            times = coded.encode_s * 1e6 / samples.size, coded.decode_s * 1e6 / samples.size
        else:
            assert not isinstance(self.setting, str), "codecs have parameters"
            encode = partial(encode_file, recording, coder, self.setting, self.model)
            decode = partial(decode_file, model=self.model)
            file = encode()
            decoded, size_bytes = decode(file), len(file)
            settled = codec.Source.of(samples, rate_hz, coder, recording.unit, model=self.model).resolved(self.setting)
            delay_ms = cost.delay_ms(coder, settled, rate_hz, recording.channels, recording.unit, self.model)
            if self.repeats:
                times = time_coding(encode, decode, samples.size, self.repeats)
        figures = {**asdict(metrics.measure(samples, decoded, rate_hz, recording.unit)), "delay_ms": delay_ms}
        rounded: dict[str, Any] = {
            name: None if value is None else round(value, DECIMALS) for name, value in figures.items()
        }
        source = PROGRAM if isinstance(coder, external.Program) else MEASURED
        point = Point(*self.names, samples.size, size_bytes, rate_hz=rate_hz, source=source, **rounded)
        return Measured(point, Timing(*self.names, *times, source) if times and self.repeats else None)


def encode_file(recording: textures.Recording, codec_name: str, setting: Setting, model: Model | None) -> bytes:
    """Return a recording coded at a setting, by a trained model if given, as the bytes of a .vct file.

    Raises CodecError.
    """
    rate_hz = round(recording.rate_hz)
    return bytes(codec.encode(recording.samples, rate_hz, setting, codec=codec_name, unit=recording.unit, model=model))


def decode_file(file: bytes, model: Model | None, runtime: str | None = None) -> Signal:
    """Return the samples of a .vct file, in their unit; by one of codec.RUNTIMES, or as the model prefers.

    Raises CodecError, or StreamError.
    """
    header, packets = coded_stream.unpack_file(file)
    return Stream(header, tuple(packets), model.image if model else None, runtime).decode()


def rate_point_text(method: Method, setting: Setting | str, model: Model | None) -> str:
    """Return a setting of a method as text; with the model, where the method has several."""
    text = setting if isinstance(setting, str) else setting_text(setting)
    return f"{text} model={model.name}" if model and len({each.name for each in method.models}) > 1 else text


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
        Method(rate_point_set, points.settings, known.name, points.is_physical and rate_point_set not in names)
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
    return [*chosen, *(Method(program.name, program.settings, program) for program in programs)]


def families(models: Sequence[Model]) -> list[Method]:
    """Return a method for each family of models, in their order: its models by name, of each all rate points that
    differ.
    """
    grouped: dict[tuple[str, str], list[tuple[Setting, Model]]] = {
        (model.family, trained.codec_name(model)): [] for model in models
    }
    for model in sorted(models, key=lambda model: model.name):
        own = grouped[model.family, trained.codec_name(model)]
        own += [(setting, model) for setting in trained.rate_point_set(model)]
    return [
        Method(
            family, tuple(setting for setting, _ in rate_points), coder, models=tuple(model for _, model in rate_points)
        )
        for (family, coder), rate_points in grouped.items()
    ]


def coders(chosen: Sequence[Method]) -> dict[str, tuple[str, list[Model]]]:
    """Return the codecs of methods, each by its own name, with the models of a family by that of the family."""
    found: dict[str, tuple[str, list[Model]]] = {}
    for method in chosen:
        if isinstance(method.coder, str):
            own = {model.name: model for model in method.models}
            found[method.name if own else method.coder] = method.coder, list(own.values())
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
