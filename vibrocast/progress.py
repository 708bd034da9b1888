"""Shows on stderr how far long work is: a bar in a terminal, elsewhere a plain line about once a second."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

LINE_INTERVAL_S = 1.0
notes = logging.getLogger("vibrocast.notes")
"""Takes, as warnings, what a person should know while work goes on; the command line prints it on stderr."""


class Update(Protocol):
    """Reports the finished part of the work, from 0 to 1, or None if its end is unknown, and details."""

    def __call__(self, part: float | None, details: str = "", /) -> None:
        """Report the finished part of the work, and details such as a rate."""


@contextmanager
def bar(work: str, details_only: bool = False) -> Iterator[Update]:
    """Yield what the work, named `work`, tells how far it is, as often as it likes.

    `details_only`: the details are a picture of their own, and fill the line.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        columns = (
            [TextColumn("{task.description}")] if details_only else [BarColumn(), TextColumn("{task.description}")]
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
            task = shown.add_task(work, total=1.0)

            def update(part: float | None, details: str = "", /) -> None:
                shown.tasks[task].total = None if part is None else 1.0
                shown.update(task, completed=part or 0.0, description=f"{work} {details}")

            yield update
    else:
        yield _Lines(work)


class _Lines:
    """Prints nothing for work of less than a second."""

    def __init__(self, work: str) -> None:
        self._work = work
        self._printed_s = time.monotonic()

    def __call__(self, part: float | None, details: str = "", /) -> None:
        now_s = time.monotonic()
        if now_s - self._printed_s >= LINE_INTERVAL_S:
            self._printed_s = now_s
            done = "" if part is None else f" {100 * part:.0f} %"
            print(f"{self._work}{done} {details}".rstrip(), file=sys.stderr, flush=True)
