"""Settings of codecs: quality along their rate points, parameters of DCT, bits of entropy coding."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import polars as pl
from scipy.fft import idct

from vibrocast.codec.interface import Setting
from vibrocast.evaluation.cells import RatePoint, methods
from vibrocast.evaluation.stability import maps
from vibrocast.evaluation.stability.filters import FILTERS
from vibrocast.evaluation.stability.maps import Cells, Map, Row, Scope
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
from vibrocast.textures import Recording
from vibrocast.textures.generate import rough, stick_slip, wood, wood_surface

SECONDS = 1.0
HAND_SPEED_MM_S = 50.0
FALL_DB = 0.1
"""A fall of the SNR from one rate point to the next that counts."""
HALF_DB = 3.0

SURFACES: dict[str, Callable[..., Recording]] = {"wood": wood_surface, "sandpaper": rough, "leather": stick_slip}
TEXTURES = (*SURFACES, "acceleration")


def texture_of(name: str) -> tuple[Signal, str]:
    """Return a texture by its name, with its unit: heights without their mean, or the acceleration of a stylus."""
    if name == "acceleration":
        return wood(0, SECONDS, HAND_SPEED_MM_S, RATE_HZ).samples, "m/s^2"
    samples = SURFACES[name](0, SECONDS, HAND_SPEED_MM_S, RATE_HZ).samples
    return np.asarray(samples - samples.mean()), "um"


def measure_texture(trial: Trial) -> Measured:
    """Code a texture at a setting: SNR, ST-SIM, bits per sample of the whole stream. Raises CodecError."""
    from vibrocast.codec import metrics

    samples, unit = texture_of(trial.case)
    heard, stream = decoded(samples, RATE_HZ, trial.rate_point, unit)
    quality = metrics.measure(samples, heard, RATE_HZ)
    snr_db = quality.snr_db
    assert snr_db is not None, "a texture is not silent"
    bits = 8 * stream.size_bytes / samples.size
    figures = {"snr_db": snr_db, "st_sim_2800": quality.st_sim_2800, "bits_per_sample": bits}
    outcome = Outcome.HOLDS if snr_db >= FAILED_SNR_DB else Outcome.FAILS
    return Measured(outcome, figures, "" if outcome is Outcome.HOLDS else f"SNR {snr_db:z.1f} dB")


def _degraded(cells: Cells, best_db: pl.Expr, less_db: float = 0.0, effect: str = "") -> Cells:
    """Return cells, those that hold degraded where their SNR is lower than a best one by more than `less_db`.

    `effect`: what follows the SNR in words, of `{best_db}` and `{less_db}`.
    """
    judged = cells.with_columns(best_db=best_db.over("method", "case")).with_columns(
        less_db=pl.col("best_db") - pl.col("snr_db"), low=pl.col("outcome") == Outcome.HOLDS
    )
    judged = judged.with_columns(pl.col("low") & (pl.col("snr_db") < pl.col("best_db") - less_db))
    effects = [
        f"SNR {row['snr_db']:z.1f} dB{effect.format_map(row)}" if row["low"] else row["effect"]
        for row in judged.iter_rows(named=True)
    ]
    outcome = pl.when("low").then(pl.lit(Outcome.DEGRADED.value)).otherwise("outcome")
    return cells.with_columns(judged.select(outcome=outcome, effect=pl.Series(effects, dtype=pl.String)))


def falls(cells: Cells) -> Cells:
    """Return the cells, those degraded whose SNR is lower than that of a coarser rate point of the same curve."""
    best_db = pl.col("snr_db").cum_max().forward_fill().shift(fill_value=-math.inf)
    return _degraded(cells, best_db, FALL_DB, ", {less_db:.1f} dB less than at a coarser setting")


def near_best(cells: Cells) -> Cells:
    """Return the cells, those degraded whose SNR is more than HALF_DB below the best of the same curve."""
    return _degraded(cells, pl.col("snr_db").max(), HALF_DB, ", {best_db:.1f} dB at the best")


def half_left(cells: Cells) -> Cells:
    """Return the cells, those degraded in which less than half of the power is left."""
    return _degraded(cells, pl.lit(HALF_DB))


def _swept(method: str, points: Iterable[tuple[float, RatePoint]]) -> Iterator[Trial]:
    for value, rate_point in points:
        yield Trial(method, setting=rate_point.text, value=value, rate_points=(rate_point,))


def _rate_points(scope: Scope) -> Iterator[Trial]:
    for method in scope.methods:
        for each in [method] if method.models else methods([method.name]):
            points = each.rate_points
            if len(points) > 1:
                yield from _swept(each.name, scope.some(list(enumerate(points, 1)), len(points) // 2))


def _of_dct(
    parameter: str, values: Sequence[float], methods: Mapping[str, Setting]
) -> Callable[[Scope], Iterator[Trial]]:
    """Return the beginnings of trials with values of one parameter of DCT; each method fixes the other parameters."""

    def beginnings(scope: Scope) -> Iterator[Trial]:
        for method, fixed in methods.items() if scope.has(DCT) else ():
            points = [(value, RatePoint(DCT, {**fixed, parameter: value})) for value in values]
            yield from _swept(method, scope.some(points, len(points) // 2))

    return beginnings


DCT = "dct"
LEVELS = (4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 16, 18, 20, 22, 24, 26, 28, 32, 36, 40, 48, 56, 64)
B0_DB = (24, 20, 16, 12, 10, 8, 6, 4, 2, 0, -2, -4, -6, -8, -10, -12, -16, -20, -24)
SMALLEST = (3.0, 2.0, 1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002)
S_LEVELS = (8, 14, 28)
FINEST_LEVELS = 65_535

_quantised = _of_dct("levels", LEVELS, {f"dct, {each}": {"quantiser": each} for each in ("linear", "log")})
_cut = _of_dct("b0_db", B0_DB, {"dct, cut": {"levels": FINEST_LEVELS, "threshold": "on"}})
_logarithmic = _of_dct(
    "smallest", SMALLEST, {f"dct, log, {levels} levels": {"quantiser": "log", "levels": levels} for levels in S_LEVELS}
)
RATE_POINTS, DCT_LEVELS, DCT_THRESHOLD, DCT_SMALLEST = (
    Map(name, globals(), [Row(measure_texture, beginnings, TEXTURES, case_step=len(TEXTURES))], judged)
    for name, beginnings, judged in (
        ("rate_points", _rate_points, falls),
        ("dct_levels", _quantised, falls),
        ("dct_threshold", _cut, half_left),
        ("dct_smallest", _logarithmic, near_best),
    )
)

SILENCE = "silence"
CODERS = {"dct, huffman": "huffman", "dct, range": "range"}
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
        FINEST_LEVELS,
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


def measure_coefficients(trial: Trial) -> Measured:
    """Code a signal that has these DCT coefficients and grade the bits of the whole stream above the entropy.

    Raises CodecError.
    """
    make, levels = COEFFICIENTS[trial.case]
    coefficients = make()
    samples = np.asarray(idct(coefficients, axis=1, norm="ortho").reshape(-1, 1) / math.sqrt(BLOCK))
    setting: Setting = {"levels": levels, "entropy": CODERS[trial.method], "block": str(BLOCK), "dc": "keep"}
    return _rated(RatePoint(DCT, setting), samples, needed_bits(coefficients, levels))


def measure_silence(trial: Trial) -> Measured:
    """Code silence, whose entropy is 0."""
    return _rated(trial.rate_point, np.zeros((BLOCKS * BLOCK, 1)), 0.0)


def _rated(rate_point: RatePoint, samples: Signal, needed: float) -> Measured:
    _, stream = decoded(samples, RATE_HZ, rate_point)
    return judge_rate(8 * stream.size_bytes / samples.size, needed)


def judge_rate(bits: float, needed: float) -> Measured:
    """Return the outcome of a rate against the entropy, both in bits per sample."""
    figures = {"excess_bits": bits - needed, "bits_per_sample": bits, "entropy_bits": needed}
    effect = f"{bits:.2f} bits per sample where {needed:.2f} would do"
    return graded(bits - needed, HELD_BITS, FAILED_BITS, figures, effect)


ENTROPY = Map(
    "entropy_coding",
    globals(),
    [
        Row(measure_silence, maps.at_middle, [SILENCE]),
        Row(
            measure_coefficients,
            lambda scope: map(Trial, CODERS if scope.has(DCT) else ()),
            tuple(COEFFICIENTS),
            case_step=3,
        ),
    ],
)
MAPS = (RATE_POINTS, DCT_LEVELS, DCT_THRESHOLD, DCT_SMALLEST, FILTERS, ENTROPY)
