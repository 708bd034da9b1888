"""The benchmark: every recording at every setting of every method, each measured once and kept in a journal."""

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import TypeAlias

from vibrocast import textures
from vibrocast.errors import InputError
from vibrocast.evaluation import cost, kinds, speed
from vibrocast.evaluation.cells import Cell, Measured, Method, coders
from vibrocast.evaluation.comparison import TABLES, Measurements
from vibrocast.evaluation.points import Failure, Point, Timing, read_rows, write_rows
from vibrocast.progress import Update
from vibrocast.textures import dataset
from vibrocast.textures.dataset import DatasetEntry

JOURNAL, PAGE = "journal.jsonl", "results.md"


@dataclass(frozen=True)
class Recordings:
    """The recordings that are measured, and how codecs get them: `unit`, rate and high-pass as `load_highpassed` does.

    `units`, `removed_energy`: of each that was loaded, its unit, and the part of its energy below the high-pass.
    """

    entries: Sequence[DatasetEntry]
    unit: str | None = None
    stream_rate_hz: int | None = None
    highpass_hz: float | None = None
    units: dict[str, str] = field(default_factory=dict)
    removed_energy: dict[str, float] = field(default_factory=dict)

    def load(self, entry: DatasetEntry) -> textures.Recording:
        """Load a recording. Raises TextureError."""
        passed = dataset.load_highpassed(entry, self.highpass_hz, self.stream_rate_hz, unit=self.unit)
        self.units[entry.name], self.removed_energy[entry.name] = passed.recording.unit, passed.removed_energy
        return passed.recording


class Journal:
    """The file that keeps each cell as soon as it is measured, one line of JSON with its key and its figures.

    A line that is torn, or damaged, is as good as none: that cell is measured again.
    """

    def __init__(self, path: Path) -> None:
        """Open or begin a journal. Raises OSError."""
        held = path.read_bytes() if path.exists() else b""
        whole = held[: held.rfind(b"\n") + 1]
        self._measured = dict(filter(None, map(_journal_entry, whole.splitlines())))
        # To append, so that two benchmarks of one folder do not write over each other's lines.
        self._file = path.open("ab")
        self._file.truncate(len(whole))

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, cell: Cell) -> Measured | None:
        """Return the figures of a cell, or None."""
        return self._measured.get(cell.key)

    def add(self, cell: Cell, measured: Measured) -> None:
        """Keep the figures of a cell. Raises OSError."""
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
class CellCounts:
    """How far a run is: cells in all, done, failed among those, and measured by this run rather than an earlier one."""

    cells: int
    done: int = 0
    failed: int = 0
    measured: int = 0


Task: TypeAlias = tuple[tuple[int, Cell], Callable[[], Measured]]
Outcomes: TypeAlias = Generator[tuple[tuple[int, Cell], Measured | Exception], None, None]


def run(
    traces: Sequence[DatasetEntry],
    load: Callable[[DatasetEntry], textures.Recording],
    chosen: Sequence[Method],
    repeats: int,
    journal: Journal,
    workers: Callable[[Iterator[Task]], Outcomes],
    progress: Callable[[CellCounts], None],
) -> list[Measured | Failure]:
    """Measure all cells that the journal does not hold; return the figures of all, by recording, method and setting.

    A recording that cannot be loaded is one failure, a cell whose codec raises another; the next run tries them again.
    `workers`: one of evaluation.workers, its other arguments given. Raises OSError where the journal cannot be
    written, and as the workers.
    """
    results: dict[int, Measured | Failure] = {}
    cells_of_trace = sum(len(method.rate_points) for method in chosen)
    counts = CellCounts(len(traces) * cells_of_trace)

    def note(place: int, result: Measured | Failure, cells: int = 1) -> None:
        results[place] = result
        counts.done += cells
        counts.failed += cells * isinstance(result, Failure)
        progress(counts)

    def tasks() -> Iterator[Task]:
        places = count()
        for trace in traces:
            try:
                cells = _cells(trace, load(trace), chosen, repeats)
            except Exception as error:  # whatever one file does, the others are wanted
                note(next(places), Failure.of(error, trace.name), cells_of_trace)
                continue
            counts.cells -= cells_of_trace - len(cells)
            for cell in cells:
                place = next(places)
                if measured := journal.get(cell):
                    note(place, measured)
                else:
                    yield (place, cell), cell.measure

    # However this ends, no process is left behind.
    with closing(workers(tasks())) as outcomes:
        for (place, cell), outcome in outcomes:
            counts.measured += 1
            if isinstance(outcome, Measured):
                journal.add(cell, outcome)
                note(place, outcome)
            else:
                note(place, Failure.of(outcome, *cell.names))
    return [results[place] for place in sorted(results)]


def _cells(trace: DatasetEntry, recording: textures.Recording, chosen: Sequence[Method], repeats: int) -> list[Cell]:
    return [
        Cell(trace.name, recording, method, rate_point, repeats)
        for method in chosen
        if not method.physical or recording.unit != "full scale"
        for rate_point in method.rate_points
    ]


def results_folder(out: Path) -> Path:
    """Make the folder OUT/results of a run and return it; a run before may have left its results there.

    Raises InputError where files of other origin would be overwritten, OSError where it cannot be made.
    """
    results = out / "results"
    if not (results / JOURNAL).exists() and not _is_ours(results / "points.csv"):
        for path in (out / PAGE, *(results / f"{name}.csv" for name in TABLES)):
            if path.exists():
                raise InputError(f"{path}: would be overwritten, but is not of a benchmark; choose another --out")
    results.mkdir(parents=True, exist_ok=True)
    return results


def _is_ours(points: Path) -> bool:
    try:
        read_rows(points, Point)
    except (InputError, FileNotFoundError):
        return False
    return True


def compared(
    measured: Sequence[Measured | Failure],
    imported: tuple[Sequence[Point], Sequence[Timing]],
    chosen: Sequence[Method],
    recordings: Recordings,
    repeats: int,
    bar: Callable[[str], AbstractContextManager[Update]],
) -> Measurements:
    """Join a run's figures with imported ones of its recordings, and measure the memory and the speed of the methods.

    `bar` opens a report of progress, as `progress.bar` does. Without `repeats`, no speed is measured.
    """
    names = {entry.name for entry in recordings.entries}
    failures = [each for each in measured if isinstance(each, Failure)]
    good = [each for each in measured if isinstance(each, Measured)]
    points = [each.point for each in good] + [point for point in imported[0] if point.trace in names]
    timings = [each.timing for each in good if each.timing] + [one for one in imported[1] if one.trace in names]
    with bar("measuring memory") as update:
        costs = cost.measure_costs(coders(chosen), update)
    timed: list[speed.Speed | Failure] = []
    if repeats:
        with bar("measuring speed") as update:
            measured_names = {each.point.trace for each in good}
            loaded = (recordings.load(entry) for entry in recordings.entries if entry.name in measured_names)
            timed = speed.measure(chosen, points, loaded, repeats, update)
    failures += [each for each in timed if isinstance(each, Failure)]
    speeds = [each for each in timed if not isinstance(each, Failure)]
    return Measurements(points, timings, costs, failures, speeds, kinds.kinds(recordings.entries, kinds.TABLE))


def write(results: Path, measurements: Measurements) -> None:
    """Write all figures into a folder as CSV, each file whole or not at all. Raises OSError."""
    for name, kind in TABLES.items():
        write_rows(results / f"{name}.csv", getattr(measurements, name), kind)
