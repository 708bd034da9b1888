"""Settings of codecs: quality along their rate points, parameters of DCT, bits of entropy coding."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.fft import idct

from vibrocast import codec
from vibrocast.codec.interface import Setting
from vibrocast.evaluation.stability import maps
from vibrocast.evaluation.stability.filters import FILTERS
from vibrocast.evaluation.stability.maps import Group, Map, Place, RatePoint, Rule, Scope, figure, with_methods
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict, graded
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


def measure_texture(rate_point: RatePoint, name: str) -> Measured:
    """Code a texture at a setting: SNR, ST-SIM, bits per sample of the whole stream. Raises CodecError."""
    from vibrocast.codec import metrics

    samples, unit = texture_of(name)
    heard, stream = decoded(samples, RATE_HZ, rate_point, unit)
    quality = metrics.measure(samples, heard, RATE_HZ)
    snr_db = quality.snr_db
    assert snr_db is not None, "a texture is not silent"
    bits = 8 * stream.size_bytes / samples.size
    figures = {"snr_db": snr_db, "st_sim_2800": quality.st_sim_2800, "bits_per_sample": bits}
    outcome = Outcome.HOLDS if snr_db >= FAILED_SNR_DB else Outcome.FAILS
    return Measured(outcome, figures, "" if outcome is Outcome.HOLDS else f"SNR {snr_db:z.1f} dB")


def _degraded(cell: Verdict, wanted_db: float, effect: str = "") -> Verdict:
    """Return a cell, degraded if its SNR is lower than wanted; `effect`: what follows the SNR in words."""
    snr_db = cell.figure("snr_db")
    if cell.outcome is not Outcome.HOLDS or math.isnan(snr_db) or snr_db >= wanted_db:
        return cell
    return replace(cell, outcome=Outcome.DEGRADED, effect=f"SNR {snr_db:z.1f} dB{effect}")


def falls(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded whose SNR is lower than that of a coarser rate point of the same curve."""
    best_db: dict[tuple[str, str], float] = {}
    judged = []
    for cell in cells:
        curve, snr_db = (cell.method, cell.case), cell.figure("snr_db")
        before_db = best_db.get(curve, -math.inf)
        judged.append(
            _degraded(cell, before_db - FALL_DB, f", {before_db - snr_db:.1f} dB less than at a coarser setting")
        )
        best_db[curve] = before_db if math.isnan(snr_db) else max(before_db, snr_db)
    return judged


