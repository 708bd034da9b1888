"""The cells of a benchmark, one trace at one setting of one codec: what they are, how each is measured."""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import codec
import textures
from codec import Setting, Signal
from device_protocol import coded_stream
from evaluation import cost, external, metrics
from evaluation.points import MEASURED, PROGRAM, Point, Timing
from host import coding

DECIMALS = 6
"""Of a quality, so that the arithmetic of another machine gives the same file."""

_LIBRARIES = ("vibrocast", "av", "numpy", "scipy", "vibromaf")
_ROOT = Path(__file__).parents[1]
_SOURCES = (
    "codec/*.py",
    "codec/data/*",
    "device_protocol/coded_stream.py",
    "host/coding.py",
    "evaluation/cells.py",
    "evaluation/cost.py",
    "evaluation/external.py",
    "evaluation/metrics.py",
)


class BenchError(ValueError):
    """A method or a folder that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class Method:
    """One curve: the settings of a codec, by its name, or of a program that the user has.

    `physical`: it is for traces in a physical unit, and left out for others.
    """

    name: str
    settings: tuple[Setting | str, ...]
    coder: str | external.Program
    physical: bool = False


@dataclass(frozen=True)
class Measured:
    """What one cell gave; no timing where none was asked for."""

    point: Point
    timing: Timing | None


@dataclass(frozen=True, eq=False)
class Cell:
    """One trace at one setting of a method. `repeats`: the times are the median of so many runs, 0 for no times.

    Those of a program are of one run, by the wall clock and with process start.
    """

    trace: str
    recording: textures.Recording
    method: Method
    setting: Setting | str
    repeats: int

    @property
    def names(self) -> tuple[str, str, str]:
        """Trace, method and setting as they stand in tables."""
        setting = self.setting if isinstance(self.setting, str) else setting_text(self.setting)
        return self.trace, self.method.name, setting

    @property
    def key(self) -> str:
        """A hash of all that decides the figures: name and signal of the trace, method, setting, `repeats`, program."""
        recording = self.recording
        digest = hashlib.sha256(recording.samples.tobytes())
        signal_format = recording.samples.shape, recording.rate_hz, recording.unit
        work = self.method.name, self.method.coder, self.setting, self.repeats
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
            encode = partial(_encode, recording, coder, self.setting)
            file = encode()
            decoded, size_bytes = _decode(file), len(file)
            delay_ms = cost.delay_ms(coder, self.setting, rate_hz, recording.channels, recording.unit)
            if self.repeats:
                times = cost.time_coding(encode, _decode, samples.size, self.repeats)
        figures = {**asdict(metrics.measure(samples, decoded, rate_hz)), "delay_ms": delay_ms}
        rounded: dict[str, Any] = {
            name: None if value is None else round(value, DECIMALS) for name, value in figures.items()
        }
        source = PROGRAM if isinstance(coder, external.Program) else MEASURED
        point = Point(*self.names, samples.size, size_bytes, rate_hz=rate_hz, source=source, **rounded)
        return Measured(point, Timing(*self.names, *times, source) if times and self.repeats else None)


def _encode(recording: textures.Recording, codec_name: str, setting: Setting) -> bytes:
    rate_hz = round(recording.rate_hz)
    coded = codec.encode(recording.samples, rate_hz, setting, codec=codec_name, unit=recording.unit)
    stream = coding.as_stream(coded, recording.unit)
    return coded_stream.pack_file(stream.header, stream.packets)


def _decode(file: bytes) -> Signal:
    header, packets = coded_stream.unpack_file(file)
    return coding.Stream(header, tuple(packets)).decode()


def setting_text(setting: Setting) -> str:
    """Return a codec's setting as text, such as "levels=14 quantiser=log"."""
    texts = {
        name: value if isinstance(value, str) else ",".join(f"{part:.6g}" for part in np.atleast_1d(value))
        for name, value in setting.items()
    }
    return " ".join(f"{name}={text}" for name, text in texts.items())


def methods(names: Collection[str], programs: Sequence[external.Program] = ()) -> list[Method]:
    """Return the methods of these names, in a fixed order, then the programs.

    A name is that of a codec, which stands for all its ladders, or of a ladder; no name at all stands for all codecs.
    A ladder that needs a physical unit is left out of traces without one, unless it is named. Raises BenchError for
    unknown names, and for a program that is called like a codec or ladder.
    """
    owners = {ladder: known for known in codec.CODECS.values() for ladder in known.ladders}
    known_names = sorted({*owners, *codec.CODECS})
    if unknown := sorted(set(names) - set(known_names)):
        raise BenchError(f"there is no codec or ladder {unknown[0]!r}; choose from {', '.join(known_names)}")
    if taken := [program.name for program in programs if program.name in known_names]:
        raise BenchError(f"a codec or ladder is called {taken[0]!r}; give the program another name")
    ladders = [
        Method(name, owner.ladders[name], owner.name, name in owner.physical_ladders and name not in names)
        for name, owner in owners.items()
        if not names or name in names or owner.name in names
    ]
    return [*ladders, *(Method(program.name, program.settings, program) for program in programs)]


@cache
def program_version() -> str:
    """Return what must be alike for figures to be: the versions of program and libraries, a hash of the sources."""
    sources = hashlib.sha256()
    for path in (path for pattern in _SOURCES for path in sorted(_ROOT.glob(pattern))):
        sources.update(path.read_bytes())
    return ", ".join([*(f"{name} {version(name)}" for name in _LIBRARIES), f"sources {sources.hexdigest()[:12]}"])


@cache
def _core() -> str:
    """Return a hash of the compiled C core, whose bytes, unlike its results, differ from machine to machine."""
    core = hashlib.sha256()
    for path in sorted(_ROOT.glob("codec/vibrocast_core.*")):
        core.update(path.read_bytes())
    return core.hexdigest()
