"""The band worth coding: the frequencies that the actuator can render and a finger may feel."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.codec.threshold import MAX_HZ, over_threshold_db, threshold_amplitude
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ
from vibrocast.errors import InputError
from vibrocast.host.playback import displacement_um
from vibrocast.output.actuator import Actuator, analog_response, followed_gain
from vibrocast.textures import Profile, Recording

Samples = NDArray[np.float64]

MARGIN_DB = -8.0
"""Level re the detection threshold from which a component is worth coding. In the listening test of the DCT paper on
material-like textures, nobody noticed on wood that components below b0 = -8 dB were missing (sandpaper -4, leather +4).
b0 = 0, the threshold itself, was noticed. The strictest of the three values holds for all."""
PASS_BAND = 0.91
"""Part of half the stream's rate in which textures.resample keeps the level."""
PROFILE_PASS_BAND = 0.68
"""Part of half the rate of a profile over position that controllers render (vibrocast/profile.h)."""
RATE_STEP = MIN_RATE_HZ = 100
"""Step between rates of streams, and the lowest rate that controllers play."""
SPEEDS = 5
"""Number of hand speeds, from the lowest to the highest, whose bands a profile over position joins."""
LOW_CUT_ORDER = 4
SLOWEST_MM_S = 10.0
"""A slower hand explores no texture: the finest parts of a profile are not coded for it."""


@dataclass(frozen=True)
class Level:
    """One third octave of a texture at the skin, in dB re the detection threshold.

    `level_db`: of the loudest block and channel. `reach_db`: the highest level that the actuator reaches there.
    """

    frequency_hz: float
    level_db: float
    reach_db: float

    @property
    def worth(self) -> bool:
        """Whether it may be felt, and the actuator can make it."""
        return min(self.level_db, self.reach_db) >= MARGIN_DB


@dataclass(frozen=True)
class Band:
    """The band worth coding of one texture.

    `lowest`, `highest`: in Hz, or in periods per metre over position. `rate`: of the stream that follows from it, in
    samples per second, or per metre.
    """

    lowest: float
    highest: float
    rate: int


def band_of(
    loaded: Recording | Profile,
    actuator: Actuator,
    threshold: Samples,
    hand_speed_mm_s: tuple[float, float],
    over_position: bool,
) -> Band:
    """Return the band worth coding. `threshold`: rows as of codec.threshold.read_threshold. Raises InputError."""
    if not isinstance(loaded, Profile):
        if loaded.rate_hz < MIN_RATE_HZ:
            raise InputError(
                f"{loaded.name}: recorded at {loaded.rate_hz:g} Hz, but controllers play at least {MIN_RATE_HZ} Hz; "
                "record faster"
            )
        lowest, highest = _edges(levels_of(loaded, actuator, threshold), loaded.name)
        return Band(lowest, highest, _rate(highest, loaded.rate_hz))
    if not over_position:
        return band_of(loaded.recording(hand_speed_mm_s[1]), actuator, threshold, hand_speed_mm_s, False)
    edges = []
    for speed_mm_s in np.geomspace(slowest_mm_s(hand_speed_mm_s), hand_speed_mm_s[1], SPEEDS):
        levels = levels_of(_within_reach(loaded.recording(speed_mm_s)), actuator, threshold)
        if any(level.worth for level in levels):
            lowest, highest = _edges(levels, loaded.name)
            edges.append((round(1000 * lowest / speed_mm_s, 2), round(1000 * highest / speed_mm_s, 2)))
    if not edges:
        raise _nothing(levels, loaded.name)
    highest = max(high for _, high in edges)
    recorded = min(1e6 / loaded.spacing_um, MAX_RATE_HZ)
    return Band(min(low for low, _ in edges), highest, _rate(highest, recorded, PROFILE_PASS_BAND))


def slowest_mm_s(hand_speed_mm_s: tuple[float, float]) -> float:
    """Return the lowest speed at which a hand still explores."""
    return min(max(hand_speed_mm_s[0], SLOWEST_MM_S), hand_speed_mm_s[1])


def levels_of(recording: Recording, actuator: Actuator, threshold: Samples) -> tuple[Level, ...]:
    """Return a recording's third octaves at the skin, each of its loudest channel."""
    frequencies_hz, felt_db = over_threshold_db(at_the_skin(recording, actuator), recording.rate_hz, threshold)
    reach_um = max_um(actuator, frequencies_hz)
    reach_db = 20 * np.log10(reach_um / threshold_amplitude(threshold, frequencies_hz, "um"))
    return tuple(
        Level(float(f), float(level), float(reach))
        for f, level, reach in zip(frequencies_hz, felt_db, reach_db, strict=True)
    )