def near_best(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded whose SNR is more than HALF_DB below the best of the same curve."""
    best_db: dict[tuple[str, str], float] = {}
    for cell in cells:
        curve = (cell.method, cell.case)
        best_db[curve] = max(best_db.get(curve, -math.inf), cell.figure("snr_db"))
    wanted = [(cell, best_db[cell.method, cell.case]) for cell in cells]
    return [_degraded(cell, best - HALF_DB, f", {best:.1f} dB at the best") for cell, best in wanted]


def half_left(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded in which less than half of the power is left."""
    return [_degraded(cell, HALF_DB) for cell in cells]


def _rate_points(scope: Scope) -> Iterator[Trial]:
    for method in scope.methods:
        rate_point_sets = {method.name: maps.rate_points(method)}
        if not method.models:
            known = codec.CODECS[method.name]
            rate_point_sets = {
                name: [RatePoint(method.name, setting) for setting in own]
                for name, own in known.rate_point_sets.items()
                if name not in known.named_rate_point_sets
            }
        for name, rate_point_set in rate_point_sets.items():
            if len(rate_point_set) > 1:
                yield from _on_textures(name, list(enumerate(rate_point_set, 1)), scope)


def _on_textures(method: str, rate_point_set: Sequence[tuple[float, RatePoint]], scope: Scope) -> Iterator[Trial]:
    """Return the trials of rate points, each with its value, on every texture."""
    for texture in scope.some(TEXTURES, len(TEXTURES)):
        for value, rate_point in scope.some(rate_point_set, max(1, len(rate_point_set) // 2)):
            yield Trial(method, texture, partial(measure_texture, rate_point, texture), rate_point.text, float(value))


def _snr_rule(holds: str) -> Rule:
    return Rule("SNR", holds, f"below {FAILED_SNR_DB:g} dB")


_RISING = _snr_rule(f"at most {FALL_DB:g} dB below a coarser setting's")
_TEXTURES = f"heights of wood, sandpaper and leather at {HAND_SPEED_MM_S:g} mm/s, and an acceleration"
RATE_POINTS = Map(
    name="rate_points",
    group=Group.SETTINGS,
    title="Rate points",
    tried=f"Every rate point codes four textures: {_TEXTURES}. The worst counts.",
    rule=_RISING,
    conditions=_rate_points,
    message=lambda cells: f"Finer settings raise the SNR {with_methods(cells, 'set')}",
    caption="rate point, the coarsest first",
    value_name="rate_point",
    varied="rate point {}",
    judged=falls,
)

DCT = "dct"
LEVELS = (4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 16, 18, 20, 22, 24, 26, 28, 32, 36, 40, 48, 56, 64)
B0_DB = (24, 20, 16, 12, 10, 8, 6, 4, 2, 0, -2, -4, -6, -8, -10, -12, -16, -20, -24)
SMALLEST = (3.0, 2.0, 1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002)
S_LEVELS = (8, 14, 28)
FINEST_LEVELS = 65_535


def _of_dct(methods: Mapping[str, Setting], parameter: str, values: Sequence[float], scope: Scope) -> Iterator[Trial]:
    """Return the trials of one parameter of DCT; each method fixes the other parameters."""
    if scope.has(DCT):
        for method, fixed in methods.items():
            points = [(value, RatePoint(DCT, {**fixed, parameter: value})) for value in values]
            yield from _on_textures(method, points, scope)


def _smallest_message(cells: Sequence[Verdict]) -> str:
    """Return for each method the values that suit every texture."""
    parts = []
    for method in dict.fromkeys(cell.method for cell in cells):
        own = [cell for cell in cells if cell.method == method]
        every = [cell.value for cell in own if cell.value is not None]
        parts.append(f"{maps.ranges(maps.sound_values(own), every) or 'none'} with {method.partition('log, ')[2]}")
    return f"S that suits every texture: {'; '.join(parts)}"


def _threshold_message(cells: Sequence[Verdict]) -> str:
    values = maps.sound_values(cells)
    upper = f"up to b0 = {max(values):g} dB" if values else "at no b0"
    return f"The threshold cut keeps half the power of every texture {upper}"


_dct_map = partial(
    Map,
    group=Group.SETTINGS,
    place=lambda cell: Place(f"{cell.method}: {cell.case}", cell.value or 0.0),
    label=figure("snr_db"),
)
DCT_LEVELS = _dct_map(
    name="dct_levels",
    title="Quantiser levels",
    tried=f"Both quantisers code {_TEXTURES}.",
    rule=_RISING,
    conditions=partial(
        _of_dct,
        {f"dct, {quantiser}": {"quantiser": quantiser} for quantiser in ("linear", "log")},
        "levels",
        LEVELS,
    ),
    message=lambda cells: f"More levels raise the SNR {with_methods(cells, 'quantiser')}",
    caption="levels; SNR in dB",
    value_name="levels",
    varied="{} levels",
    judged=falls,
)
DCT_THRESHOLD = _dct_map(
    name="dct_threshold",
    title="Threshold cut",
    tried="The cut removes what lies below the detection threshold plus b0, and the rest keeps 16 bits.",
    rule=_snr_rule(f"from {HALF_DB:g} dB (half of the power is left)"),
    conditions=partial(_of_dct, {"dct, cut": {"levels": FINEST_LEVELS, "threshold": "on"}}, "b0_db", B0_DB),
    message=_threshold_message,
    caption="b0, dB; SNR in dB",
    value_name="b0_db",
    varied="b0 of {} dB",
    judged=half_left,
)
DCT_SMALLEST = _dct_map(
    name="dct_smallest",
    title="Smallest magnitude",
    tried="S is the least magnitude of the logarithmic quantiser.",
    rule=_snr_rule(f"at most {HALF_DB:g} dB below the best S's"),
    conditions=partial(
        _of_dct,
        {f"dct, log, {levels} levels": {"quantiser": "log", "levels": levels} for levels in S_LEVELS},
        "smallest",
        SMALLEST,
    ),
    message=_smallest_message,
    caption="S, µm or m/s²; SNR in dB",
    value_name="smallest_um_or_m_s2",
    varied="S of {} µm or m/s²",
    judged=near_best,
)

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


def measure_coefficients(coder: str, case: str) -> Measured:
    """Code a signal that has these DCT coefficients and grade the bits of the whole stream above the entropy.

    Raises CodecError.
    """
    make, levels = COEFFICIENTS[case]
    coefficients = make()
    samples = np.asarray(idct(coefficients, axis=1, norm="ortho").reshape(-1, 1) / math.sqrt(BLOCK))
    setting: Setting = {"levels": levels, "entropy": coder, "block": str(BLOCK), "dc": "keep"}
    return _rated(RatePoint(DCT, setting), samples, needed_bits(coefficients, levels))


def measure_silence(rate_point: RatePoint) -> Measured:
    """Code silence, whose entropy is 0."""
    return _rated(rate_point, np.zeros((BLOCKS * BLOCK, 1)), 0.0)


def _rated(rate_point: RatePoint, samples: Signal, needed: float) -> Measured:
    _, stream = decoded(samples, RATE_HZ, rate_point)
    return judge_rate(8 * stream.size_bytes / samples.size, needed)


def judge_rate(bits: float, needed: float) -> Measured:
    """Return the outcome of a rate against the entropy, both in bits per sample."""
    figures = {"excess_bits": bits - needed, "bits_per_sample": bits, "entropy_bits": needed}
    effect = f"{bits:.2f} bits per sample where {needed:.2f} would do"
    return graded(bits - needed, HELD_BITS, FAILED_BITS, figures, effect)


def _entropy(scope: Scope) -> Iterator[Trial]:
    for method in scope.methods:
        rate_point = maps.middle_rate_point(method)
        yield Trial(method.name, SILENCE, partial(measure_silence, rate_point), f"middle: {rate_point.text}")
    for case in scope.some(list(COEFFICIENTS), 3) if scope.has(DCT) else ():
        for coder in CODERS:
            yield Trial(f"{DCT}, {coder}", case, partial(measure_coefficients, coder, case))


def _silence_message(cells: Sequence[Verdict]) -> str:
    silence = [cell for cell in cells if cell.case == SILENCE]
    return f"Silence costs less than {HELD_BITS:g} bits per sample {with_methods(silence)}"


ENTROPY = Map(
    name="entropy_coding",
    group=Group.SETTINGS,
    title="Entropy coding",
    tried=f"Every codec codes silence. `{DCT}` also codes coefficients that are all extreme or almost all alike.",
    rule=Rule("bits per sample above the entropy", f"up to {HELD_BITS:g}", f"more than {FAILED_BITS:g}"),
    conditions=_entropy,
    message=_silence_message,
    place=lambda cell: Place(cell.method, cell.case),
    caption="bits per sample above the entropy",
    label=figure("excess_bits", ".1f"),
)
MAPS = (RATE_POINTS, DCT_LEVELS, DCT_THRESHOLD, DCT_SMALLEST, FILTERS, ENTROPY)
