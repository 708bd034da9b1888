"""Entropy coding of extreme coefficients and of silence: bits spent on a sample, and its entropy."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.fft import idct

from vibrocast.codec.interface import Setting
from vibrocast.evaluation.stability.maps import (
    Group,
    Map,
    Place,
    RatePoint,
    Rule,
    Scope,
    figure,
    middle_rate_point,
    with_methods,
)
from vibrocast.evaluation.stability.signals import RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Trial, Verdict, graded

DCT = "dct"
SILENCE = "silence"
CODERS = ("huffman", "range")
BLOCK, BLOCKS = 512, 24  # three packets of 4096 samples, none of them padded
HELD_BITS, FAILED_BITS = 0.2, 1.5


def _shaped(values: Signal) -> Signal:
    return np.asarray(values, np.float64).reshape(BLOCKS, BLOCK)


def _sparse(part: float) -> Signal:
    """One value in 1 / `part` at its maximum, the others at its negative."""
    random = np.random.default_rng(0)
    return _shaped(np.where(random.random(BLOCKS * BLOCK) < part, 1, -1))


COEFFICIENTS: dict[str, tuple[Callable[[], Signal], int]] = {
    "all zero": (lambda: _shaped(np.zeros(BLOCKS * BLOCK)), 4),
    "all the same": (lambda: _shaped(np.ones(BLOCKS * BLOCK)), 4),
    "alternating extremes": (lambda: _shaped(np.tile([1, -1], BLOCKS * BLOCK // 2)), 4),
    "one in 500 differs": (partial(_sparse, 0.002), 4),
    "one in 50 differs": (partial(_sparse, 0.02), 4),
    "extremes at random": (partial(_sparse, 0.5), 4),
    "all of 65535 levels": (
        lambda: _shaped(np.random.default_rng(0).uniform(-1, 1, BLOCKS * BLOCK)),
        65_535,
    ),
}
"""Coefficients relative to the greatest, and the levels that they are quantised to."""


def needed_bits(coefficients: Signal, levels: int) -> float:
    """Return the entropy of order 0 in bits a value: of two values, or of all levels, equally likely."""
    if levels > 4:
        return math.log2(levels)
    _, counts = np.unique(coefficients, return_counts=True)
    shares = counts / counts.sum()
    return float(np.sum(shares * np.log2(1 / shares)))


def measure(coder: str, case: str) -> Measured:
    """Code a signal that has these DCT coefficients and grade the bits of the whole stream above the entropy.

    Raises CodecError.
    """
    make, levels = COEFFICIENTS[case]
    coefficients = make()
    samples = idct(coefficients, axis=1, norm="ortho").reshape(-1, 1) / math.sqrt(BLOCK)
    setting: Setting = {"levels": levels, "entropy": coder, "block": str(BLOCK), "dc": "keep"}
    _, stream = decoded(np.asarray(samples), RATE_HZ, RatePoint(DCT, setting))
    return judge(8 * stream.size_bytes / samples.size, needed_bits(coefficients, levels))


def measure_silence(rate_point: RatePoint) -> Measured:
    """Code silence, whose entropy is 0."""
    samples = np.zeros((BLOCKS * BLOCK, 1))
    _, stream = decoded(samples, RATE_HZ, rate_point)
    return judge(8 * stream.size_bytes / samples.size, 0.0)


def judge(bits: float, needed: float) -> Measured:
    """Return the outcome of a rate against the entropy, both in bits per sample."""
    figures = {"excess_bits": bits - needed, "bits_per_sample": bits, "entropy_bits": needed}
    effect = f"{bits:.2f} bits per sample where {needed:.2f} would do"
    return graded(bits - needed, HELD_BITS, FAILED_BITS, figures, effect)


def _trials(scope: Scope) -> list[Trial]:
    trials = []
    for method in scope.methods:
        rate_point = middle_rate_point(method)
        silence = partial(measure_silence, rate_point)
        trials.append(Trial(ENTROPY.name, method.name, SILENCE, f"middle: {rate_point.text}", None, silence))
    if scope.has(DCT):
        cases = list(COEFFICIENTS)[:: 3 if scope.quick else 1]
        trials += [
            Trial(ENTROPY.name, f"{DCT}, {coder}", case, "", None, partial(measure, coder, case))
            for case in cases
            for coder in CODERS
        ]
    return trials


def _message(cells: Sequence[Verdict]) -> str:
    silence = [cell for cell in cells if cell.case == SILENCE]
    return f"Silence costs less than {HELD_BITS:g} bits per sample {with_methods(silence)}"


ENTROPY = Map(
    name="entropy_coding",
    group=Group.SETTINGS,
    title="Entropy coding",
    tried=f"Every codec codes silence. `{DCT}` also codes coefficients that are all extreme or almost all alike.",
    rule=Rule("bits per sample above the entropy", f"up to {HELD_BITS:g}", f"more than {FAILED_BITS:g}"),
    trials=_trials,
    message=_message,
    place=lambda cell: Place(cell.method, cell.case),
    caption="bits per sample above the entropy",
    label=figure("excess_bits", ".1f"),
)
