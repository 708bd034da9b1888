"""The subcommand `stability`: maps of where each codec and trained model holds and where it fails."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import click

from vibrocast import progress
from vibrocast.errors import InputError
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.options import command_run, own_models_option
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.textures import Recording, TextureError, dataset

MAX_FAILURES = 5
"""That the command prints; the page has all."""
OUTCOMES = {"rejected": "rejected", "degraded": "degraded", "fails": "failed"}


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast stability --quick --out maps\n"
    "vibrocast stability --codecs mdct --recordings recordings --out maps",
)
@click.option("--codecs", "names", metavar="NAME,...", help="Codecs or families of models. Default: all.")
@own_models_option
@section(
    MORE,
    click.option(
        "--peers-edge", type=INPUT, metavar="FILE", help="CSV file of other codecs' results with hard signals."
    ),
)
@click.option("--recordings", type=INPUT, metavar="FOLDER|MANIFEST", help="Recordings of your own. Default: none.")
@click.option("--maps", "map_names", metavar="NAME,...", help="Maps, such as recordings. Default: all.")
@click.option("--quick", is_flag=True, help="Test a few conditions only.")
@click.option("--out", type=FOLDER, required=True, help="Folder for the page and its data.")
def stability(
    out: Path,
    names: str | None,
    model_folders: tuple[Path, ...],
    peers_edge: Path | None,
    recordings: Path | None,
    map_names: str | None,
    quick: bool,
) -> None:
    """Map where each codec holds and where it fails.

    Writes stability.md, and pictures with their data in stability/. The maps cover your recordings, signals, settings,
    transport, speed of the hand, actuator and trained models. A failure is a result: the maps show it.
    """
    from vibrocast.evaluation import trained
    from vibrocast.evaluation.stability import page
    from vibrocast.evaluation.stability.all_maps import MAPS, make_maps
    from vibrocast.evaluation.stability.maps import Scope, methods
    from vibrocast.evaluation.stability.peers import read_peers

    chosen = methods(None if names is None else names.split(","), trained.known_models(model_folders))
    peers = read_peers(peers_edge) if peers_edge else None
    chosen_maps = [] if map_names is None else map_names.split(",")
    if unknown := set(chosen_maps) - {each.name for each in MAPS}:
        raise InputError(f"no map {min(unknown)!r}; choose from {', '.join(each.name for each in MAPS)}")
    if "recordings" in chosen_maps and recordings is None:
        raise InputError("the map of recordings needs them; give a folder or manifest: --recordings")
    own = load_all(recordings) if recordings else ()
    page.folder_in(out)  # so that a folder that cannot be written is an error before the measurement
    with progress.bar("testing") as update:
        results, failures = make_maps(out, Scope(chosen, quick, own), command_run(), peers, update, chosen_maps)
    outcomes = Counter(
        "as required" if outcome == required else OUTCOMES[outcome]
        for cells in results.values()
        for outcome, required in cells.select("outcome", "required").iter_rows()
    )
    counts = ", ".join(f"{outcomes[name]} {name}" for name in ("as required", *OUTCOMES.values()) if outcomes[name])
    for each in failures[:MAX_FAILURES]:
        tell(f"{each.failure}: {each.methods} ({each.boundary})\n  remedy: {each.remedy}")
    if len(failures) > MAX_FAILURES:
        tell(f"{len(failures) - MAX_FAILURES} more failures are on the page")
    tell(f"{outcomes.total()} conditions: {counts}", conditions=outcomes.total(), outcomes=dict(outcomes))
    named = [{**vars(each), "map": each.map.name} for each in failures]
    tell(f"page: {out / page.PAGE}", page=str(out / page.PAGE), failures=named)


def load_all(recordings: Path) -> tuple[Recording, ...]:
    """Return the recordings of a folder or manifest that load; the others, and what is skipped, are listed on stderr.

    Raises InputError where none loads.
    """
    found = dataset.read(recordings)
    for remark in found.remarks:
        click.echo(remark, err=True)
    loaded = []
    for entry in found.entries:
        try:
            loaded.append(replace(dataset.load(entry), name=entry.name))
        except TextureError as error:
            click.echo(f"left out: {entry.name}: {error}", err=True)
    if not loaded:
        raise InputError(f"{recordings}: no recording of it can be loaded; correct them as listed")
    return tuple(loaded)
