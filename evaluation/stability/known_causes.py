"""Why methods fail and what to do about it: fixed sentences, by map, method and case."""

from dataclasses import dataclass
from fnmatch import fnmatchcase

from evaluation.stability.trials import Cell, Outcome


@dataclass(frozen=True)
class Cause:
    """Why cells of a map that match the patterns (as of file names) have these outcomes, and the remedy."""

    map: str
    method: str
    case: str
    outcomes: tuple[Outcome, ...]
    cause: str
    remedy: str

    def explains(self, cell: Cell) -> bool:
        """Return whether this is about a cell."""
        pairs = ((cell.map, self.map), (cell.method, self.method), (cell.case, self.case))
        return cell.outcome in self.outcomes and all(fnmatchcase(text, pattern) for text, pattern in pairs)


_BAD = (Outcome.DEGRADED, Outcome.FAILS)
_REFUSED = (Outcome.REFUSED,)

CAUSES = (
    Cause(
        "signals",
        "*",
        "a NaN",
        _REFUSED,
        "what is no number cannot be coded",
        "repair the recording, as the error says",
    ),
    Cause("signals", "*", "an infinity", _REFUSED, "what is no number cannot be coded", "repair the recording"),
    Cause("signals", "*", "no sample", _REFUSED, "there is nothing to code", "check the recording"),
    Cause("signals", "*", "17 channels", _REFUSED, "a stream has at most 16 channels", "make two streams of it"),
    Cause("signals", "*", "peak of 1e-40", _REFUSED, "the gain has the range of single precision", "use another unit"),
    Cause(
        "signals",
        "*",
        "white noise*",
        _BAD,
        "noise without shape has nothing to predict: every decibel costs its bits",
        "a finer setting, or a noise generator at the controller",
    ),
    Cause(
        "signals",
        "*",
        "texture 60 dB below a click",
        _BAD,
        "full scale is the recording's peak and the step follows its power, both of which the click sets",
        "cut the click out, or code in parts",
    ),
    Cause(
        "signals",
        "*",
        "* sample*",
        _BAD,
        "a signal shorter than a block spreads over all coefficients",
        "a finer setting; the few bytes hardly count",
    ),
    Cause(
        "signals",
        "*",
        "square*",
        _BAD,
        "edges have a spectrum as broad as noise",
        "a finer setting",
    ),
    Cause(
        "pre_echo",
        "*",
        "*",
        _BAD,
        "quantisation noise spreads over the whole block in which the onset lies",
        "a finer setting or a shorter block",
    ),
    Cause(
        "ladders",
        "*",
        "*",
        (Outcome.DEGRADED,),
        "the grid of the finer quantiser happens to lie worse for the strongest values",
        "try the neighbouring rungs; a search for an SNR does",
    ),
    Cause(
        "loss",
        "*",
        "*",
        _BAD,
        "what is lost is faded out, and silent until the next refresh, at most a quarter of a second later",
        "a better line, or refreshes more often",
    ),
    Cause(
        "bit_flips",
        "*",
        "*",
        _BAD,
        "a damaged frame fails its CRC and is dropped, so it is a lost one",
        "a better line: a shorter cable, a lower rate of symbols",
    ),
    Cause(
        "drift",
        "*",
        "*",
        _BAD,
        "the clocks run apart by more than credit can follow",
        "repair the controller's clock",
    ),
    Cause(
        "buffer",
        "*",
        "*",
        _BAD,
        "a stall that is longer than what is buffered empties the buffer",
        "a buffer longer than the longest stall; all of it is delay",
    ),
    Cause(
        "hand_speed",
        "*",
        "*",
        _BAD,
        "what was left out for one speed is in the band at another",
        "code for the slowest speed, or anew for each",
    ),
    Cause(
        "resonance",
        "*",
        "*",
        _BAD,
        "the compensation's dip stays where the resonance was",
        "measure the resonance and set it, or take an actuator of lower Q",
    ),
    Cause(
        "voltage_limit",
        "*, compensated",
        "*",
        _BAD,
        "the inverse filter asks for more than the voltage, the slew rate or the power that there is",
        "a smaller amplitude at high frequencies, by the gain of the stream",
    ),
    Cause(
        "voltage_limit",
        "*, as it is",
        "*",
        _BAD,
        "the actuator follows less the higher the frequency",
        "turn the compensation on",
    ),
)

_UNKNOWN = {
    Outcome.REFUSED: ("the method does not take this", "as the error says"),
    Outcome.DEGRADED: ("the method is made for other signals or conditions", "a finer setting, or another method"),
    Outcome.FAILS: ("the method does not bear this", "use another method"),
    Outcome.NOT_TRIED: ("it would have taken too long", "cut the recording into parts"),
}


def explanation(cell: Cell) -> tuple[str, str]:
    """Return cause and remedy of a cell that does not hold: the first of CAUSES that is about it, or a general one."""
    for cause in CAUSES:
        if cause.explains(cell):
            return cause.cause, cause.remedy
    if cell.effect.startswith(("CRASH", "HANGS")):
        return "a fault in the program", "report it"
    return _UNKNOWN[cell.outcome]
