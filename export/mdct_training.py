"""Trains the initial tables of `mdct`: codes excerpts of textures at random steps, one after another."""

from collections.abc import Iterator

import numpy as np
from rich.progress import track

from vibrocast.codec import Framing, Signal
from vibrocast.codec.mdct import MdctEncoder

RATE_HZ = 2800
STEPS_PER_RECORDING = 3
FINEST_STEP, COARSEST_STEP = -2.5, 2.3
"""log2 of the quantiser step over the RMS value: about 25 dB down to 0 dB of SNR."""
EXCERPT_S = 1.5
PASSES = 2
STEP = 2.0**-9
"""Step of every encoder that learns; an excerpt is scaled so that this is its step."""


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
