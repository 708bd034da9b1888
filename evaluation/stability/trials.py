"""Trials of a method in one hard condition each, run on all cores: whatever happens in one is its outcome."""

import faulthandler
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from enum import StrEnum

from codec import CodecError
from codec.interface import Setting
from device_protocol.coded_stream import StreamError
from device_protocol.messages import MessageError
from device_protocol.transports import TransportError
from host.controller import ControllerError
from textures import TextureError

LIMIT_S = 120.0
"""A trial that takes longer hangs. Those that run take a few seconds at most, coding of an hour excepted."""
CLEAR_ERRORS = (CodecError, ControllerError, MessageError, StreamError, TextureError, TransportError)
"""Errors that tell a person what to do; any other that comes out of a trial is a crash."""


class Outcome(StrEnum):
    """What came of a trial, the best first."""

    HOLDS = "holds"
    NOT_TRIED = "not tried"
    REFUSED = "refused"
    DEGRADED = "degraded"
    FAILS = "fails"

    @property
    def letter(self) -> str:
        """The letter of the maps."""
        return "-" if self is Outcome.NOT_TRIED else self.value[0].upper()


@dataclass(frozen=True)
class Measured:
    """What a trial measured: its outcome, named figures (None: no value), and in words what a person gets."""

    outcome: Outcome
    figures: Mapping[str, float | None]
    effect: str = ""


@dataclass(frozen=True)
class Trial:
    """One condition to try: of which map, method and case, at which value of what the map varies, and the measurement.

    `measure`: a function of a module, or a partial of one, so that another process can be given it.
    """

    map: str
    method: str
    case: str
    setting: str
    value: float | None
    measure: Callable[[], Measured]


@dataclass(frozen=True)
class Cell:
    """The outcome of a trial; fields as in Trial and Measured."""

    map: str
    method: str
    case: str
    setting: str
    value: float | None
    outcome: Outcome
    figures: Mapping[str, float | None]
    effect: str

    def figure(self, name: str) -> float:
        """Return a figure, NaN where it has no value."""
        value = self.figures.get(name)
        return math.nan if value is None else value


def setting_text(setting: Setting) -> str:
    """Return a codec's setting as text of names and values."""
    return " ".join(f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}" for name, value in setting.items())


def attempt(trial: Trial) -> Cell:
    """Run a trial in this process. An error that a person can act on is a refusal, any other a crash."""
    try:
        measured = trial.measure()
    except CLEAR_ERRORS as error:
        measured = Measured(Outcome.REFUSED, {}, " ".join(str(error).split()))
    except Exception as error:
        measured = Measured(Outcome.FAILS, {}, f"CRASH: {type(error).__name__}: {' '.join(str(error).split())}")
    return _cell(trial, measured)


def run(
    trials: Sequence[Trial],
    workers: int | None = None,
    limit_s: float = LIMIT_S,
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[Cell]:
    """Return the cells of all trials, in their order, tried in `workers` processes (None: one for each core).

    A process that a trial kills, or that is ended because the trial takes longer than `limit_s`, costs that cell only.
    `progress` is called with the part that is done, from 0 to 1, and the condition that was tried last.
    """
    workers = workers or os.cpu_count() or 1
    cells: dict[int, Cell] = {}
    left = list(range(len(trials)))[::-1]
    while left:
        suspects = _run_until_broken(trials, left, cells, workers, limit_s, progress)
        for index in suspects:
            cells[index] = _alone(trials[index], limit_s)
    return [cells[index] for index in range(len(trials))]


def _run_until_broken(
    trials: Sequence[Trial],
    left: list[int],
    cells: dict[int, Cell],
    workers: int,
    limit_s: float,
    progress: Callable[[float, str], None],
) -> list[int]:
    """Take trials from the end of `left` until it is empty, or until a process dies: return those under way then."""
    under_way: dict[Future[Cell], int] = {}
    with ProcessPoolExecutor(workers) as pool:
        while left or under_way:
            try:
                while left and len(under_way) <= workers:
                    under_way[pool.submit(_attempt_within, trials[left[-1]], limit_s)] = left[-1]
                    left.pop()
                for done in wait(under_way, return_when=FIRST_COMPLETED).done:
                    cell = done.result()
                    cells[under_way.pop(done)] = cell
                    progress(len(cells) / len(trials), f"{cell.map}: {cell.method}, {cell.case}")
            except BrokenProcessPool:
                return list(under_way.values())
    return []


def _alone(trial: Trial, limit_s: float) -> Cell:
    """Run a trial in a process of its own, which it may kill."""
    started_s = time.monotonic()
    with ProcessPoolExecutor(1) as pool:
        try:
            return pool.submit(_attempt_within, trial, limit_s).result()
        except BrokenProcessPool:
            hangs = time.monotonic() - started_s >= limit_s
            effect = f"HANGS: no end within {limit_s:g} s" if hangs else "CRASH: the process died"
            return _cell(trial, Measured(Outcome.FAILS, {}, effect))


def _attempt_within(trial: Trial, limit_s: float) -> Cell:
    """Run a trial; end this process, also out of a loop in C, if it takes longer."""
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(limit_s, exit=True, file=nowhere)
        try:
            return attempt(trial)
        finally:
            faulthandler.cancel_dump_traceback_later()


def _cell(trial: Trial, measured: Measured) -> Cell:
    figures = {name: None if value is None else round(float(value), 4) for name, value in measured.figures.items()}
    return Cell(
        trial.map, trial.method, trial.case, trial.setting, trial.value, measured.outcome, figures, measured.effect
    )
