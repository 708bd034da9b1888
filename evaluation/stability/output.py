"""The hand and the actuator: other speeds, a shifted resonance, compensation beyond the amplifier's limits."""

import dataclasses
import math

import numpy as np
import scipy
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.evaluation.stability.maps import Map, Row, at_level
from vibrocast.evaluation.stability.signals import ENOUGH_SNR_DB, FAILED_SNR_DB, RATE_HZ, Signal, decoded
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
from vibrocast.output.actuator import LRA, PIEZO_STACK, SKIN_OVERSAMPLING, VOICE_COIL, Actuator, Samples
from vibrocast.output.rendering import render
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


def measure_speed(trial: Trial) -> Measured:
    """Code a surface at CODED_MM_S, play it faster or slower, and grade FELT_HZ at that speed.

    A height z(x) at the place x is played at the time x / speed: its spatial frequency k becomes speed * k. So SNR
    within the band at any speed is a sum over a part of the same spectra. Raises CodecError.
    """
    speed_mm_s = trial.value
    samples = SURFACES[trial.case](0, SECONDS, CODED_MM_S, RATE_HZ).samples
    samples = samples - samples.mean()
    heard, _ = decoded(samples, RATE_HZ, trial.rate_point, "um")
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


HAND_SPEED = Map(
    "hand_speed",
    globals(),
    [
        Row(
            measure_speed,
            lambda scope: at_level("high", scope.methods),
            tuple(SURFACES),
            SPEEDS_MM_S,
            value_step=4,
        )
    ],
)

SHIFTS_PERCENT = (-20.0, -15.0, -10.0, -5.0, -2.0, 0.0, 2.0, 5.0, 10.0, 15.0, 20.0)
RESONANT = {
    (f"{actuator.name} of {actuator.corner_hz:g} Hz", f"Q {actuator.quality:g}"): actuator
    for actuator in (*(dataclasses.replace(LRA, quality=quality) for quality in (5.0, 15.0, 30.0)), VOICE_COIL)
}
"""Actuators by method and case."""
BAND_HZ = (40.0, 400.0)
FELT_DB, FAR_DB = 1.6, 6.0
"""A change of 20 % in amplitude is felt (Weber fraction of the Pacinian channel, 10 to 20 % for fine differences)."""

FREQUENCIES_HZ = (20.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0, 400.0, 600.0, 800.0)
AMPLITUDES_UM = {f"{amplitude_um} µm": float(amplitude_um) for amplitude_um in (40, 35, 30, 25, 20, 15, 10, 5)}
COMPENSATED = {f"{PIEZO_STACK.name}, compensated": True, f"{PIEZO_STACK.name}, not compensated": False}
SINE_S = 0.5
_RATE_HZ = 3000  # the piezo's own, so that nothing is resampled


def gain_db(actuator: Actuator, compensated_as: Actuator, frequencies_hz: Samples) -> Samples:
    """Return the gain in dB from target to real displacement, at the DAC's rate: one for each frequency."""
    gains = [
        np.abs(scipy.signal.freqz(b, a, worN=frequencies_hz, fs=actuator.dac_rate_hz)[1])
        for b, a in (actuator.response(actuator.dac_rate_hz), compensated_as.inverse())
    ]
    return np.asarray(20 * np.log10(np.maximum(gains[0] * gains[1], 1e-10)))


def measure_shift(trial: Trial) -> Measured:
    """Shift a resonance and grade the largest change of the compensated gain within BAND_HZ."""
    actuator = RESONANT[trial.method, trial.case]
    frequencies_hz = np.geomspace(*BAND_HZ, 400)
    shifted = dataclasses.replace(actuator, corner_hz=actuator.corner_hz * (1 + trial.value / 100))
    change_db = gain_db(shifted, actuator, frequencies_hz) - gain_db(actuator, actuator, frequencies_hz)
    worst = int(np.argmax(np.abs(change_db)))
    error_db = float(np.abs(change_db[worst]))
    figures = {"error_db": error_db, "worst_hz": float(frequencies_hz[worst]), "change_db": float(change_db[worst])}
    effect = f"{change_db[worst]:+z.1f} dB at {frequencies_hz[worst]:.0f} Hz"
    return graded(error_db, FELT_DB, FAR_DB, figures, effect)


def measure_sine(trial: Trial) -> Measured:
    """Play a sine of displacement and grade the amplitude of the fundamental; count the samples that were limited."""
    actuator, frequency_hz, amplitude_um = PIEZO_STACK, trial.value, AMPLITUDES_UM[trial.case]
    time_s = np.arange(round(SINE_S * _RATE_HZ)) / _RATE_HZ
    wanted = amplitude_um / actuator.excursion_um * np.sin(2 * np.pi * frequency_hz * time_s)
    decoded = np.rint(32767 * wanted).astype(np.int16).reshape(-1, 1)
    header = StreamHeader(1, _RATE_HZ, len(decoded), "um", (actuator.excursion_um,), b"")
    codes, counts = render(header, decoded, 0, actuator, compensation=COMPENSATED[trial.method])
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


RESONANCE = Map(
    "resonance",
    globals(),
    [
        Row(
            measure_shift,
            lambda scope: (Trial(*names) for names in RESONANT),
            values=SHIFTS_PERCENT,
            value_step=5,
        )
    ],
)
VOLTAGE = Map(
    "voltage_limit",
    globals(),
    [
        Row(
            measure_sine,
            lambda scope: map(Trial, COMPENSATED),
            tuple(AMPLITUDES_UM),
            FREQUENCIES_HZ,
            case_step=5,
            value_step=5,
        )
    ],
)
MAPS = (HAND_SPEED, RESONANCE, VOLTAGE)
