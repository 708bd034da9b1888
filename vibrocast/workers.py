"""Runs many tasks on all cores or on a Dask cluster; a task that fails, or crashes, costs only itself."""

import hashlib
import logging
import multiprocessing
import os
import pickle
import socket
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from vibrocast.errors import VibrocastError

Key = TypeVar("Key")
Result = TypeVar("Result")
Task: TypeAlias = tuple[Key, Callable[[], Result]]
"""A task: its key, and a function that can be pickled."""
Outcomes: TypeAlias = Generator[tuple[Key, Result | Exception], None, None]

CONNECT_S = 10.0
PATIENCE_S = 20.0
CHECK_S = 2.0
_LIBRARIES = ("vibrocast", "av", "numpy", "onnxruntime", "scipy", "vibromaf")
_THREADS_OF_LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class WorkersError(VibrocastError):
    """There is nobody to do the work, or a worker runs another version; the message says why and what to do."""


class WorkerDiedError(VibrocastError):
    """The process that did a task ended before the work was done."""

    def __init__(self) -> None:
        super().__init__("the process that ran it crashed, or was killed for want of memory")


@cache
def program_version() -> str:
    """Return versions of program and libraries, and a hash of this package: equal ones give equal figures."""
    versions = [f"{name} {_version(name)}" for name in _LIBRARIES]
    package = Path(__file__).parent
    # In a checkout, the folders of the package are links.
    walked = os.walk(package, followlinks=True)
    paths = [Path(folder, name) for folder, _, names in walked for name in names if name.endswith((".py", ".csv"))]
    files = {path.relative_to(package).as_posix(): path for path in paths}
    return ", ".join([*versions, f"sources {digest_of(files)[:12]}"])


def digest_of(files: Mapping[str, Path]) -> str:
    """Return a hash of files and of their names."""
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        digest.update(repr((name, path.read_bytes())).encode())
    return digest.hexdigest()


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:  # a computer that only trains may lack the measuring libraries
        return "none"


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_cores(tasks: Iterator[Task[Key, Result]], processes: int) -> Outcomes[Key, Result]:
    """Yield the key of every task with the result of its work, or the exception that ended it, as they are finished.

    The work runs in that number of `processes`, each on one core. Tasks are taken as they are needed. No process is
    left when the generator is closed.
    """
    from pebble import ProcessExpired, ProcessPool

    # A forked process would share the locks of threads that it does not have.
    pool = ProcessPool(processes, initializer=_prepare_process, context=multiprocessing.get_context("spawn"))
    try:

        def submit(work: Callable[[], Result]) -> Future[Result]:
            # As bytes: a process that dies while it reads a task would take the pool with it.
            future: Future[Result] = pool.submit(_carried, None, pickle.dumps(work))
            return future

        for task, outcome in _outcomes(submit, tasks, lambda: 2 * processes):
            yield task[0], WorkerDiedError() if isinstance(outcome, ProcessExpired) else outcome
    finally:
        pool.stop()
        pool.join()


def _carried(pickled: bytes) -> Any:
    """Return the result of pickled work; raise its exception in a form that reaches the process that asked for it."""
    try:
        return pickle.loads(pickled)()
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise


def on_cluster(tasks: Iterator[Task[Key, Result]], address: str, version: Callable[[], str]) -> Outcomes[Key, Result]:
    """Do as `on_cores` on the workers of the Dask scheduler at an address, such as "tcp://host:8786".

    `version` must return the same here and there. Raises WorkersError without scheduler or workers, and for workers
    of another version.
    """
    import distributed
    from distributed.comm.addressing import get_address_host_port

    for logger in ("distributed", "distributed.client"):  # their warnings that matter are raised
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        # A Client that does not reach its scheduler may block the process when it is garbage-collected.
        socket.create_connection(get_address_host_port(address), CONNECT_S).close()
        client: Any = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise WorkersError(
            f"no Dask scheduler answers at {address} ({error}); start one, or check --scheduler"
        ) from error
    same = ((task, partial(_same_version, version(), version, task[1])) for task in tasks)
    lost: list[Task[Key, Result]] = []
    with client:
        executor = client.get_executor(pure=False)
        for (task, _), outcome in _outcomes(executor.submit, same, lambda: 2 * _threads(client, address)):
            if _is_of_another_version(outcome):
                raise WorkersError(f"a Dask worker does not have this version of vibrocast: {outcome}")
            if _is_of_dask(outcome):
                lost.append(task)
            else:
                yield task[0], outcome
        # Some of these have killed their workers, others only waited there. Which, is seen where each runs alone.
        for task, outcome in _outcomes(executor.submit, iter(lost), lambda: min(1, _threads(client, address))):
            yield task[0], WorkerDiedError() if isinstance(outcome, distributed.KilledWorker) else outcome


def _same_version(wanted: str, version: Callable[[], str], work: Callable[[], Result]) -> Result:
    if version() != wanted:
        raise WorkersError(f"{version()}; install {wanted}")
    return work()


def _is_of_another_version(outcome: object) -> bool:
    """Return whether a worker's answer says that it has this program in another version, or not at all."""
    # The form in which Dask says that a worker lacks a module.
    lacks = type(outcome) is RuntimeError and isinstance(outcome.__cause__, ImportError)
    return lacks or isinstance(outcome, WorkersError)


def _is_of_dask(outcome: object) -> bool:
    """Return whether this is an exception of Dask's own, not of the work: a worker died, or a result with another's."""
    if not isinstance(outcome, Exception) or outcome.__traceback__ is None:
        return False
    *_, (innermost, _) = traceback.walk_tb(outcome.__traceback__)
    return str(innermost.f_globals.get("__name__")).startswith("distributed")


def _threads(client: Any, address: str) -> int:
    """Return the threads of all workers of a cluster. Raises WorkersError where scheduler or workers are gone."""
    try:
        # Where the only worker crashes, another takes its place within seconds.
        client.wait_for_workers(1, PATIENCE_S)
        threads: dict[str, int] = client.nthreads()
    except TimeoutError as error:
        raise WorkersError(f"the scheduler at {address} has no workers; start some: dask worker {address}") from error
    except (OSError, RuntimeError) as error:
        raise WorkersError(f"the Dask scheduler at {address} is gone; start it, and this command, again") from error
    return max(1, sum(threads.values()))


def _prepare_process() -> None:
    """Keep a process to one core, and end it with the process that started it."""
    os.environ.update(dict.fromkeys(_THREADS_OF_LIBRARIES, "1"))
    end_with_parent()


def end_with_parent() -> None:
    """From now on, end this process of a pool with the process that started it, even if that one is killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a process of a pool was started by another"
    parent.join()
    os._exit(1)


def _outcomes(
    submit: Callable[[Callable[[], Result]], Future[Result]],
    tasks: Iterator[Task[Key, Result]],
    capacity: Callable[[], int],
) -> Iterator[tuple[Task[Key, Result], Result | Exception]]:
    """Yield tasks with their outcomes; no more of them than `capacity` returns are under way at once."""
    running: dict[Future[Result], Task[Key, Result]] = {}
    while True:
        for task in islice(tasks, max(0, capacity() - len(running))):
            running[submit(task[1])] = task
        if not running:
            return
        done, _ = wait(running, CHECK_S, FIRST_COMPLETED)
        for future in done:
            task = running.pop(future)
            try:
                yield task, future.result()
            except CancelledError as error:
                raise WorkersError(
                    "the Dask cluster has dropped the work; start it, and this command, again"
                ) from error
            except Exception as error:
                yield task, error
