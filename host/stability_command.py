"""The subcommand `stability`: maps of where each codec holds and where it fails."""

from collections import Counter
from pathlib import Path

import click

import codec
from host import progress
from host.options import INPUT, BadInput, command_run


def chosen_codecs(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Return the names in a list with commas, all codecs' without one, or raise click.BadParameter."""
    names = tuple(codec.CODECS) if value is None else tuple(filter(None, value.split(",")))
    unknown = [name for name in names if name not in codec.CODECS]
    if unknown or not names:
        raise click.BadParameter(f"{value!r} is no list of codecs; choose from {', '.join(codec.CODECS)}", ctx, param)
    return names


@click.command()
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder of the page.")
@click.option("--codecs", callback=chosen_codecs, metavar="NAME,...", help="Codecs to try; all if not given.")
@click.option("--peers-edge", type=INPUT, help="CSV of what other codecs do with hard signals, joined to the page.")
@click.option("--quick", is_flag=True, help="Try a few conditions only.")
def stability(out: Path, codecs: tuple[str, ...], peers_edge: Path | None, quick: bool) -> None:
    """Map where each codec holds and where it fails: stability.md, and pictures with their data in stability/.

    Signals, settings, transport, speed of the hand and actuator. What fails is a result: the maps show it.
    """
    from evaluation.stability import page, report
    from evaluation.stability.maps import Scope
    from evaluation.stability.peers import PeersError, read_peers

    try:
        peers = read_peers(peers_edge) if peers_edge else []
        page.folder_in(out)  # what cannot be written is better known before than after
    except (PeersError, page.PageError) as error:
        raise BadInput(str(error)) from error
    with progress.shown("trying") as update:
        cells = report.make(out, Scope(codecs, quick), command_run(), peers, update)
    outcomes = Counter(cell.outcome for cell in cells)
    counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
    click.echo(f"{out / page.PAGE}: {len(cells)} trials, {counts}")
