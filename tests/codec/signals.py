"""Signals for the codec's tests: textures made here, and inputs on which codecs are known to fail."""

import numpy as np

from vibrocast.codec import Signal

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
