"""One verdict for `measure`, `live`, `play` and the pytest plugin: passed, failed, or undecided on a busy machine."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

from vibrocast.errors import FAILED, HOST_BUSY, LIMIT_MISSED, REGRESSION
from vibrocast.host.controller import Controller
from vibrocast.host.figures import Noted, Value

LATE_S = 0.05
"""A machine that wakes up later than this from a wait may itself have caused what looks like a fault."""
_WORST_FIRST = (FAILED, REGRESSION, LIMIT_MISSED, HOST_BUSY)
_MAX_SHOWN = 6
# Of the time, and as at most one wait, that other programs may keep this one from a processor.
_QUEUED_SHARE = 0.05
# A controller whose clock has lost so much against this machine's is emulated, and too slow.
_LEAST_SPEED, _LOST_S = 0.98, 0.2


class Verdict(Enum):
    """The verdict on a run. UNDECIDED: this machine may have caused all that is wrong."""

    PASSED = "passed"
    FAILED = "failed"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """What a run has failed for, with the exit code of its kind (vibrocast.errors) and a doubt as of Noted."""

    text: str
    exit_code: int
    doubt: str = ""

    def __str__(self) -> str:
        return f"undecided, because {self.doubt}: {self.text}" if self.doubt else self.text


def findings(exit_code: int, problem: str, noted: Iterable[Noted], action: str) -> list[Finding]:
    """Return one finding of a kind for all that has the same doubt; none where nothing is noted."""
    texts: dict[str, list[str]] = {}
    for text, doubt in noted:
        texts.setdefault(doubt, []).append(text)
    return [
        Finding(f"{problem}: {_shown(each)}; {'repeat on a less busy machine' if doubt else action}", exit_code, doubt)
        for doubt, each in texts.items()
    ]


def judged(
    values: Iterable[Value], misses: Iterable[Noted], where: str = "see [limits] in the bench file"
) -> list[Finding]:
    """Return what is wrong with figures: bits that differ though nothing was lost, and limits missed.

    `misses`: as `figures.missed` returns them. `where`: what to do about them.
    """
    differing = [Noted(f"not {value.name}") for value in values if value.value is False]
    return [
        *findings(
            FAILED,
            "the controller played something else than was sent, though nothing was lost",
            differing,
            "its memory, its firmware or its actuator differs: flash the firmware again, and check the actuators given",
        ),
        *findings(LIMIT_MISSED, "limits missed", misses, where),
    ]


def _shown(texts: Sequence[str]) -> str:
    more = f"; and {len(texts) - _MAX_SHOWN} more" if len(texts) > _MAX_SHOWN else ""
    return "; ".join(texts[:_MAX_SHOWN]) + more


def exit_code_of(found: Iterable[Finding]) -> int:
    """Return the exit code of the worst finding; 0 without any."""
    codes = {HOST_BUSY if each.doubt else each.exit_code for each in found}
    return next((code for code in _WORST_FIRST if code in codes), 0)


def verdict_on(found: Iterable[Finding]) -> Verdict:
    """Return the verdict on a run of which all this was found."""
    code = exit_code_of(found)
    return {0: Verdict.PASSED, HOST_BUSY: Verdict.UNDECIDED}.get(code, Verdict.FAILED)


def doubt_of(controller: Controller, margin_s: float = LATE_S) -> str:
    """Return why this machine may have changed times since `Controller.watch_time`; empty where it kept them.

    `margin_s`: it may be so late.
    """
    if controller.late_s > margin_s:
        return f"this machine woke up {1e3 * controller.late_s:.0f} ms late"
    seconds, queued_s = controller.queued_s
    if queued_s > LATE_S + _QUEUED_SHARE * seconds:
        return f"other programs kept this one from a processor for {queued_s:.1f} of {seconds:.1f} s"
    passed_s, device_s = controller.watched_s
    if passed_s - device_s > max(_LOST_S, (1 - _LEAST_SPEED) * passed_s):
        return f"the emulated controller ran at {100 * device_s / passed_s:.0f} % of its speed"
    return ""
