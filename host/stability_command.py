"""The subcommand `stability`: maps of where each codec and trained model holds and where it fails."""

from collections import Counter
from pathlib import Path

import click

from vibrocast.codec import CodecError
from vibrocast.device_protocol.model_image import ModelImageError
from vibrocast.host import progress
from vibrocast.host.options import INPUT, BadInput, command_run
from vibrocast.models import ModelError


@click.command()
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder of the page.")
@click.option("--codecs", "names", metavar="NAME,...", help="Codecs, or families of models, to try; all if not given.")
@click.option(
    "--models",
    "model_folders",
    type=INPUT,
    multiple=True,
    help="Folder of a model of your own, as `vibrocast export` writes it, beside those that ship; may be repeated.",
)
@click.option("--peers-edge", type=INPUT, help="CSV of what other codecs do with hard signals, joined to the page.")
@click.option("--quick", is_flag=True, help="Try a few conditions only.")
def stability(
    out: Path, names: str | None, model_folders: tuple[Path, ...], peers_edge: Path | None, quick: bool
) -> None:
    """Map where each codec holds and where it fails.

    Writes stability.md, and pictures with their data in stability/. The maps cover signals, settings, transport, speed
    of the hand, actuator and trained models. A failure is a result: the maps show it.
    """
    from vibrocast.evaluation import trained
    from vibrocast.evaluation.cells import BenchError
    from vibrocast.evaluation.stability import page, report
    from vibrocast.evaluation.stability.maps import Scope, methods
    from vibrocast.evaluation.stability.peers import PeersError, read_peers

    try:
        chosen = methods(None if names is None else names.split(","), trained.known_models(model_folders))
        peers = read_peers(peers_edge) if peers_edge else []
        page.folder_in(out)  # what cannot be written is better known before than after
    except (BenchError, CodecError, ModelError, ModelImageError, PeersError, page.PageError) as error:
        raise BadInput(str(error)) from error
    with progress.shown("trying") as update:
        cells = report.make(out, Scope(chosen, quick), command_run(), peers, update)
    outcomes = Counter(cell.outcome for cell in cells)
    counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
    click.echo(f"{out / page.PAGE}: {len(cells)} trials, {counts}")
