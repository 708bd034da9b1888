"""The hand and the actuator: other speeds, a shifted resonance, compensation beyond the amplifier's limits."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.evaluation.stability import maps
from vibrocast.evaluation.stability.maps import Group, Map, Place, RatePoint, Rule, Scope, figure
from vibrocast.evaluation.stability.signals import ENOUGH_SNR_DB, FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict, graded
from vibrocast.output.actuator import LRA, PIEZO_STACK, SKIN_OVERSAMPLING, VOICE_COIL, Actuator, Samples
from vibrocast.output.rendering import render
from vibrocast.pages import listed
from vibrocast.textures.generate import rough, wood_surface

CODED_MM_S = 50.0
SPEEDS_MM_S = (25.0, 30.0, 40.0, 50.0, 65.0, 80.0, 100.0, 140.0, 200.0)
FELT_HZ = (10.0, 400.0)
"""The band that the DCT paper codes and its actuator follows."""
SECONDS = 4.0
LOST_DB = 3.0
SURFACES = {"wood": wood_surface, "sandpaper": rough}


def band(spatial: Signal, speed_mm_s: float) -> NDArray[np.bool_]:
    """Return which of spatial frequencies, in 1/mm, a hand of this speed turns into FELT_HZ."""
    return (spatial * speed_mm_s >= FELT_HZ[0]) & (spatial * speed_mm_s <= FELT_HZ[1])


def measure_speed(rate_point: RatePoint, surface: str, speed_mm_s: float) -> Measured:
    """Code a surface at CODED_MM_S, play it faster or slower, and grade FELT_HZ at that speed.

    A height z(x) at the place x is played at the time x / speed: its spatial frequency k becomes speed * k. So SNR
    within the band at any speed is a sum over a part of the same spectra. Raises CodecError.
    """
    samples = SURFACES[surface](0, SECONDS, CODED_MM_S, RATE_HZ).samples
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
    upper = felt & (spatial * speed_mm_s >= FELT_HZ[1] / 2)
    level_db = 10 * math.log10(max(float(played[upper].sum()), 1e-30) / max(float(wanted[upper].sum()), 1e-30))
    above = spatial * speed_mm_s > FELT_HZ[1]
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


def _speeds(scope: Scope) -> Iterator[Trial]:
    for method in scope.methods:
        rate_point = maps.three_rate_points(method)["high"]
        for surface in SURFACES:
            for speed_mm_s in scope.some(SPEEDS_MM_S, 4):
                played = partial(measure_speed, rate_point, surface, speed_mm_s)
                yield Trial(method.name, surface, played, rate_point.text, speed_mm_s)


HAND_SPEED = Map(
    name="hand_speed",
    group=Group.OUTPUT,
    title="Hand speed",
    tried=f"A surface is coded at each codec's finest setting, at {CODED_MM_S:g} mm/s, and played at other speeds.",
    rule=Rule(
        f"SNR from {FELT_HZ[0]:g} to {FELT_HZ[1]:g} Hz; level of the upper octave",
        f"SNR at most {LOST_DB:g} dB lower, or {ENOUGH_SNR_DB:g} dB; level within {LOST_DB:g} dB",
        f"SNR below {FAILED_SNR_DB:g} dB; octave 20 dB down",
    ),
    conditions=_speeds,
    message=lambda cells: f"A surface coded at {CODED_MM_S:g} mm/s suits every other speed {maps.with_methods(cells)}",
    place=maps.by_value_and_case,
    caption="speed of the hand, mm/s; SNR in dB",
    label=figure("snr_db"),
    value_name="speed_mm_s",
    varied="{} mm/s",
)

SHIFTS_PERCENT = (-20, -15, -10, -5, -2, 0, 2, 5, 10, 15, 20)
QUALITIES = (5.0, 15.0, 30.0)
BAND_HZ = (40.0, 400.0)
FELT_DB, FAR_DB = 1.6, 6.0
"""A change of 20 % in amplitude is felt (Weber fraction of the Pacinian channel, 10 to 20 % for fine differences)."""

_LEVEL_LIMITS = f"up to {FELT_DB:g} dB", f"above {FAR_DB:g} dB"

FREQUENCIES_HZ = (20, 50, 100, 150, 200, 250, 300, 350, 400, 600, 800)
AMPLITUDES_UM = (40, 35, 30, 25, 20, 15, 10, 5)
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


def _shifts(scope: Scope) -> list[Trial]:
    actuators = [dataclasses.replace(LRA, quality=quality) for quality in QUALITIES] + [VOICE_COIL]
    return [
        Trial(
            f"{actuator.name} of {actuator.corner_hz:g} Hz",
            f"Q {actuator.quality:g}",
            partial(measure_shift, actuator, shift),
            value=float(shift),
        )
        for actuator in actuators
        for shift in scope.some(SHIFTS_PERCENT, 5)
    ]


def _sines(scope: Scope) -> list[Trial]:
    return [
        Trial(
            PIEZO_STACK.name + (", compensated" if compensation else ", not compensated"),
            f"{amplitude_um} µm",
            partial(measure_sine, PIEZO_STACK, frequency_hz, amplitude_um, compensation),
            value=float(frequency_hz),
        )
        for compensation in (True, False)
        for amplitude_um in scope.some(AMPLITUDES_UM, 5)
        for frequency_hz in scope.some(FREQUENCIES_HZ, 5)
    ]


def _shift_message(cells: Sequence[Verdict]) -> str:
    """Return the actuators that bear each shift, by their Q."""
    borne: dict[float, list[str]] = {}
    for case in dict.fromkeys(cell.case for cell in cells):
        shifts = maps.sound_values([cell for cell in cells if cell.case == case])
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
    conditions=_shifts,
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
    conditions=_sines,
    message=_sine_message,
    place=lambda cell: Place(cell.case, cell.value or 0.0, cell.method.partition(", ")[2]),
    caption="frequency, Hz; error in dB",
    label=figure("error_db"),
    value_name="frequency_hz",
    varied="{} Hz",
)
MAPS = (HAND_SPEED, RESONANCE, VOLTAGE)
