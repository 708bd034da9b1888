"""Trains the initial tables of `mdct` on recordings: a refresh then starts from the statistics of textures.

python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --image mine.vcmi      for a controller
python -m vibrocast.export.mdct_tables RECORDINGS.npz ... --built-in             for firmware/src/core itself
"""

from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
from rich.progress import track

from vibrocast.codec import Framing, Signal
from vibrocast.codec.core import HOPS
from vibrocast.codec.mdct import IDENTIFIER, MdctEncoder
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
"""Step of every encoder that learns; an excerpt is scaled so that this is its step."""
UNTRAINED = -128
TABLES = np.dtype(
    [
        ("cells", "i1", (4, 2, 2, 256)),
        ("weights", "<i2", (4, 2, 48, 2)),
        ("silence", "u1", 16),
        ("centroids", "i1", (2, 3, 16)),
    ]
)
"""Initial tables; docs/reference/bitstream.md describes them. A cell that nothing was coded with is UNTRAINED."""
_BUILT_IN_SOURCE = Path(__file__).parents[1] / "firmware" / "src" / "core" / "vc_builtin_tables.c"


def untrained_tables() -> bytes:
    """Return initial tables without training: even odds, a weight of 0.6 for each context, silence at one in ten."""
    tables = np.zeros((), TABLES)
    tables["cells"], tables["weights"], tables["silence"] = UNTRAINED, 0.6 * 2**14, 26
    return tables.tobytes()


def excerpts(textures: list[Signal], seed: int) -> Iterator[Signal]:
    """Yield excerpts of the textures, (n, 1) each, in random order, scaled so that STEP is a random step."""
    generator = np.random.default_rng(seed)
    log_steps = generator.uniform(FINEST_STEP, COARSEST_STEP, (len(textures), STEPS_PER_RECORDING))
    jobs = [(texture, log_step) for texture, row in zip(textures, log_steps, strict=True) for log_step in row]
    for index in track(generator.permutation(len(jobs)), description="training"):
        texture, log_step = jobs[index]
        length = min(len(texture), int(EXCERPT_S * RATE_HZ))
        start = int(generator.integers(0, len(texture) - length + 1))
        excerpt = texture[start : start + length]
        rms = float(np.sqrt(np.mean(np.square(excerpt))))
        if rms > 0:
            yield excerpt * (STEP / (rms * 2**log_step))


def trained(textures: list[Signal], seed: int) -> bytes:
    """Return initial tables that are adapted to textures, (n, 1) each."""
    tables = untrained_tables()
    for number in range(PASSES):
        tables = _adapted(textures, seed + number, tables)
    return tables


def _adapted(textures: list[Signal], seed: int, tables: bytes) -> bytes:
    """Return the tables after excerpts of the textures are coded, one after another, each at a random hop.

    They are the mean of the states after each excerpt but the first third: a single state would be a noisy beginning.
    """
    generator = np.random.default_rng(seed)
    last: MdctEncoder | None = None
    states = []
    for excerpt in excerpts(textures, seed):
        hop = int(generator.choice(HOPS))
        encoder = MdctEncoder((STEP,), RATE_HZ, Framing(hop, 0), tables, hop=hop)
        encoder.follow(last)
        if encoder.encode(excerpt):
            last = encoder
            states.append(encoder.adapted_tables())
    return _mean(states[len(states) // 3 :]) if states else tables


def _mean(states: list[bytes]) -> bytes:
    each = np.frombuffer(b"".join(states), TABLES)
    trained = each["cells"] != UNTRAINED
    sums = np.sum(each["cells"], axis=0, where=trained, dtype=np.float64)
    mean = each[-1].copy()
    mean["cells"] = np.where(trained[-1], np.rint(sums / np.maximum(trained.sum(axis=0), 1)), UNTRAINED)
    for name in ("weights", "silence"):
        mean[name] = np.rint(np.mean(each[name], axis=0))
    return bytes(mean.tobytes())


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
