"""All stability maps, measured and written with their page by one call."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from vibrocast.evaluation.stability import learned_signals, output, page, settings, signals, transport
from vibrocast.evaluation.stability.float_parity import PARITY
from vibrocast.evaluation.stability.maps import Scope
from vibrocast.evaluation.stability.model_images import IMAGES
from vibrocast.evaluation.stability.peers import PEERS
from vibrocast.evaluation.stability.trials import Verdict, run

MAPS = (*signals.MAPS, *settings.MAPS, *transport.MAPS, *output.MAPS, *learned_signals.MAPS, IMAGES, PARITY)


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
