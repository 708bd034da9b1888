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
from vibrocast.evaluation.cells import RatePoint
from vibrocast.host.controller import ControllerError
from vibrocast.textures import Recording
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
    """One condition: its method and case, its setting in words, and the value that the map varies.

    `measure`: a function of a module, so that another process can be given it. `rate_points`: what it codes with, if
    anything. `recording`: the user's, if it is of one. `to_be_rejected`: that it must end with one of CLEAR_ERRORS.
    """

    method: str
    case: str = ""
    setting: str = ""
    value: float = math.nan
    rate_points: tuple[RatePoint, ...] = ()
    recording: Recording | None = None
    measure: Callable[["Trial"], Measured] | None = None
    to_be_rejected: bool = False
    map: str = ""

    @property
    def rate_point(self) -> RatePoint:
        """The first of the rate points."""
        return self.rate_points[0]

    @property
    def level(self) -> str:
        """What the setting begins with, where several rate points of a method are tried."""
        return self.setting.partition(":")[0]


def attempt(trial: Trial) -> Measured:
    """Run a trial in this process. An error that a person can act on is a rejection, any other a crash."""
    assert trial.measure is not None, "a map gives each trial its function"
    try:
        measured = trial.measure(trial)
        if trial.to_be_rejected:
            return Measured(Outcome.FAILS, {}, "accepted, though it must be rejected")
        return measured
    except CLEAR_ERRORS as error:
        return Measured(Outcome.REJECTED, {}, " ".join(str(error).split()))
    except Exception as error:
        return Measured(Outcome.FAILS, {}, f"CRASH: {type(error).__name__}: {' '.join(str(error).split())}")


def run(
    trials: Sequence[Trial],
    limit_s: float = LIMIT_S,
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[Measured]:
    """Return what all trials measured, in their order, tried on all cores.

    A process that a trial kills, or that is ended because the trial takes more than `limit_s` of a core, costs that
    trial only. `progress` is called with the part that is done, from 0 to 1, and the last condition.
    """
    found: dict[int, Measured] = {}
    tasks = ((number, partial(_attempt_within, trial, limit_s)) for number, trial in enumerate(trials))
    for number, outcome in on_cores(tasks, cores()):
        if not isinstance(outcome, Measured):
            lost = f"CRASH: {outcome}, or took longer than {limit_s:g} s of a core"
            outcome = Measured(Outcome.FAILS, {}, lost)
        found[number] = outcome
        trial = trials[number]
        progress(len(found) / len(trials), f"{trial.map}: {trial.method}, {trial.case}")
    return [found[number] for number in range(len(trials))]


def _attempt_within(trial: Trial, limit_s: float) -> Measured:
    """Run a trial; the system ends this process, also out of a loop in C, if it takes more processor time."""
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        return attempt(trial)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
