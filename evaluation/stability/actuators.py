"""Actuators whose resonance lies off the compensated one, and compensation beyond the amplifier's limits."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import scipy

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.evaluation.stability.maps import Group, Map, Place, Rule, Scope, figure, sound_values
from vibrocast.evaluation.stability.trials import Measured, Trial, Verdict, graded
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    SKIN_OVERSAMPLING,
    VOICE_COIL,
    Actuator,
    Samples,
)
from vibrocast.output.rendering import render
from vibrocast.pages import listed

SHIFTS_PERCENT = (-20, -15, -10, -5, -2, 0, 2, 5, 10, 15, 20)
QUALITIES = (5.0, 15.0, 30.0)
BAND_HZ = (40.0, 400.0)
FELT_DB, FAR_DB = 1.6, 6.0
"""A change of 20 % in amplitude is felt (Weber fraction of the Pacinian channel, 10 to 20 % for fine differences)."""

_LEVEL_LIMITS = f"up to {FELT_DB:g} dB", f"above {FAR_DB:g} dB"

FREQUENCIES_HZ = (20, 50, 100, 150, 200, 250, 300, 350, 400, 600, 800)
AMPLITUDES_UM = (5, 10, 15, 20, 25, 30, 35, 40)
SINE_S = 0.5
_RATE_HZ = 3000  # the piezo's own, so that nothing is resampled


def gain_db(actuator: Actuator, compensated_as: Actuator, frequencies_hz: Samples) -> Samples:
    """Return the gain in dB from target to real displacement, at the DAC's rate: one for each frequency."""
    gains = [
        np.abs(scipy.signal.freqz(b, a, worN=frequencies_hz, fs=actuator.dac_rate_hz)[1])
        for b, a in (actuator.response(actuator.dac_rate_hz), compensated_as.inverse())
    ]
    return np.asarray(20 * np.log10(np.maximum(gains[0] * gains[1], 1e-10)))


def measure_shift(actuator: Actuator, shift_percent: float) -> Measured:
    """Shift a resonance and grade the largest change of the compensated gain within BAND_HZ."""
    frequencies_hz = np.geomspace(*BAND_HZ, 400)
    shifted = dataclasses.replace(actuator, corner_hz=actuator.corner_hz * (1 + shift_percent / 100))
    change_db = gain_db(shifted, actuator, frequencies_hz) - gain_db(actuator, actuator, frequencies_hz)
    worst = int(np.argmax(np.abs(change_db)))
    error_db = float(np.abs(change_db[worst]))
    figures = {"error_db": error_db, "worst_hz": float(frequencies_hz[worst]), "change_db": float(change_db[worst])}
    effect = f"{change_db[worst]:+z.1f} dB at {frequencies_hz[worst]:.0f} Hz"
    return graded(error_db, FELT_DB, FAR_DB, figures, effect)


def measure_sine(actuator: Actuator, frequency_hz: float, amplitude_um: float, compensation: bool) -> Measured:
    """Play a sine of displacement and grade the amplitude of the fundamental; count the samples that were limited."""
    time_s = np.arange(round(SINE_S * _RATE_HZ)) / _RATE_HZ
    wanted = amplitude_um / actuator.excursion_um * np.sin(2 * np.pi * frequency_hz * time_s)
    decoded = np.rint(32767 * wanted).astype(np.int16).reshape(-1, 1)
    header = StreamHeader(1, _RATE_HZ, len(decoded), "um", (actuator.excursion_um,), b"")
    codes, counts = render(header, decoded, 0, actuator, compensation=compensation)
    skin_rate_hz = SKIN_OVERSAMPLING * _RATE_HZ
    middle = slice(skin_rate_hz // 10, skin_rate_hz // 10 + skin_rate_hz // 4)
    displacement_um = actuator.displacement_um(codes, SKIN_OVERSAMPLING)[middle, 0]
    basis = np.exp(-2j * np.pi * frequency_hz * np.arange(len(displacement_um)) / skin_rate_hz)
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
            PIEZO_STACK.name + (", compensated" if compensation else ", not compensated"),
            f"{amplitude_um} µm",
            "",
            float(frequency_hz),
            partial(measure_sine, PIEZO_STACK, frequency_hz, amplitude_um, compensation),
        )
        for compensation in (True, False)
        for amplitude_um in AMPLITUDES_UM[::-step]
        for frequency_hz in FREQUENCIES_HZ[::step]
    ]


def _shift_message(cells: Sequence[Verdict]) -> str:
    """Return the actuators that bear each shift, by their Q."""
    borne: dict[float, list[str]] = {}
    for case in dict.fromkeys(cell.case for cell in cells):
        shifts = sound_values([cell for cell in cells if cell.case == case])
        borne.setdefault(max(map(abs, shifts), default=0.0), []).append(case)
    parts = [f"{shift:g} % ({', '.join(cases)})" for shift, cases in borne.items()]
    return f"Compensation bears a resonance that is off by {listed(parts)}"


def _sine_message(cells: Sequence[Verdict]) -> str:
    """Return for each method up to which frequency every amplitude holds."""
    parts = []
    for method in dict.fromkeys(cell.method for cell in cells):
        own = [cell for cell in cells if cell.method == method]
        unsound_hz = min((cell.value or 0.0 for cell in own if not cell.sound), default=math.inf)
        held_hz = max((cell.value or 0.0 for cell in own if (cell.value or 0.0) < unsound_hz), default=0.0)
        parts.append(f"{held_hz:g} Hz {method.partition(', ')[2]}")
    return f"Every amplitude is reached up to {listed(parts)}"


RESONANCE = Map(
    name="resonance",
    group=Group.OUTPUT,
    title="Shifted resonance",
    tried=f"The resonance lies elsewhere than the compensation assumes. A change of {FELT_DB:g} dB is felt.",
    rule=Rule(f"change of level, {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz", *_LEVEL_LIMITS),
    trials=_shift_trials,
    message=_shift_message,
    place=lambda cell: Place(f"{cell.method}, {cell.case}", cell.value or 0.0),
    caption="shift of the resonance, %; change of the level in dB",
    label=figure("error_db", ".1f"),
    value_name="shift_percent",
    varied="{} %",
)
VOLTAGE = Map(
    name="voltage_limit",
    group=Group.OUTPUT,
    title="Amplifier limits",
    tried=f"A sine of {SINE_S:g} s drives the piezo stack, with the inverse filter and without.",
    rule=Rule("error of amplitude", *_LEVEL_LIMITS),
    trials=_sine_trials,
    message=_sine_message,
    place=lambda cell: Place(cell.case, cell.value or 0.0, cell.method.partition(", ")[2]),
    caption="frequency, Hz; error in dB",
    label=figure("error_db"),
    value_name="frequency_hz",
    varied="{} Hz",
)
