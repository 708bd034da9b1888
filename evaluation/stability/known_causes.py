"""Why methods fail and what to do about it: fixed sentences, by map, method and case, in known_causes.csv."""

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

from vibrocast.evaluation.points import read_rows
from vibrocast.evaluation.stability.trials import Outcome, Verdict

TABLE = Path(__file__).parent / "known_causes.csv"

_UNKNOWN = {
    Outcome.REJECTED: ("it does not take this", "as the error says"),
    Outcome.DEGRADED: ("it is made for other conditions than this", "a finer setting, or another method"),
    Outcome.FAILS: ("it is not made for this", "another method"),
}


@dataclass(frozen=True)
class Cause:
    """Why cells have an outcome, and the remedy.

    `map`, `method`, `case`: patterns, as of file names. `outcomes`: letters of Outcome.
    """

    map: str
    method: str
    case: str
    outcomes: str
    cause: str
    remedy: str

    def explains(self, cell: Verdict) -> bool:
        """Return whether this is about a cell."""
        pairs = ((cell.map, self.map), (cell.method, self.method), (cell.case, self.case))
        return cell.outcome.letter in self.outcomes and all(fnmatchcase(text, pattern) for text, pattern in pairs)


@cache
def known_causes() -> tuple[Cause, ...]:
    """Return the rows of the table, in their order."""
    return tuple(read_rows(TABLE, Cause))


def explanation(cell: Verdict) -> tuple[str, str]:
    """Return cause and remedy of a cell that does not hold: the first known one that is about it, or a general one."""
    if cell.effect.startswith("CRASH"):
        return "a fault in the program", "report it"
    for cause in known_causes():
        if cause.explains(cell):
            return cause.cause, cause.remedy
    return _UNKNOWN[cell.outcome]
