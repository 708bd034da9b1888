"""Why methods fail and what to do about it: fixed sentences, by map, method and case, in known_causes.csv."""

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

from vibrocast.evaluation.points import read_rows
from vibrocast.evaluation.stability.trials import Outcome

TABLE = Path(__file__).parent / "known_causes.csv"


@dataclass(frozen=True)
class Explanation:
    """A failure in plain words, why it happens, and what to do about it. The page lists failures that have words.

    `map`, `method`, `case`: of the cells that it explains, patterns as of file names. `outcomes`: letters of Outcome.
    """

    failure: str = ""
    cause: str = ""
    remedy: str = ""
    map: str = ""
    method: str = ""
    case: str = ""
    outcomes: str = ""


CRASH = Explanation("The program crashes", "a fault in the program", "Report it")
_LOST = Explanation("Quality is lost", "", "Use a finer setting or another codec")
_UNKNOWN = {Outcome.REJECTED: Explanation("Rejected", "", "Do as the error says"), Outcome.HOLDS: Explanation()}


@cache
def known_causes() -> tuple[Explanation, ...]:
    """Return the rows of the table, in their order: of several that are about a cell, the first counts."""
    return tuple(read_rows(TABLE, Explanation))


def explanation(map_name: str, method: str, case: str, outcome: str, effect: str) -> Explanation:
    """Return what is known of a cell's outcome, a general explanation otherwise, and an empty one where it holds."""
    if effect.startswith("CRASH"):
        return CRASH
    for known in known_causes():
        pairs = ((map_name, known.map), (method, known.method), (case, known.case))
        if Outcome(outcome).letter in known.outcomes and all(fnmatchcase(*pair) for pair in pairs):
            return known
    return _UNKNOWN.get(Outcome(outcome), _LOST)
