"""Trains the initial tables of `mdct`: codes excerpts of textures at random steps, one after another."""

from collections.abc import Iterator

import numpy as np
from rich.progress import track

from vibrocast.codec import Framing, Signal
from vibrocast.codec.mdct import HOPS, MDCT, TABLES, UNTRAINED, MdctEncoder, Transform, untrained_tables

RATE_HZ = 2800
STEPS_PER_RECORDING = 3
FINEST_STEP, COARSEST_STEP = -2.5, 2.3
"""log2 of the quantiser step over the RMS value: about 25 dB down to 0 dB of SNR."""
EXCERPT_S = 1.5
PASSES = 2
STEP = 2.0**-9
"""Step of every encoder that learns; an excerpt is scaled so that this is its step."""


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


def trained(textures: list[Signal], seed: int, transform: Transform = MDCT, tables: bytes | None = None) -> bytes:
    """Return initial tables that are adapted to textures, (n, 1) each.

    `tables`: to begin with; None = untrained.
    """
    tables = untrained_tables() if tables is None else tables
    for number in range(PASSES):
        tables = _adapted(textures, seed + number, transform, tables)
    return tables


def _adapted(textures: list[Signal], seed: int, transform: Transform, tables: bytes) -> bytes:
    """Return the tables after excerpts of the textures are coded, one after another, each at a random hop.

    They are the mean of the states after each excerpt but the first third: a single state would be a noisy beginning.
    """
    generator = np.random.default_rng(seed)
    last: MdctEncoder | None = None
    states = []
    for excerpt in excerpts(textures, seed):
        hop = int(generator.choice(HOPS))
        encoder = MdctEncoder((STEP,), RATE_HZ, Framing(hop, 0), tables, hop=hop, transform=transform)
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
