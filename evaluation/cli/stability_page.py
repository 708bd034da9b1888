"""Draws the stability page again, without measuring: `python -m vibrocast.evaluation.cli.stability_page OUT`."""

from pathlib import Path

import click

from vibrocast.errors import InputError
from vibrocast.evaluation.stability import page
from vibrocast.evaluation.stability.all_maps import MAPS
from vibrocast.evaluation.stability.peers import PEERS


@click.command()
@click.argument("out", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(out: Path) -> None:
    """Draw the page OUT/stability.md and its pictures again, from the CSV files in OUT/stability."""
    try:
        page.redraw(out, [*MAPS, PEERS])
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}; give the --out of a stability run") from error
    except InputError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
