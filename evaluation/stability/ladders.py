"""Ladders of settings: does quality rise with every rung, on surfaces and recordings?"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

import codec
from codec.interface import Setting
from evaluation.stability import pictures
from evaluation.stability.maps import Map, Scope
from evaluation.stability.signals import RATE_HZ, Signal, decoded, texture
from evaluation.stability.trials import Cell, Measured, Outcome, Trial, setting_text
from textures import Recording
from textures.generate import rough, stick_slip, wood_surface

SECONDS = 1.0
HAND_SPEED_MM_S = 50.0
FALL_DB = 0.1
"""A fall of the SNR from one rung to the next that counts."""

SURFACES: dict[str, Callable[..., Recording]] = {"wood": wood_surface, "sandpaper": rough, "leather": stick_slip}
TEXTURES = (*SURFACES, "acceleration")


def samples_of(name: str) -> Signal:
    """Return a texture by its name: heights in um without their mean, or the acceleration of a stylus on wood."""
    if name == "acceleration":
        return texture(seconds=SECONDS)
    samples = SURFACES[name](0, SECONDS, HAND_SPEED_MM_S, RATE_HZ).samples
    return np.asarray(samples - samples.mean())


def measure(codec_name: str, setting: Setting, name: str) -> Measured:
    """Code a texture at a setting: SNR and bits per sample of the whole stream. Raises CodecError."""
    samples = samples_of(name)
    heard, stream = decoded(samples, RATE_HZ, codec_name, setting)
    snr_db = codec.snr_db(samples, heard)
    assert snr_db is not None, "a texture is not silent"
    figures = {"snr_db": snr_db, "bits_per_sample": 8 * stream.size_bytes / samples.size}
    outcome = Outcome.HOLDS if snr_db >= 0 else Outcome.FAILS
    return Measured(outcome, figures, "" if outcome is Outcome.HOLDS else f"SNR {snr_db:.1f} dB")


def falls(cells: list[Cell]) -> list[Cell]:
    """Return the cells, those degraded whose SNR is lower than that of a coarser rung of the same curve."""
    best: dict[tuple[str, str], float] = {}
    judged = []
    for cell in cells:
        curve, snr_db = (cell.method, cell.case), cell.figure("snr_db")
        before_db = best.get(curve, -math.inf)
        if cell.outcome is Outcome.HOLDS and snr_db < before_db - FALL_DB:
            effect = f"SNR {snr_db:.1f} dB, {before_db - snr_db:.1f} dB less than at a coarser setting"
            cell = dataclasses.replace(cell, outcome=Outcome.DEGRADED, effect=effect)
        if not math.isnan(snr_db):
            best[curve] = max(before_db, snr_db)
        judged.append(cell)
    return judged


def _trials(scope: Scope) -> list[Trial]:
    trials = []
    for codec_name in scope.codecs:
        for ladder, rungs in codec.CODECS[codec_name].ladders.items():
            chosen = rungs[:: max(1, len(rungs) // 2)] if scope.quick else rungs
            trials += [
                Trial(
                    LADDERS.name,
                    ladder,
                    name,
                    setting_text(setting),
                    float(rungs.index(setting) + 1),
                    partial(measure, codec_name, setting, name),
                )
                for name in (TEXTURES[:1] if scope.quick else TEXTURES)
                for setting in chosen
            ]
    return trials


def _draw(path: Path, cells: Sequence[Cell]) -> None:
    """One panel for each ladder, one curve for each texture; ringed where quality falls."""
    panels = []
    for ladder in dict.fromkeys(cell.method for cell in cells):
        curves = []
        for case in dict.fromkeys(cell.case for cell in cells):
            own = [cell for cell in cells if (cell.method, cell.case) == (ladder, case)]
            x = [cell.value or 0.0 for cell in own]
            snrs_db = [cell.figure("snr_db") if math.isfinite(cell.figure("snr_db")) else math.nan for cell in own]
            curves.append(pictures.Curve(case, x, snrs_db, [cell.outcome is not Outcome.HOLDS for cell in own]))
        panels.append(pictures.Panel(ladder, "rung, the coarsest first", "SNR, dB", curves))
    pictures.curves(path, panels, across=3)


LADDERS = Map(
    "ladders",
    "Settings from coarse to fine",
    f"Every rung of every ladder on {SECONDS:g} s of generated surfaces (heights at {HAND_SPEED_MM_S:g} mm/s; leather "
    f"by stick and slip) and an acceleration. D: the SNR is more than {FALL_DB:g} dB below that of a coarser rung; F: "
    "below 0 dB.",
    "rung",
    _trials,
    _draw,
    falls,
)
