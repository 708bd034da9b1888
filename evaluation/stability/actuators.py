"""Actuators that differ from what their compensation assumes, and compensation that asks for more than there is."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.evaluation.stability import pictures
from vibrocast.evaluation.stability.maps import Map, Scope
from vibrocast.evaluation.stability.trials import Measured, Trial, Verdict, graded
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    VOICE_COIL,
    Actuator,
    Samples,
)
from vibrocast.output.rendering import render

SHIFTS_PERCENT = (-20, -15, -10, -5, -2, 0, 2, 5, 10, 15, 20)
QUALITIES = (5.0, 15.0, 30.0)
BAND_HZ = (40.0, 400.0)
FELT_DB, FAR_DB = 1.6, 6.0
"""A change of 20 % in amplitude is felt (Weber fraction of the Pacinian channel, 10 to 20 % for fine differences)."""

FREQUENCIES_HZ = (20, 50, 100, 150, 200, 250, 300, 350, 400, 600, 800)
AMPLITUDES_UM = (5, 10, 15, 20, 25, 30, 35, 40)
SINE_S = 0.5
_RATE_HZ = 3000  # the piezo's own: nothing is resampled


def gain_db(actuator: Actuator, compensated_as: Actuator, frequencies_hz: Samples) -> Samples:
    """Return the gain, in dB, from wanted to real displacement, at the DAC's rate."""
    gains = [
        np.abs(scipy.signal.freqz(b, a, worN=frequencies_hz, fs=actuator.dac_rate_hz)[1])
        for b, a in (actuator.response(actuator.dac_rate_hz), compensated_as.inverse())
    ]
    return np.asarray(20 * np.log10(np.maximum(gains[0] * gains[1], 1e-10)))


def measure_shift(actuator: Actuator, shift_percent: float) -> Measured:
    """Shift a resonance; judge by how much the compensated gain changes where it changes most in BAND_HZ."""
    frequencies_hz = np.geomspace(*BAND_HZ, 400)
    shifted = dataclasses.replace(actuator, corner_hz=actuator.corner_hz * (1 + shift_percent / 100))
    change_db = gain_db(shifted, actuator, frequencies_hz) - gain_db(actuator, actuator, frequencies_hz)
    worst = int(np.argmax(np.abs(change_db)))
    error_db = float(np.abs(change_db[worst]))
    figures = {"error_db": error_db, "worst_hz": float(frequencies_hz[worst]), "change_db": float(change_db[worst])}
    effect = f"{change_db[worst]:+z.1f} dB at {frequencies_hz[worst]:.0f} Hz"
    return graded(error_db, FELT_DB, FAR_DB, figures, effect)


def measure_sine(actuator: Actuator, frequency_hz: float, amplitude_um: float, compensation: bool) -> Measured:
    """Ask for a sine of displacement; judge by the fundamental that comes out and by what the limits held back."""
    time_s = np.arange(round(SINE_S * _RATE_HZ)) / _RATE_HZ
    wanted = amplitude_um / actuator.excursion_um * np.sin(2 * np.pi * frequency_hz * time_s)
    decoded = np.rint(32767 * wanted).astype(np.int16).reshape(-1, 1)
    header = StreamHeader(1, _RATE_HZ, len(decoded), "um", (actuator.excursion_um,), b"")
    codes, counts = render(header, decoded, 0, actuator, compensation=compensation)
    middle = slice(_RATE_HZ // 10, _RATE_HZ // 10 + _RATE_HZ // 4)
    displacement_um = actuator.displacement_um(codes)[middle, 0]
    basis = np.exp(-2j * np.pi * frequency_hz * np.arange(len(displacement_um)) / _RATE_HZ)
    reached_um = 2 * abs(np.mean(displacement_um * basis))
    error_db = 20 * math.log10(max(float(reached_um), 1e-6) / amplitude_um)
    shares = {
        "clipped": counts.compensation_clipped + counts.voltage_limited,
        "slew_limited": counts.slew_limited,
        "power_limited": counts.power_limited,
    }
    figures = {"error_db": abs(error_db), "change_db": error_db} | {
        f"{name}_share": each / len(codes) for name, each in shares.items()
    }
    limits = [f"{100 * each / len(codes):.0f} % {name.replace('_', ' ')}" for name, each in shares.items() if each]
    effect = ", ".join([f"{error_db:+z.1f} dB", *limits])
    return graded(abs(error_db), FELT_DB, FAR_DB, figures, effect)


def _shift_trials(scope: Scope) -> list[Trial]:
    shifts = SHIFTS_PERCENT[::5] if scope.quick else SHIFTS_PERCENT
    actuators = [dataclasses.replace(LRA, quality=quality) for quality in QUALITIES] + [VOICE_COIL]
    return [
        Trial(
            RESONANCE.name,
            f"{actuator.name} of {actuator.corner_hz:g} Hz",
            f"Q {actuator.quality:g}",
            "",
            float(shift),
            partial(measure_shift, actuator, shift),
        )
        for actuator in actuators
        for shift in shifts
    ]


def _sine_trials(scope: Scope) -> list[Trial]:
    step = 5 if scope.quick else 1
    return [
        Trial(
            VOLTAGE.name,
            PIEZO_STACK.name + (", compensated" if compensation else ", as it is"),
            f"{frequency_hz} Hz",
            "",
            float(amplitude_um),
            partial(measure_sine, PIEZO_STACK, frequency_hz, amplitude_um, compensation),
        )
        for compensation in (True, False)
        for frequency_hz in FREQUENCIES_HZ[::step]
        for amplitude_um in AMPLITUDES_UM[::step]
    ]


def _draw_shift(path: Path, cells: Sequence[Verdict]) -> None:
    curves = pictures.curves_of(cells, "error_db", lambda cell: f"{cell.method}, {cell.case}")
    title = (
        f"largest change of the level from {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz, dB; felt and failing above the lines"
    )
    panel = pictures.Panel(title, "shift of the resonance, %", "", curves, lines=(FELT_DB, FAR_DB))
    pictures.curves(path, [panel])


def _draw_sines(path: Path, cells: Sequence[Verdict]) -> None:
    """Amplitudes downwards, the largest first, with compensation above those without; frequencies across."""
    methods = list(dict.fromkeys(cell.method for cell in cells))
    pictures.outcome_map(
        path,
        sorted(cells, key=lambda cell: (methods.index(cell.method), -(cell.value or 0.0))),
        lambda cell: (f"{cell.value:g} um, {cell.method.split(', ')[1]}", cell.case),
        "a sine of this amplitude (rows) and frequency (columns)",
    )


RESONANCE = Map(
    "resonance",
    "Shifted resonance",
    {"band_hz": BAND_HZ, "felt_db": FELT_DB, "far_db": FAR_DB},
    "{} %",
    _shift_trials,
    _draw_shift,
)
VOLTAGE = Map(
    "voltage_limit",
    "Inverse filter against the limits of the amplifier",
    {"sine_s": SINE_S, "felt_db": FELT_DB, "far_db": FAR_DB},
    "{} um",
    _sine_trials,
    _draw_sines,
)
