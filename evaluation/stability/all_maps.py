"""All stability maps, measured and written with their page by one call."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from vibrocast.evaluation.stability import page
from vibrocast.evaluation.stability.actuators import RESONANCE, VOLTAGE
from vibrocast.evaluation.stability.entropy import ENTROPY
from vibrocast.evaluation.stability.filters import FILTERS
from vibrocast.evaluation.stability.float_parity import PARITY
from vibrocast.evaluation.stability.hand_speed import HAND_SPEED
from vibrocast.evaluation.stability.learned_signals import KINDS, LEVEL, QUIET
from vibrocast.evaluation.stability.maps import Scope
from vibrocast.evaluation.stability.model_images import IMAGES
from vibrocast.evaluation.stability.peers import PEERS
from vibrocast.evaluation.stability.rate_point_sets import DCT_LEVELS, DCT_SMALLEST, DCT_THRESHOLD, RATE_POINTS
from vibrocast.evaluation.stability.recordings import RECORDINGS
from vibrocast.evaluation.stability.signals import ONSETS, SIGNALS
from vibrocast.evaluation.stability.transport import DRIFT, FLIPS, LOSS, STALLS
from vibrocast.evaluation.stability.trials import Verdict, run

MAPS = (
    RECORDINGS,
    SIGNALS,
    ONSETS,
    RATE_POINTS,
    DCT_LEVELS,
    DCT_THRESHOLD,
    DCT_SMALLEST,
    FILTERS,
    ENTROPY,
    LOSS,
    FLIPS,
    DRIFT,
    STALLS,
    HAND_SPEED,
    RESONANCE,
    VOLTAGE,
    KINDS,
    QUIET,
    LEVEL,
    IMAGES,
    PARITY,
)


def make_maps(
    out: Path,
    scope: Scope,
    command: str,
    imported: Sequence[Verdict] = (),
    progress: Callable[[float, str], None] = lambda part, details: None,
    chosen: Collection[str] = (),
) -> tuple[list[Verdict], list[page.Failure]]:
    """Measure every map, write them and the page into the folder `out`; return cells and failures. Raises OSError.

    `command`: what was run, for the page. `imported`: cells that were measured elsewhere, which join the page.
    `progress` is called with the part that is done, from 0 to 1, and the last trial. `chosen`: names of maps, all
    if none.
    """
    maps = [each for each in MAPS if not chosen or each.name in chosen]
    tried = run([trial for each in maps for trial in each.trials(scope)], progress=progress)
    judged = [cell for each in maps for cell in each.judged([cell for cell in tried if cell.map == each.name])]
    cells = [*judged, *imported]
    return cells, page.write(out, [*maps, PEERS], cells, command)
