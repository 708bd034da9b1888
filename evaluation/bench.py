"""The benchmark: every trace at every setting of every method, each measured once and kept in a journal."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import codec
import textures
from codec import Setting, Signal
from device_protocol import coded_stream
from evaluation import cost, metrics
from evaluation.cost import CodecCost
from evaluation.dataset import Trace
from evaluation.points import Failure, Point, Timing, write_rows
from host import coding
from host.output_files import whole_file

DECIMALS = 6
"""Of a quality, so that the arithmetic of another machine gives the same file."""

JOURNAL, POINTS, PAGE = "journal.jsonl", "points.csv", "results.md"
_LIBRARIES = ("vibrocast", "av", "numpy", "scipy", "vibromaf")
_ROOT = Path(__file__).parents[1]
_SOURCES = (
    "codec/*.py",
    "device_protocol/coded_stream.py",
    "host/coding.py",
    "evaluation/bench.py",
    "evaluation/cost.py",
    "evaluation/metrics.py",
)


class BenchError(ValueError):
    """A method or a folder that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class Method:
    """One curve: the settings of a ladder of a codec."""

    name: str
    settings: tuple[Setting, ...]
    codec: str


@dataclass(frozen=True)
class Measured:
    """What one cell gave; no timing where none was asked for."""

    point: Point
    timing: Timing | None


@dataclass(frozen=True, eq=False)
class Cell:
    """One trace at one setting of a method. `repeats`: the times are the median of so many runs, 0 for no times."""

    trace: str
    recording: textures.Recording
    method: Method
    setting: Setting
    repeats: int

    @property
    def names(self) -> tuple[str, str, str]:
        """Trace, method and setting as they stand in tables, the last such as "levels=14 quantiser=log"."""
        texts = {
            name: value if isinstance(value, str) else ",".join(f"{part:.6g}" for part in np.atleast_1d(value))
            for name, value in self.setting.items()
        }
        return self.trace, self.method.name, " ".join(f"{name}={text}" for name, text in texts.items())

    @property
    def key(self) -> str:
        """A hash of all that decides the figures: name and signal of the trace, method, setting, `repeats`, program."""
        recording = self.recording
        digest = hashlib.sha256(recording.samples.tobytes())
        signal_format = recording.samples.shape, recording.rate_hz, recording.unit
        method = self.method.name, self.method.codec, sorted(self.setting.items())
        digest.update(repr((self.trace, signal_format, method, self.repeats, program_version(), _core())).encode())
        return digest.hexdigest()

    def measure(self) -> Measured:
        """Code the trace into the bytes of a whole .vct file, decode those, and compare.

        Raises whatever the codec raises.
        """
        recording = self.recording
        rate_hz = round(recording.rate_hz)
        file = self._encode()
        quality = asdict(metrics.measure(recording.samples, _decode(file), rate_hz))
        delay_ms = cost.delay_ms(self.method.codec, self.setting, rate_hz, recording.channels, recording.unit)
        rounded: dict[str, Any] = {
            name: None if value is None else round(value, DECIMALS)
            for name, value in {**quality, "delay_ms": delay_ms}.items()
        }
        point = Point(*self.names, recording.samples.size, len(file), rate_hz=rate_hz, **rounded)
        if not self.repeats:
            return Measured(point, None)
        times = cost.time_coding(self._encode, _decode, recording.samples.size, self.repeats)
        return Measured(point, Timing(*self.names, *times))

    def _encode(self) -> bytes:
        recording = self.recording
        how: dict[str, Any] = {"codec": self.method.codec, "unit": recording.unit}
        coded = codec.encode(recording.samples, round(recording.rate_hz), self.setting, **how)
        stream = coding.as_stream(coded, recording.unit)
        return coded_stream.pack_file(stream.header, stream.packets)


def _decode(file: bytes) -> Signal:
    header, packets = coded_stream.unpack_file(file)
    return coding.Stream(header, tuple(packets)).decode()


def methods(names: Iterable[str]) -> list[Method]:
    """Return the methods of these names, in a fixed order.

    A name is that of a codec, which stands for all its ladders, or of a ladder; no name at all stands for all. Raises
    BenchError for other names.
    """
    ladders = [
        Method(name, tuple(settings), known.name)
        for known in codec.CODECS.values()
        for name, settings in known.ladders.items()
    ]
    wanted = set(names)
    known_names = {name for ladder in ladders for name in (ladder.codec, ladder.name)}
    if unknown := sorted(wanted - known_names):
        raise BenchError(f"there is no codec or ladder {unknown[0]!r}; choose from {', '.join(sorted(known_names))}")
    return [ladder for ladder in ladders if not wanted or wanted & {ladder.name, ladder.codec}]