def at_the_skin(recording: Recording, actuator: Actuator) -> Samples:
    """Return the displacement at the skin, um (n, channels), without a delay and without limits.

    It is the recording's displacement (host.playback.displacement_um), times the gain of compensation, DAC, whose
    output is constant over a sample, and actuator.
    """
    displacement = displacement_um(recording.samples, recording.unit, recording.rate_hz, actuator)
    samples = len(displacement)
    frequencies_hz = np.asarray(np.fft.rfftfreq(samples, 1 / recording.rate_hz), np.float64)
    passed = frequencies_hz < actuator.dac_rate_hz / 2
    gain = np.zeros(len(frequencies_hz))
    gain[passed] = followed_gain(frequencies_hz[passed], actuator)
    return np.asarray(np.fft.irfft(np.fft.rfft(displacement, axis=0) * gain[:, None], samples, axis=0))


def max_um(actuator: Actuator, frequencies_hz: Samples) -> Samples:
    """Return the amplitude of the largest sine that the actuator makes within its stroke, voltage, slew and power."""
    full_volts = actuator.volts / 2
    with np.errstate(divide="ignore"):
        by_slew = actuator.slew_volts_per_second / (2 * math.pi * frequencies_hz * full_volts)
    constant = min(1.0, actuator.volts_limit / full_volts, math.sqrt(2 * actuator.power_limit))
    drive = np.minimum(constant, by_slew)
    passed = frequencies_hz < actuator.dac_rate_hz / 2
    response = np.abs(analog_response(frequencies_hz, actuator.corner_hz, actuator.quality))
    held = np.sinc(frequencies_hz / actuator.dac_rate_hz)  # the DAC holds each sample
    reached: Samples = np.maximum(actuator.excursion_um * drive * response * held * passed, 1e-30)
    return reached


def error_over_threshold_db(reference: Recording, decoded: Samples, actuator: Actuator, threshold: Samples) -> float:
    """Return the level of the error at the skin in its loudest third octave, dB re what is felt.

    That is the detection threshold or, where it is higher, what the reference masks (codec/data/masking.csv).
    """
    error = Recording(reference.samples - decoded, reference.rate_hz, reference.unit, reference.name)
    masker_um = at_the_skin(reference, actuator)
    return float(np.max(over_threshold_db(at_the_skin(error, actuator), reference.rate_hz, threshold, masker_um)[1]))


def prepared(
    loaded: Recording | Profile, hand_speed_mm_s: float, over_position: bool, rate: int, lowest: float
) -> Recording:
    """Return a texture at the stream's rate, without the signal below its band. Raises TextureError.

    Resampling removes the signal above the band. Below `lowest`, a Butterworth high-pass of order LOW_CUT_ORDER runs in
    both directions, without delay. Its corner (-6 dB) lies an octave lower, so it takes 0.03 dB at `lowest`; 0 = no
    high-pass. The rate of a profile over position is per metre.
    """
    from scipy import signal

    if isinstance(loaded, Profile):
        # At 1000 mm/s, a metre takes a second, so that rates per metre are rates in hertz.
        loaded = loaded.recording(1000.0 if over_position else hand_speed_mm_s)
    recording = textures.resample(loaded, rate)
    if lowest <= 0:
        return recording
    sections = signal.butter(LOW_CUT_ORDER, lowest / 2, "highpass", fs=rate, output="sos")
    longest = len(recording.samples) - 1
    cut = signal.sosfiltfilt(sections, recording.samples, axis=0, padlen=min(longest, 3 * (2 * LOW_CUT_ORDER + 1)))
    return Recording(np.ascontiguousarray(cut), recording.rate_hz, recording.unit, recording.name)


def _edges(levels: tuple[Level, ...], name: str) -> tuple[float, float]:
    """Return the outer edges of the third octaves worth coding; 0 Hz if the lowest third octave is one of them."""
    worth = [level.frequency_hz for level in levels if level.worth]
    if not worth:
        raise _nothing(levels, name)
    edge = 2 ** (1 / 6)
    lowest = 0.0 if worth[0] == levels[0].frequency_hz else worth[0] / edge
    return round(lowest, 2), round(worth[-1] * edge, 2)


def _nothing(levels: tuple[Level, ...], name: str) -> InputError:
    best = max(levels, key=lambda level: min(level.level_db, level.reach_db))
    source = "the actuator's reach" if best.reach_db < best.level_db else "the texture"
    return InputError(
        f"{name}: no part of it can be felt: at best, {source} lies {-min(best.level_db, best.reach_db):.0f} dB below "
        f"the detection threshold, at {best.frequency_hz:.0f} Hz; check unit and full_scale, or give another actuator"
    )


def _rate(highest: float, recorded: float, pass_band: float = PASS_BAND) -> int:
    """Return the rate of a stream: a multiple of RATE_STEP, at most the recording's rate."""
    needed = math.ceil(2 * highest / pass_band / RATE_STEP) * RATE_STEP
    return max(1, min(needed, math.floor(recorded)))


def _within_reach(recording: Recording) -> Recording:
    """Return a recording at a rate that holds MAX_HZ, so that a profile of a whole surface has few samples."""
    rate_hz = 2 * MAX_HZ / PASS_BAND
    return textures.resample(recording, rate_hz) if recording.rate_hz > rate_hz else recording
