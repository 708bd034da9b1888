"""A surface coded at one hand speed and played at others: the quality of the band that is felt and rendered."""

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vibrocast.evaluation.stability.maps import (
    Group,
    Map,
    Place,
    RatePoint,
    Rule,
    Scope,
    figure,
    three_rate_points,
    with_methods,
)
from vibrocast.evaluation.stability.signals import ENOUGH_SNR_DB, FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial
from vibrocast.textures.generate import rough, wood_surface

CODED_MM_S = 50.0
SPEEDS_MM_S = (25.0, 30.0, 40.0, 50.0, 65.0, 80.0, 100.0, 140.0, 200.0)
BAND_HZ = (10.0, 400.0)
"""The band that the DCT paper codes and its actuator follows."""
SECONDS = 4.0
LOST_DB = 3.0
GENERATED = {"wood": wood_surface, "sandpaper": rough}


def band(spatial: Signal, speed_mm_s: float) -> NDArray[np.bool_]:
    """Return which of spatial frequencies, in 1/mm, a hand of this speed turns into BAND_HZ."""
    return (spatial * speed_mm_s >= BAND_HZ[0]) & (spatial * speed_mm_s <= BAND_HZ[1])


def measure(rate_point: RatePoint, surface: str, speed_mm_s: float) -> Measured:
    """Code a surface at CODED_MM_S, play it faster or slower, and grade BAND_HZ at that speed.

    A height z(x) at the place x is played at the time x / speed: its spatial frequency k becomes speed * k. So SNR
    within the band at any speed is a sum over a part of the same spectra. Raises CodecError.
    """
    samples = GENERATED[surface](0, SECONDS, CODED_MM_S, RATE_HZ).samples
    samples = samples - samples.mean()
    heard, _ = decoded(samples, RATE_HZ, rate_point, "um")
    spatial = np.asarray(np.fft.rfftfreq(len(samples), CODED_MM_S / RATE_HZ), np.float64)
    wanted, error, played = (
        np.abs(np.fft.rfft(each[:, 0] * np.hanning(len(samples)))) ** 2 for each in (samples, heard - samples, heard)
    )

    def snr_db(inside: NDArray[np.bool_]) -> float:
        return 10 * math.log10(max(float(wanted[inside].sum()), 1e-30) / max(float(error[inside].sum()), 1e-30))

    felt = band(spatial, speed_mm_s)
    within_db, coded_db = snr_db(felt), snr_db(band(spatial, CODED_MM_S))
    # From the upper half of the band, which is what the next octave of speed brings or takes.
    upper = felt & (spatial * speed_mm_s >= BAND_HZ[1] / 2)
    level_db = 10 * math.log10(max(float(played[upper].sum()), 1e-30) / max(float(wanted[upper].sum()), 1e-30))
    above = spatial * speed_mm_s > BAND_HZ[1]
    figures = {
        "snr_db": within_db,
        "snr_at_coded_speed_db": coded_db,
        "upper_octave_level_db": level_db,
        "share_above_band": float(played[above].sum() / max(float(played.sum()), 1e-30)),
    }
    effect = f"SNR {within_db:z.1f} dB ({coded_db:z.1f} dB at {CODED_MM_S:g} mm/s), upper octave {level_db:+z.1f} dB"
    if within_db < FAILED_SNR_DB or level_db < -20:
        return Measured(Outcome.FAILS, figures, effect)
    holds = within_db >= min(coded_db - LOST_DB, ENOUGH_SNR_DB) and abs(level_db) <= LOST_DB
    return Measured(Outcome.HOLDS if holds else Outcome.DEGRADED, figures, effect)


def _trials(scope: Scope) -> list[Trial]:
    speeds = SPEEDS_MM_S[::4] if scope.quick else SPEEDS_MM_S
    trials = []
    for method in scope.methods:
        rate_point = three_rate_points(method)["high"]
        trials += [
            Trial(
                HAND_SPEED.name,
                method.name,
                surface,
                rate_point.text,
                speed_mm_s,
                partial(measure, rate_point, surface, speed_mm_s),
            )
            for surface in GENERATED
            for speed_mm_s in speeds
        ]
    return trials


HAND_SPEED = Map(
    name="hand_speed",
    group=Group.OUTPUT,
    title="Hand speed",
    tried=f"A surface is coded at each codec's finest setting, at {CODED_MM_S:g} mm/s, and played at other speeds.",
    rule=Rule(
        f"SNR from {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz; level of the upper octave",
        f"SNR at most {LOST_DB:g} dB lower, or {ENOUGH_SNR_DB:g} dB; level within {LOST_DB:g} dB",
        f"SNR below {FAILED_SNR_DB:g} dB; octave 20 dB down",
    ),
    trials=_trials,
    message=lambda cells: f"A surface coded at {CODED_MM_S:g} mm/s suits every other speed {with_methods(cells)}",
    place=lambda cell: Place(cell.method, cell.value or 0.0, cell.case),
    caption="speed of the hand, mm/s; SNR in dB",
    label=figure("snr_db"),
    value_name="speed_mm_s",
    varied="{} mm/s",
)
