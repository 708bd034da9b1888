"""Trains the initial tables of `mdct` on recordings: a refresh then starts from what textures have in common.

python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --image mine.vcmi                for a controller
python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --network --image mine.vcmi      with a network, in fewer bits
python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --built-in                       for firmware/core itself
"""

from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
from rich.progress import track

from vibrocast import extras
from vibrocast.codec import Framing, Signal
from vibrocast.codec.mdct import IDENTIFIER, MdctEncoder, untrained_tables
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.training_data import archive_recordings
from vibrocast.textures import TextureError

RATE_HZ = 2800
STEPS_PER_RECORDING = 3
FINEST_STEP, COARSEST_STEP = -2.5, 2.3
"""log2 of the quantiser step over the RMS value: about 25 dB down to 0 dB of SNR."""
EXCERPT_S = 1.5
PASSES = 2
STEP = 2.0**-9
"""Of every encoder that learns: an excerpt is scaled so that this step is the wanted one."""
_BUILT_IN_SOURCE = Path(__file__).parents[1] / "firmware" / "core" / "builtin_tables.c"


def excerpts(textures: list[Signal], seed: int, excerpt_s: float = EXCERPT_S) -> Iterator[Signal]:
    """Yield excerpts of the textures, (n, 1) each, in random order, scaled so that STEP is a random step."""
    generator = np.random.default_rng(seed)
    log_steps = generator.uniform(FINEST_STEP, COARSEST_STEP, (len(textures), STEPS_PER_RECORDING))
    jobs = [(texture, log_step) for texture, row in zip(textures, log_steps, strict=True) for log_step in row]
    for index in track(generator.permutation(len(jobs)), description="training"):
        texture, log_step = jobs[index]
        length = min(len(texture), int(excerpt_s * RATE_HZ))
        start = int(generator.integers(0, len(texture) - length + 1))
        excerpt = texture[start : start + length]
        rms = float(np.sqrt(np.mean(np.square(excerpt))))
        if rms > 0:
            yield excerpt * (STEP / (rms * 2**log_step))


def train(textures: list[Signal], seed: int, tables: bytes) -> bytes:
    """Return `tables` adapted to excerpts of the textures, (n, 1) each, coded in random order at random steps."""
    encoder = MdctEncoder((STEP,), RATE_HZ, Framing(RATE_HZ, 0), tables)
    for excerpt in excerpts(textures, seed):
        encoder.encode(excerpt)
    return encoder.adapted_tables()


def c_source(tables: bytes) -> str:
    """Return firmware/core/builtin_tables.c for the tables."""
    lines = [", ".join(map(str, tables[start : start + 20])) for start in range(0, len(tables), 20)]
    head = (
        "/* Initial tables of the context model; written by `python -m vibrocast.export.mdct_tables --built-in`. */\n"
    )
    return head + '#include "mdct.h"\n\nconst uint8_t vc_builtin_tables[] = {\n    ' + ",\n    ".join(lines) + "};\n"


@click.command()
@click.argument("archives", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--image", type=click.Path(dir_okay=False, path_type=Path), help="Model image to write.")
@click.option("--network", is_flag=True, help="Train a network too, for the image; takes minutes, and PyTorch.")
@click.option("--built-in", is_flag=True, help="Replace the tables built into firmware/core; reinstall afterwards.")
@click.option("--name", default="mdct", show_default=True, help="Name of the image.")
@click.option("--version", default="1", show_default=True, help="Version of the image.")
@click.option("--drop-s", default=1.0, show_default=True, help="Seconds to drop at each start.")
@click.option("--high-pass-hz", default=30.0, show_default=True, help="Corner of the high-pass.")
@click.option("--seed", default=1, show_default=True)
def main(
    archives: tuple[Path, ...],
    image: Path | None,
    network: bool,
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
        raise click.ClickException("the archives hold no recording that is long enough")
    tables = untrained_tables()
    for training_pass in range(PASSES):
        tables = train(textures, seed + training_pass, tables)
    if built_in:
        _BUILT_IN_SOURCE.write_text(c_source(tables))
    payload = _with_network(textures, seed + PASSES, tables) if network else tables
    if image is not None:
        image.write_bytes(ModelImage(IDENTIFIER, name, version, "", payload).pack())
    click.echo(f"{len(payload)} bytes of tables from {len(textures)} recordings")


def _with_network(textures: list[Signal], seed: int, tables: bytes) -> bytes:
    try:
        from vibrocast.export.mdct_network import trained
    except ModuleNotFoundError as error:
        raise click.ClickException(str(extras.explained(error) or error)) from error
    return trained(textures, seed, tables)


if __name__ == "__main__":
    main()