class Journal:
    """The file that keeps each cell as soon as it is measured, one line of JSON with its key and its figures.

    A line that is torn, or damaged, is as good as none: that cell is measured again.
    """

    def __init__(self, path: Path, fresh: bool = False) -> None:
        """Open or begin a journal; `fresh` forgets what it holds. Raises OSError."""
        held = b"" if fresh or not path.exists() else path.read_bytes()
        whole = held[: held.rfind(b"\n") + 1]
        self._measured = dict(filter(None, map(_journal_entry, whole.splitlines())))
        self._file = path.open("r+b" if whole else "wb")
        self._file.truncate(len(whole))
        self._file.seek(len(whole))

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, cell: Cell) -> Measured | None:
        """Return what was measured of a cell, or None."""
        return self._measured.get(cell.key)

    def add(self, cell: Cell, measured: Measured) -> None:
        """Keep what was measured of a cell. Raises OSError."""
        timing = measured.timing and asdict(measured.timing)
        line = json.dumps({"key": cell.key, "point": asdict(measured.point), "timing": timing})
        self._file.write(line.encode() + b"\n")
        self._file.flush()


def _journal_entry(line: bytes) -> tuple[str, Measured] | None:
    try:
        entry = json.loads(line)
        timing = entry["timing"] and Timing(**entry["timing"])
        return entry["key"], Measured(Point(**entry["point"]), timing)
    except (ValueError, TypeError, KeyError):
        return None


@dataclass
class Tally:
    """How far a run is: cells in all, done, failed among those, and measured by this run rather than an earlier one."""

    cells: int
    done: int = 0
    failed: int = 0
    measured: int = 0


Piece: TypeAlias = tuple[tuple[int, Cell], Callable[[], Measured]]
Outcomes: TypeAlias = Iterator[tuple[tuple[int, Cell], Measured | Exception]]


def run(
    traces: Sequence[Trace],
    load: Callable[[Trace], textures.Recording],
    chosen: Sequence[Method],
    repeats: int,
    journal: Journal,
    workers: Callable[[Iterator[Piece]], Outcomes],
    progress: Callable[[Tally], None],
) -> list[Measured | Failure]:
    """Measure all cells that the journal does not hold; return what all gave, by trace, method and setting.

    A trace that cannot be loaded is one failure, a cell whose codec raises another; the next run tries them again.
    `workers`: one of evaluation.workers, its other arguments given. Raises OSError where the journal cannot be
    written, and as the workers.
    """
    results: dict[int, Measured | Failure] = {}
    cells_of_trace = sum(len(method.settings) for method in chosen)
    tally = Tally(len(traces) * cells_of_trace)

    def note(place: int, result: Measured | Failure, cells: int = 1) -> None:
        results[place] = result
        tally.done += cells
        tally.failed += cells * isinstance(result, Failure)
        progress(tally)

    def pieces() -> Iterator[Piece]:
        for place, cell in enumerate(_cells(traces, load, chosen, repeats)):
            if isinstance(cell, Failure):
                note(place, cell, cells_of_trace)
            elif measured := journal.get(cell):
                note(place, measured)
            else:
                yield (place, cell), cell.measure

    # However this ends, no process is left behind.
    with closing(workers(pieces())) as outcomes:  # type: ignore[type-var]
        for (place, cell), outcome in outcomes:
            tally.measured += 1
            if isinstance(outcome, Measured):
                journal.add(cell, outcome)
                note(place, outcome)
            else:
                note(place, Failure(*cell.names, _reason(outcome)))
    return [results[place] for place in sorted(results)]


def _cells(
    traces: Sequence[Trace], load: Callable[[Trace], textures.Recording], chosen: Sequence[Method], repeats: int
) -> Iterator[Cell | Failure]:
    for trace in traces:
        try:
            recording = load(trace)
        except Exception as error:  # whatever one file does, the others are wanted
            yield Failure(trace.name, "", "", _reason(error))
            continue
        for method in chosen:
            for setting in method.settings:
                yield Cell(trace.name, recording, method, setting, repeats)


def _reason(error: Exception) -> str:
    """Return an error in one line; what Python itself raises tells little without its name."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}".removesuffix(": ") if type(error).__module__ == "builtins" else text


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


def results_folder(out: Path) -> Path:
    """Make the folder OUT/results of a run and return it; a run before may have left its results there.

    Raises BenchError where something else lies, OSError where it cannot be made.
    """
    results = out / "results"
    ours = (results / JOURNAL).exists() or (results / POINTS).exists()
    filled = (out / PAGE).exists() or (results.is_dir() and any(results.iterdir()))
    if filled and not ours:
        raise BenchError(f"{out}: its {PAGE} or folder {results.name} is not of a benchmark; choose another --out")
    results.mkdir(parents=True, exist_ok=True)
    return results


def write(
    results: Path, points: list[Point], timings: list[Timing], costs: list[CodecCost], failures: list[Failure]
) -> None:
    """Write all figures into a folder as CSV, the points as JSON too, each file whole or not at all. Raises OSError."""
    for name, kind, rows in (
        (POINTS, Point, points),
        ("timings.csv", Timing, timings),
        ("costs.csv", CodecCost, costs),
        ("failures.csv", Failure, failures),
    ):
        with whole_file(results / name) as partial:
            write_rows(partial, rows, kind)
    with whole_file(results / "points.json") as partial:
        records = [{**asdict(point), "bits_per_sample": point.bits_per_sample} for point in points]
        # JSON has no infinity, the SNR of an exact copy.
        texts = [{name: "inf" if value == math.inf else value for name, value in record.items()} for record in records]
        partial.write_text(json.dumps(texts, indent=1, allow_nan=False) + "\n", encoding="utf-8")
