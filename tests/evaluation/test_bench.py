"""Tests of the benchmark: a run that is cut goes on to the same figures, and what fails costs only its cell."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.codec.eva_models import tiny_model
from tests.evaluation.conftest import here
from vibrocast import codec, workers
from vibrocast.codec import CodecError, metrics
from vibrocast.codec.encoding import encode_recording
from vibrocast.errors import InputError
from vibrocast.evaluation import bench, cells
from vibrocast.evaluation.bench import CellCounts, Journal
from vibrocast.evaluation.cells import Cell, Measured, Method, RatePoint
from vibrocast.evaluation.comparison import Measurements
from vibrocast.evaluation.points import Failure, Point, read_rows
from vibrocast.textures import Recording
from vibrocast.textures.dataset import entries, load

COARSE, FINE, LOSSLESS = RatePoint("mdct", {"step": 1.0}), RatePoint("mdct", {"step": 0.25}), RatePoint("flac", {})
METHODS = [Method("mdct", (COARSE, FINE)), Method("flac", (LOSSLESS,))]
Results = list[Measured | Failure]


def cut_after(count: int, tasks: Iterator[bench.Task]) -> bench.Outcomes:
    for number, outcome in enumerate(here(tasks)):
        if number == count:
            raise KeyboardInterrupt
        yield outcome


def run(
    folder: Path,
    results: Path,
    work: Any = here,
    chosen: list[Method] = METHODS,
    repeats: int = 0,
    progress: Callable[[CellCounts], None] = lambda _: None,
) -> Results:
    with Journal(results / bench.JOURNAL) as journal:
        return bench.run(entries(folder), load, chosen, repeats, journal, work, progress)


def written(results: Path, measured: Results) -> dict[str, bytes]:
    points = [each.point for each in measured if isinstance(each, Measured)]
    failures = [each for each in measured if isinstance(each, Failure)]
    bench.write(results, Measurements(points, [], [], failures))
    return {name: (results / name).read_bytes() for name in ("points.csv", "failures.csv")}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return bench.results_folder(tmp_path / "out")


@pytest.fixture
def whole(folder: Path, tmp_path: Path) -> dict[str, bytes]:
    """The files of a run that nothing disturbs."""
    results = bench.results_folder(tmp_path / "whole")
    return written(results, run(folder, results))


def test_points_are_of_whole_files_in_a_fixed_order(folder: Path, results: Path, whole: dict[str, bytes]) -> None:
    (results / "points.csv").write_bytes(whole["points.csv"])
    points = read_rows(results / "points.csv", Point)
    names = [
        (trace, *cell)
        for trace in ("rough", "wood")
        for cell in (("mdct", "step=1"), ("mdct", "step=0.25"), ("flac", ""))
    ]
    assert [(point.trace, point.codec, point.setting) for point in points] == names
    recording = load(entries(folder)[1])
    stream = encode_recording(recording, setting={"step": 0.25}, highpass_hz=None, touch=0).stream
    stream.save(results / "wood.vct")
    fine = points[4]
    assert fine.bytes_total == (results / "wood.vct").stat().st_size
    quality = asdict(metrics.measure(recording.samples, stream.decode(), 2800, recording.unit))
    assert {name: getattr(fine, name) for name in quality} == pytest.approx(quality, abs=1e-6)
    assert fine.delay_ms == pytest.approx(1000 * 2 * stream.delay_samples / 2800, abs=1e-6)
    timed = run(folder, results, chosen=METHODS[:1], repeats=1)
    timings = [each.timing for each in timed if isinstance(each, Measured) and each.timing]
    assert [(each.trace, each.setting) for each in timings][:2] == [("rough", "step=1"), ("rough", "step=0.25")]
    assert all(each.encode_s_per_megasample > 0 and each.decode_s_per_megasample > 0 for each in timings)
    assert run(folder, results, partial(cut_after, 0), METHODS[:1], repeats=1) == timed


@pytest.mark.parametrize("finished", [0, 1, 4])
def test_an_interrupted_run_resumes_to_the_same_figures(
    folder: Path, results: Path, whole: dict[str, bytes], finished: int
) -> None:
    with suppress(KeyboardInterrupt):
        run(folder, results, partial(cut_after, finished))
    told: list[CellCounts] = []
    measured = run(folder, results, progress=lambda counts: told.append(replace(counts)))
    assert written(results, measured) == whole
    assert told[-1] == CellCounts(cells=6, done=6, failed=0, measured=6 - finished)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-9], lambda data: b"{}\n" + data[300:] + b"\xff", lambda data: b""]
)
def test_a_damaged_journal_costs_only_the_lines_that_are_damaged(
    folder: Path, results: Path, whole: dict[str, bytes], damage: Callable[[bytes], bytes]
) -> None:
    run(folder, results)
    journal = results / bench.JOURNAL
    journal.write_bytes(damage(journal.read_bytes()))
    assert written(results, run(folder, results)) == whole
    assert written(results, run(folder, results, partial(cut_after, 0))) == whole  # all is in the journal again


@pytest.mark.slow
def test_on_all_cores_and_on_a_cluster_the_figures_are_the_same(folder: Path, tmp_path: Path) -> None:
    distributed: Any = pytest.importorskip("distributed")
    chosen = [*METHODS, *cells.families([tiny_model()])]
    alone, results = (bench.results_folder(tmp_path / name) for name in ("alone", "cores"))
    whole = written(alone, run(folder, alone, chosen=chosen))
    assert written(results, run(folder, results, partial(workers.on_cores, processes=2), chosen)) == whole
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        work = partial(workers.on_cluster, address=cluster.scheduler_address, version=workers.program_version)
        results = bench.results_folder(tmp_path / "cluster")
        assert written(results, run(folder, results, work, chosen)) == whole


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (CodecError("too loud;\nturn it down"), "too loud; turn it down"),
        (ZeroDivisionError("division"), "ZeroDivisionError: division"),
        (MemoryError(), "MemoryError"),
    ],
)
def test_a_codec_that_raises_loses_only_its_cells_and_runs_again(
    folder: Path, results: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, error: Exception, reason: str
) -> None:
    def reject(*_: object) -> Any:
        raise error

    told: list[CellCounts] = []
    with monkeypatch.context() as patched:
        patched.setitem(codec.BUILT_IN, "mdct", replace(codec.BUILT_IN["mdct"], make_encoder=reject))
        measured = run(folder, results, progress=lambda counts: told.append(replace(counts)))
    assert [each for each in measured if isinstance(each, Failure)] == [
        Failure(trace, "mdct", setting, reason) for trace in ("rough", "wood") for setting in ("step=1", "step=0.25")
    ]
    assert told[-1] == CellCounts(cells=6, done=6, failed=4, measured=6)
    assert written(results, run(folder, results)) == whole


def test_recordings_that_cannot_be_read_cost_only_themselves(folder: Path, results: Path) -> None:
    (folder / "broken.wav").write_bytes(b"RIFF")
    np.savetxt(folder / "nan.csv", [0.0, np.nan, 1.0], header="rate_hz: 2800\n# unit: um")
    (folder / "rateless.txt").write_text("1\n2\n")
    measured = run(folder, results, chosen=METHODS[:1])
    failures = [each for each in measured if isinstance(each, Failure)]
    assert [(each.trace, each.codec, each.setting) for each in failures] == [
        (trace, "", "") for trace in ("broken", "nan", "rateless")
    ]
    assert "broken.wav: not a .wav file that can be read" in failures[0].reason
    assert "sample 1 of channel 0 is nan" in failures[1].reason
    assert "does not state its sample rate" in failures[2].reason
    assert len(measured) == 3 + 4


def test_silence_has_no_quality_and_an_exact_copy_has_infinite_snr(results: Path) -> None:
    silence = Cell("silence", Recording(np.zeros((600, 1)), 2800.0, "um", "silence"), METHODS[0], COARSE, 0)
    assert silence.measure().point.snr_db is None
    samples = np.random.default_rng(0).integers(-32768, 32768, (600, 2)) / 32768
    copy = Cell("copy", Recording(samples, 2800.0, "full scale", "copy"), METHODS[1], LOSSLESS, 0).measure()
    assert copy.point.snr_db == np.inf and copy.point.samples == 1200
    bench.write(results, Measurements([copy.point], [], [], []))
    assert read_rows(results / "points.csv", Point) == [copy.point]


def test_what_decides_the_figures_is_in_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Recording(np.ones((4, 1)), 2800.0, "um", "ones")
    cell = Cell("trace", recording, METHODS[0], COARSE, 0)
    changes: list[dict[str, Any]] = [
        {"trace": "other"},
        {"recording": replace(recording, samples=np.ones((2, 2)))},
        {"recording": replace(recording, rate_hz=8000.0)},
        {"recording": replace(recording, unit="m/s^2")},
        {"method": replace(METHODS[0], name="other")},
        {"rate_point": FINE},
        {"repeats": 3},
    ]
    others = [replace(cell, **change) for change in changes]
    keys = {each.key for each in (cell, *others)}
    assert len(keys) == 1 + len(others)
    assert replace(cell, recording=replace(recording, name="elsewhere")).key in keys
    monkeypatch.setattr(cells, "program_version", lambda: "another")
    assert cell.key not in keys


def test_two_at_once_leave_a_journal_of_both(folder: Path, results: Path, whole: dict[str, bytes]) -> None:
    with Journal(results / bench.JOURNAL) as journal:
        assert written(results, run(folder, results, chosen=METHODS[:1])) != whole
        measured = bench.run(entries(folder), load, METHODS, 0, journal, here, lambda _: None)
    assert written(results, measured) == whole
    assert len((results / bench.JOURNAL).read_bytes().splitlines()) == 4 + 6


@pytest.mark.parametrize("name", ["results.md", "results/points.csv", "results/costs.csv"])
def test_files_of_other_origin_are_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "thesis.tex").touch()
    assert bench.results_folder(tmp_path) == tmp_path / "results"
    (tmp_path / name).write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=f"{name}: would be overwritten"):
        bench.results_folder(tmp_path)
    (tmp_path / "results" / bench.JOURNAL).touch()
    assert bench.results_folder(tmp_path) == tmp_path / "results"
    bench.write(bench.results_folder(tmp_path / "own"), Measurements([], [], [], []))  # without its journal
    assert bench.results_folder(tmp_path / "own") == tmp_path / "own" / "results"
