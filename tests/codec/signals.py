"""Parts of the codecs' tests: textures made here, inputs on which codecs are known to fail, steps in turn."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from vibrocast.codec import Choice, Decoded, Decoder, RateControl, Signal

RATE_HZ = 2800


def texture(samples: int, channels: int = 1, seed: int = 1) -> Signal:
    """Coloured noise whose level wanders, with a weak tone: (samples, channels), peak 0.8."""
    generator = np.random.default_rng(seed)
    white = generator.standard_normal((samples + 200, channels))
    coloured = np.cumsum(white - 0.9 * np.roll(white, 1, axis=0), axis=0)
    coloured -= np.convolve(coloured[:, 0], np.ones(64) / 64, "same")[:, None]
    time = np.arange(samples)[:, None]
    level = 1.2 + np.sin(2 * np.pi * time / 700 + np.arange(channels)[None, :])
    signal = coloured[200:] * level + 2 * np.sin(2 * np.pi * 210 * time / RATE_HZ)
    return np.asarray(0.8 * signal / max(1e-9, float(np.max(np.abs(signal)))), dtype=np.float64)


def edge_signals() -> dict[str, Signal]:
    """Inputs of measured failures of other codecs: silence, DC, impulses, squares, sweeps, short and odd lengths."""
    time = np.arange(2800)
    impulses = np.zeros(2800)
    impulses[[0, 777, 2799]] = (1.0, -1.0, 1.0)
    signals = {
        "silence": np.zeros(2800),
        "dc": np.full(2800, 0.5),
        "negative full-scale dc": np.full(2800, -1.0),
        "impulses": impulses,
        "full-scale square": np.sign(np.sin(2 * np.pi * 50 * time / RATE_HZ) + 1e-9),
        "square of one sample": np.where(time % 2, 1.0, -1.0),
        "sweep": np.sin(2 * np.pi * (5 + 1390 * time / 5600) * time / RATE_HZ),
        "clipped": np.clip(4 * texture(2800)[:, 0], -1, 1),
        "onset": np.concatenate([np.zeros(1400), texture(1400)[:, 0]]),
        "four-bit": np.round(8 * texture(2800)[:, 0]) / 8,
    }
    signals |= {f"{length} samples": texture(length + 64)[64:, 0] for length in (1, 2, 10, 31, 32, 33, 511, 513)}
    return {name: np.asarray(signal, dtype=np.float64)[:, None] for name, signal in signals.items()}


def golden_signal(samples: int = 400) -> Signal:
    """Made of integers only, so that every machine has the same: (samples, 2)."""
    state, values = 1, []
    for _ in range(2 * samples):
        state = (state * 1103515245 + 12345) % 2**31
        values.append((state >> 16) % 256 - 128)
    return np.array(values, dtype=np.float64).reshape(samples, 2).cumsum(axis=0) / 8192


def in_turn(quantiser_offsets: Sequence[int]) -> RateControl:
    """Choose these quantiser offsets, one after the other and over again, or the nearest that there are."""
    turn = itertools.cycle(quantiser_offsets)
    return lambda trial: Choice(min(max(next(turn), trial.quantiser_offsets[0]), trial.quantiser_offsets[-1]))


def played(decoder: Decoder, packets: Iterable[bytes]) -> Decoded:
    """Return the samples of packets, one after another."""
    return np.concatenate([decoder.decode(packet) for packet in packets])


class Reference(Protocol):
    """A decoder that is written from the documentation."""

    def samples(self, packet: bytes) -> Signal:
        """Return the exact samples of a packet, 32768 = full scale."""


def difference(reference: Reference, packets: Sequence[bytes], samples: Decoded) -> float:
    """Return by how much decoded samples of packets differ most from the documented ones, in the last bit."""
    exact = np.concatenate([reference.samples(packet) for packet in packets])
    return float(np.max(np.abs(np.clip(exact, -32768, 32767) - samples)))
