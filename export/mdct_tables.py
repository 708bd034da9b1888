"""Trains the initial tables of `mdct` on recordings: a refresh then starts from the statistics of textures.

python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --image mine.vcmi      for a controller
python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --built-in             for firmware/src/core itself
"""

from pathlib import Path

import click

from vibrocast.codec.mdct import IDENTIFIER
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.mdct_training import RATE_HZ, trained
from vibrocast.export.training_data import archive_recordings
from vibrocast.textures import TextureError

_BUILT_IN_SOURCE = Path(__file__).parents[1] / "firmware" / "src" / "core" / "vc_builtin_tables.c"


def c_source(tables: bytes) -> str:
    """Return firmware/src/core/vc_builtin_tables.c for the tables."""
    lines = [", ".join(map(str, tables[start : start + 20])) for start in range(0, len(tables), 20)]
    head = (
        "/* Initial tables of the context model; written by `python -m vibrocast.export.mdct_tables --built-in`. */\n"
    )
    return (
        head
        + '#include "vc_mdct_state.h"\n\nconst uint8_t vc_builtin_tables[] = {\n    '
        + ",\n    ".join(lines)
        + "};\n"
    )


@click.command()
@click.argument("archives", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--image", type=click.Path(dir_okay=False, path_type=Path), help="Write a model image.")
@click.option("--built-in", is_flag=True, help="Replace the tables built into firmware/src/core; reinstall afterwards.")
@click.option("--name", default="mdct", show_default=True, help="Name the image.")
@click.option("--version", default="1", show_default=True, help="State the version of the image.")
@click.option("--drop-s", default=1.0, show_default=True, help="Drop this many seconds at each start.")
@click.option("--high-pass-hz", default=30.0, show_default=True, help="Set the corner of the high-pass, in Hz.")
@click.option("--seed", default=1, show_default=True, help="Seed the training.")
def main(
    archives: tuple[Path, ...],
    image: Path | None,
    built_in: bool,
    name: str,
    version: str,
    drop_s: float,
    high_pass_hz: float,
    seed: int,
) -> None:
    """Train the initial tables of `mdct` on NPZ archives of recordings."""
    try:
        textures = [
            samples[:, None]
            for archive in archives
            for _, samples in archive_recordings(archive, drop_s, high_pass_hz, RATE_HZ)
        ]
    except TextureError as error:
        raise click.ClickException(str(error)) from error
    if not textures:
        raise click.ClickException(
            "the archives hold no recording that is long enough; add longer ones, or lower --drop-s"
        )
    tables = trained(textures, seed)
    if built_in:
        _BUILT_IN_SOURCE.write_text(c_source(tables))
    if image is not None:
        image.write_bytes(ModelImage(IDENTIFIER, name, version, "", tables).pack())
    click.echo(f"{len(tables)} bytes of tables from {len(textures)} recordings")


if __name__ == "__main__":
    main()
