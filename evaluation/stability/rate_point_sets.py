"""Settings from coarse to fine: does the quality rise on the way up every set of rate points?"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from vibrocast import codec
from vibrocast.codec.interface import Setting
from vibrocast.evaluation.stability import pictures
from vibrocast.evaluation.stability.maps import Map, RatePoint, Scope, rate_points
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
    """Return a texture by its name, with its unit: heights without their mean, or what a stylus on wood feels."""
    if name == "acceleration":
        return wood(0, SECONDS, HAND_SPEED_MM_S, RATE_HZ).samples, "m/s^2"
    samples = SURFACES[name](0, SECONDS, HAND_SPEED_MM_S, RATE_HZ).samples
    return np.asarray(samples - samples.mean()), "um"


def measure(rate_point: RatePoint, name: str) -> Measured:
    """Code a texture at a setting: SNR, ST-SIM, bits per sample of the whole stream. Raises CodecError."""
    from vibrocast.evaluation import metrics

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
            every = codec.CODECS[method.name].rate_point_sets
            rate_point_sets = {
                name: [RatePoint(method.name, setting) for setting in own] for name, own in every.items()
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


def _curves(cells: Sequence[Verdict], method: str, figure: str) -> list[pictures.Curve]:
    """Return a curve for each texture; ringed where the SNR falls."""
    own = [cell for cell in cells if cell.method == method]
    return pictures.curves_of(own, figure, lambda cell: cell.case, lambda cell: cell.outcome is not Outcome.HOLDS)


def _draw(path: Path, cells: Sequence[Verdict]) -> None:
    """One panel for each set of rate points, one curve for each texture."""
    panels = [
        pictures.Panel(
            rate_point_set, "rate point, the coarsest first", "SNR, dB", _curves(cells, rate_point_set, "snr_db")
        )
        for rate_point_set in dict.fromkeys(cell.method for cell in cells)
    ]
    pictures.curves(path, panels, across=3)


def _draw_sweep(x_label: str, log_x: bool, path: Path, cells: Sequence[Verdict]) -> None:
    """SNR and ST-SIM of each method, side by side."""
    panels = [
        pictures.Panel(f"{method}: {title}", x_label, "", _curves(cells, method, figure), log_x)
        for method in dict.fromkeys(cell.method for cell in cells)
        for figure, title in (("snr_db", "SNR, dB"), ("st_sim_2800", "ST-SIM (2800 Hz)"))
    ]
    pictures.curves(path, panels)


_RULES = {"seconds": SECONDS, "hand_speed_mm_s": HAND_SPEED_MM_S, "failed_snr_db": FAILED_SNR_DB}
RATE_POINTS = Map(
    "ladders",
    "Settings from coarse to fine",
    {**_RULES, "fall_db": FALL_DB},
    "rate point {}",
    _trials,
    _draw,
    falls,
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
    """Return the trials of one parameter of the codec that these maps are about, beside fixed ones of each method."""
    if not scope.has(DCT):
        return []
    return [
        trial
        for method, fixed in methods.items()
        for trial in _of_rate_points(
            name, method, [(value, RatePoint(DCT, {**fixed, parameter: value})) for value in values], scope
        )
    ]


DCT_LEVELS = Map(
    "dct_levels",
    "Levels of the DCT codec",
    {**_RULES, "fall_db": FALL_DB},
    "{} levels",
    partial(
        _dct_trials,
        "dct_levels",
        {"dct, linear": {"quantiser": "linear"}, "dct, log": {"quantiser": "log"}},
        "levels",
        LEVELS,
    ),
    partial(_draw_sweep, "levels L", True),
    falls,
)
DCT_THRESHOLD = Map(
    "dct_threshold",
    "Threshold cut of the DCT codec",
    {**_RULES, "half_db": HALF_DB},
    "b0 of {} dB",
    partial(_dct_trials, "dct_threshold", {"dct, cut": {"levels": FINEST_LEVELS, "threshold": "on"}}, "b0_db", B0_DB),
    partial(_draw_sweep, "b0, dB", False),
    half_left,
)
DCT_SMALLEST = Map(
    "dct_smallest",
    "Smallest magnitude of the logarithmic quantiser",
    {**_RULES, "half_db": HALF_DB, "levels": S_LEVELS},
    "S of {} um or m/s^2",
    partial(
        _dct_trials,
        "dct_smallest",
        {f"dct, log, {levels} levels": {"quantiser": "log", "levels": levels} for levels in S_LEVELS},
        "smallest",
        SMALLEST,
    ),
    partial(_draw_sweep, "S, um or m/s^2", True),
    near_best,
)
