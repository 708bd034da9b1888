"""All stability maps, measured and written with their page by one call."""

from collections.abc import Callable, Collection
from itertools import islice
from pathlib import Path

from vibrocast.evaluation.stability import learned_signals, output, page, settings, signals, transport
from vibrocast.evaluation.stability.float_parity import PARITY
from vibrocast.evaluation.stability.maps import Cells, Scope, table
from vibrocast.evaluation.stability.model_images import IMAGES
from vibrocast.evaluation.stability.peers import PEERS
from vibrocast.evaluation.stability.trials import run

MAPS = (*signals.MAPS, *settings.MAPS, *transport.MAPS, *output.MAPS, *learned_signals.MAPS, IMAGES, PARITY)


def make_maps(
    out: Path,
    scope: Scope,
    command: str,
    imported: Cells | None = None,
    progress: Callable[[float, str], None] = lambda part, details: None,
    chosen: Collection[str] = (),
) -> tuple[page.Results, list[page.Failure]]:
    """Measure every map, write them and the page into the folder `out`; return cells and failures. Raises OSError.

    `command`: what was run, for the page. `imported`: cells that were measured elsewhere, which join the page.
    `progress` is called with the part that is done, from 0 to 1, and the last trial. `chosen`: names of maps, all
    if none.
    """
    trials = {each: each.trials(scope) for each in MAPS if not chosen or each.name in chosen}
    measured = iter(run([trial for own in trials.values() for trial in own], progress=progress))
    results = {each: each.judged(table(own, list(islice(measured, len(own))))) for each, own in trials.items()}
    if imported is not None:
        results[PEERS] = imported
    return results, page.write(out, results, command)
