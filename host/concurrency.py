"""Works with many controllers at the same time, each in a thread of its own, so that each waits and fails alone."""

import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TypeVar

from vibrocast.host.controller import Controller

_Session = TypeVar("_Session", bound=Controller)
_Result = TypeVar("_Result")

_WAIT_S = 0.1


class Interrupted(RuntimeError):
    """The work with all controllers has been interrupted."""


def run_concurrently(
    sessions: Mapping[str, Callable[[], AbstractContextManager[_Session]]],
    work: Callable[[str, _Session, Callable[[], None]], _Result],
) -> dict[str, _Result | Exception]:
    """Open a session with each controller and do the work with all at once; return by name what it gave or raised.

    `work(name, controller, check)` calls `check` often, such as at each report of a player; it raises Interrupted once
    this function has been interrupted, which waits until all have stopped their controllers. A player waits for its
    controller nearly all the time, so threads take turns without one starving another.
    """
    results: dict[str, _Result | Exception] = {}
    interrupted = threading.Event()
    # Not Thread.join: where a signal interrupts it, Python 3.11 takes the thread to have ended (CPython issue 90882).
    ended = {name: threading.Event() for name in sessions}

    def check() -> None:
        if interrupted.is_set():
            raise Interrupted

    def run(name: str) -> None:
        try:
            with sessions[name]() as controller:
                results[name] = work(name, controller, check)
        except Exception as error:  # of one controller: the others go on
            results[name] = error
        finally:
            ended[name].set()

    threads = [threading.Thread(target=run, args=(name,), name=name) for name in sessions]
    for thread in threads:
        thread.start()
    try:
        for each in ended.values():
            while not each.wait(_WAIT_S):
                pass
    except BaseException:
        interrupted.set()
        for each in ended.values():
            each.wait()
        raise
    return {name: results[name] for name in sessions}
