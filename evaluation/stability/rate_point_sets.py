"""Settings from coarse to fine: whether the quality rises along every set of rate points."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from vibrocast import codec
from vibrocast.codec.interface import Setting
from vibrocast.evaluation.stability.maps import (
    Group,
    Map,
    Place,
    RatePoint,
    Rule,
    Scope,
    figure,
    ranges,
    rate_points,
    sound_values,
    with_methods,
)
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict
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


def measure(rate_point: RatePoint, name: str) -> Measured:
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


def falls(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded whose SNR is lower than that of a coarser rate point of the same curve."""
    best: dict[tuple[str, str], float] = {}
    judged = []
    for cell in cells:
        curve, snr_db = (cell.method, cell.case), cell.figure("snr_db")
        before_db = best.get(curve, -math.inf)
        if cell.outcome is Outcome.HOLDS and snr_db < before_db - FALL_DB:
            effect = f"SNR {snr_db:z.1f} dB, {before_db - snr_db:.1f} dB less than at a coarser setting"
            cell = dataclasses.replace(cell, outcome=Outcome.DEGRADED, effect=effect)
        if not math.isnan(snr_db):
            best[curve] = max(before_db, snr_db)
        judged.append(cell)
    return judged


def near_best(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded whose SNR is more than HALF_DB below the best of the same curve."""
    best_db: dict[tuple[str, str], float] = {}
    for cell in cells:
        curve = (cell.method, cell.case)
        best_db[curve] = max(best_db.get(curve, -math.inf), cell.figure("snr_db"))

    def judged(cell: Verdict) -> Verdict:
        snr_db, best = cell.figure("snr_db"), best_db[cell.method, cell.case]
        if cell.outcome is not Outcome.HOLDS or snr_db >= best - HALF_DB:
            return cell
        effect = f"SNR {snr_db:z.1f} dB, {best:.1f} dB at the best"
        return dataclasses.replace(cell, outcome=Outcome.DEGRADED, effect=effect)

    return [judged(cell) for cell in cells]


def half_left(cells: list[Verdict]) -> list[Verdict]:
    """Return the cells, those degraded in which less than half of the power is left."""
    return [
        dataclasses.replace(cell, outcome=Outcome.DEGRADED, effect=f"SNR {cell.figure('snr_db'):z.1f} dB")
        if cell.outcome is Outcome.HOLDS and cell.figure("snr_db") < HALF_DB
        else cell
        for cell in cells
    ]


def _trials(scope: Scope) -> list[Trial]:
    trials = []
    for method in scope.methods:
        rate_point_sets = {method.name: rate_points(method)}
        if not method.models:
            known = codec.CODECS[method.name]
            rate_point_sets = {
                name: [RatePoint(method.name, setting) for setting in own]
                for name, own in known.rate_point_sets.items()
                if name not in known.named_rate_point_sets
            }
        for name, rate_point_set in rate_point_sets.items():
            if len(rate_point_set) > 1:
                trials += _of_rate_points(RATE_POINTS.name, name, list(enumerate(rate_point_set, 1)), scope)
    return trials


def _of_rate_points(
    name: str, method: str, rate_point_set: Sequence[tuple[float, RatePoint]], scope: Scope
) -> list[Trial]:
    """Return the trials of rate points, each with its value, on every texture."""
    chosen = rate_point_set[:: max(1, len(rate_point_set) // 2)] if scope.quick else rate_point_set
    return [
        Trial(name, method, texture, rate_point.text, float(value), partial(measure, rate_point, texture))
        for texture in (TEXTURES[:1] if scope.quick else TEXTURES)
        for value, rate_point in chosen
    ]


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
    trials=_trials,
    message=lambda cells: f"Finer settings raise the SNR {with_methods(cells, 'set')}",
    place=lambda cell: Place(cell.method, cell.value or 0.0),
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


def _dct_trials(
    name: str, methods: Mapping[str, Setting], parameter: str, values: Sequence[float], scope: Scope
) -> list[Trial]:
    """Return the trials of one parameter of DCT; each method fixes the other parameters."""
    if not scope.has(DCT):
        return []
    return [
        trial
        for method, fixed in methods.items()
        for trial in _of_rate_points(
            name, method, [(value, RatePoint(DCT, {**fixed, parameter: value})) for value in values], scope
        )
    ]


def _texture_place(cell: Verdict) -> Place:
    return Place(f"{cell.method}: {cell.case}", cell.value or 0.0)


def _smallest_message(cells: Sequence[Verdict]) -> str:
    """Return for each method the values that suit every texture."""
    parts = []
    for method in dict.fromkeys(cell.method for cell in cells):
        own = [cell for cell in cells if cell.method == method]
        every = [cell.value for cell in own if cell.value is not None]
        parts.append(f"{ranges(sound_values(own), every) or 'none'} with {method.partition('log, ')[2]}")
    return f"S that suits every texture: {'; '.join(parts)}"


def _threshold_message(cells: Sequence[Verdict]) -> str:
    values = sound_values(cells)
    upper = f"up to b0 = {max(values):g} dB" if values else "at no b0"
    return f"The threshold cut keeps half the power of every texture {upper}"


DCT_LEVELS = Map(
    name="dct_levels",
    group=Group.SETTINGS,
    title="Quantiser levels",
    tried=f"Both quantisers code {_TEXTURES}.",
    rule=_RISING,
    trials=partial(
        _dct_trials,
        "dct_levels",
        {"dct, linear": {"quantiser": "linear"}, "dct, log": {"quantiser": "log"}},
        "levels",
        LEVELS,
    ),
    message=lambda cells: f"More levels raise the SNR {with_methods(cells, 'quantiser')}",
    place=_texture_place,
    caption="levels; SNR in dB",
    label=figure("snr_db"),
    value_name="levels",
    varied="{} levels",
    judged=falls,
)
DCT_THRESHOLD = Map(
    name="dct_threshold",
    group=Group.SETTINGS,
    title="Threshold cut",
    tried="The cut removes what lies below the detection threshold plus b0, and the rest keeps 16 bits.",
    rule=_snr_rule(f"from {HALF_DB:g} dB (half of the power is left)"),
    trials=partial(
        _dct_trials, "dct_threshold", {"dct, cut": {"levels": FINEST_LEVELS, "threshold": "on"}}, "b0_db", B0_DB
    ),
    message=_threshold_message,
    place=_texture_place,
    caption="b0, dB; SNR in dB",
    label=figure("snr_db"),
    value_name="b0_db",
    varied="b0 of {} dB",
    judged=half_left,
)
DCT_SMALLEST = Map(
    name="dct_smallest",
    group=Group.SETTINGS,
    title="Smallest magnitude",
    tried="S is the least magnitude of the logarithmic quantiser.",
    rule=_snr_rule(f"at most {HALF_DB:g} dB below the best S's"),
    trials=partial(
        _dct_trials,
        "dct_smallest",
        {f"dct, log, {levels} levels": {"quantiser": "log", "levels": levels} for levels in S_LEVELS},
        "smallest",
        SMALLEST,
    ),
    message=_smallest_message,
    place=_texture_place,
    caption="S, µm or m/s²; SNR in dB",
    label=figure("snr_db"),
    value_name="smallest_um_or_m_s2",
    varied="S of {} µm or m/s²",
    judged=near_best,
)
