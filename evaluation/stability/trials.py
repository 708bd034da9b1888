"""Trials of a method under one hard condition each, run on all cores; a crash is an outcome too."""

import math
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.host.controller import ControllerError
from vibrocast.workers import cores, on_cores

LIMIT_S = 240.0
"""A trial that takes more processor time hangs. Most take a second, coding of an hour up to 20."""
CLEAR_ERRORS = (ControllerError, InputError, MessageError, TransportError)
"""Errors that tell a person what to do; any other that comes out of a trial is a crash."""


class Outcome(StrEnum):
    """Outcomes of a trial, the best first."""

    HOLDS = "holds"
    REJECTED = "rejected"
    DEGRADED = "degraded"
    FAILS = "fails"

    @property
    def letter(self) -> str:
        """The letter of the maps."""
        return self.value[0].upper()


@dataclass(frozen=True)
class Measured:
    """The outcome of a trial, its figures by name (None: no value), and the effect on the user in words."""

    outcome: Outcome
    figures: Mapping[str, float | None]
    effect: str = ""


def graded(value: float, held: float, failed: float, figures: Mapping[str, float | None], effect: str = "") -> Measured:
    """Return the outcome by a value that should be low: HOLDS up to `held`, FAILS above `failed`."""
    outcome = Outcome.HOLDS if value <= held else Outcome.FAILS if value > failed else Outcome.DEGRADED
    return Measured(outcome, figures, effect)


@dataclass(frozen=True)
class Trial:
    """One condition: its method and case, the measurement, the setting, and the value that the map varies.

    `measure`: a function of a module, or a partial of one, so that another process can be given it. `to_be_rejected`:
    that it must end with an error that a person can act on, one of CLEAR_ERRORS. `map`: as Map.trials fills it in.
    """

    method: str
    case: str
    measure: Callable[[], Measured]
    setting: str = ""
    value: float | None = None
    to_be_rejected: bool = False
    map: str = ""


@dataclass(frozen=True)
class Verdict:
    """The outcome of a trial, and the one that is right; other fields as in Trial and Measured."""

    map: str
    method: str
    case: str
    setting: str
    value: float | None
    outcome: Outcome
    figures: Mapping[str, float | None]
    effect: str
    required: Outcome = Outcome.HOLDS

    @property
    def sound(self) -> bool:
        """Whether the outcome is right: it holds, or is rejected where it must be."""
        return self.outcome is self.required

    def figure(self, name: str) -> float:
        """Return a figure, NaN where it has no value."""
        value = self.figures.get(name)
        return math.nan if value is None else value


def attempt(trial: Trial) -> Verdict:
    """Run a trial in this process. An error that a person can act on is a rejection, any other a crash."""
    try:
        measured = trial.measure()
        if trial.to_be_rejected:
            measured = Measured(Outcome.FAILS, {}, "accepted, though it must be rejected")
    except CLEAR_ERRORS as error:
        measured = Measured(Outcome.REJECTED, {}, " ".join(str(error).split()))
    except Exception as error:
        measured = Measured(Outcome.FAILS, {}, f"CRASH: {type(error).__name__}: {' '.join(str(error).split())}")
    return _cell(trial, measured)


def run(
    trials: Sequence[Trial],
    limit_s: float = LIMIT_S,
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[Verdict]:
    """Return the cells of all trials, in their order, tried on all cores.

    A process that a trial kills, or that is ended because the trial takes more than `limit_s` of a core, costs that
    cell only. `progress` is called with the part that is done, from 0 to 1, and the last condition.
    """
    cells: dict[int, Verdict] = {}
    tasks = ((number, partial(_attempt_within, trial, limit_s)) for number, trial in enumerate(trials))
    for number, outcome in on_cores(tasks, cores()):
        cells[number] = outcome if isinstance(outcome, Verdict) else _lost(trials[number], outcome, limit_s)
        progress(len(cells) / len(trials), f"{cells[number].map}: {cells[number].method}, {cells[number].case}")
    return [cells[number] for number in range(len(trials))]


def _lost(trial: Trial, error: Exception, limit_s: float) -> Verdict:
    """Return the cell of a trial whose process gave no answer."""
    effect = f"CRASH: {error}, or took longer than {limit_s:g} s of a core"
    return _cell(trial, Measured(Outcome.FAILS, {}, effect))


def _attempt_within(trial: Trial, limit_s: float) -> Verdict:
    """Run a trial; the system ends this process, also out of a loop in C, if it takes more processor time."""
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        return attempt(trial)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _cell(trial: Trial, measured: Measured) -> Verdict:
    # A zero is added because a small negative figure would be rounded to -0.0.
    figures = {
        name: None if value is None else round(float(value), 4) + 0.0 for name, value in measured.figures.items()
    }
    return Verdict(
        trial.map,
        trial.method,
        trial.case,
        trial.setting,
        trial.value,
        measured.outcome,
        figures,
        measured.effect,
        Outcome.REJECTED if trial.to_be_rejected else Outcome.HOLDS,
    )
