"""Tests of the workers: a task that raises or kills its process costs only itself."""

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import psutil
import pytest

from vibrocast import workers
from vibrocast.workers import WorkerDiedError, WorkersError, on_cluster, on_cores

Work = Callable[[], int]
Tasks = Iterator[tuple[int, Work]]


def double(number: int) -> int:
    return 2 * number


def reject() -> NoReturn:
    raise ValueError("rejected")


def die() -> NoReturn:
    os._exit(1)


def version() -> str:
    return "1"


def version_by_process() -> str:
    return str(os.getpid())


def tasks() -> Tasks:
    bad: dict[int, Work] = {1: reject, 4: die}
    return ((number, bad.get(number, partial(double, number))) for number in range(6))


def check(outcomes: dict[int, int | Exception]) -> None:
    assert sorted(outcomes) == list(range(6))
    rejected, died = outcomes.pop(1), outcomes.pop(4)
    assert isinstance(rejected, ValueError) and str(rejected) == "rejected"
    assert isinstance(died, WorkerDiedError)
    assert outcomes == {number: 2 * number for number in (0, 2, 3, 5)}


def test_on_cores_a_bad_task_costs_only_itself() -> None:
    check(dict(on_cores(tasks(), 2)))


def test_a_process_of_a_pool_ends_with_the_process_that_is_killed() -> None:
    program = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from vibrocast.workers import end_with_parent

pool = ProcessPoolExecutor(1, multiprocessing.get_context("forkserver"), end_with_parent)
print(pool.submit(os.getpid).result(), flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        worker = psutil.Process(int(process.stdout.readline()))
        process.kill()
    worker.wait(30)


def note(path: Path, seconds: float) -> int:
    with path.open("a") as file:
        file.write("once\n")
    time.sleep(seconds)
    return 1


def test_no_process_is_left_where_the_work_is_cut(tmp_path: Path) -> None:
    works: list[tuple[int, Work]] = [(0, partial(double, 1)), (1, partial(note, tmp_path / "notes", 600.0))]
    outcomes = on_cores(iter(works), 2)
    assert next(outcomes) == (0, 2)
    outcomes.close()
    assert multiprocessing.active_children() == []


def cluster(workers: int) -> Any:
    import dask  # loaded here only: the processes of `on_cores` load this module too
    import distributed

    # Dask does not restart a worker that a task kills while it starts. One death a task keeps that from all workers.
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        return distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")  # type: ignore[no-untyped-call]


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with pytest.MonkeyPatch.context() as patched, cluster(workers=2) as running:
        patched.setattr(workers, "PATIENCE_S", 100.0)  # on a busy machine a worker takes long to start again
        yield running.scheduler_address


@pytest.mark.slow
def test_on_a_cluster_a_bad_task_costs_only_itself(scheduler: str) -> None:
    check(dict(on_cluster(tasks(), scheduler, version)))


@pytest.mark.slow
def test_workers_of_another_version_are_rejected(scheduler: str) -> None:
    with pytest.raises(WorkersError, match="does not have this version"):
        list(on_cluster(tasks(), scheduler, version_by_process))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense", "http://127.0.0.1:80"])
def test_an_address_without_a_scheduler_is_rejected(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    with pytest.raises(WorkersError, match="no Dask scheduler answers"):
        list(on_cluster(tasks(), address, version))


@pytest.mark.slow
def test_a_scheduler_without_workers_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE_S", 0.2)
    with cluster(workers=0) as running, pytest.raises(WorkersError, match="has no workers"):
        list(on_cluster(tasks(), running.scheduler_address, version))


def test_a_file_that_is_changed_or_renamed_changes_the_digest(tmp_path: Path) -> None:
    first, same, other = (tmp_path / name for name in ("first", "same", "other"))
    for path, text in ((first, "1"), (same, "1"), (other, "2")):
        path.write_text(text)
    digest = workers.digest_of({"module.py": first})
    assert digest == workers.digest_of({"module.py": same})
    assert digest != workers.digest_of({"module.py": other}) and digest != workers.digest_of({"renamed.py": first})
