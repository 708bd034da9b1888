"""Actuators and their amplifiers: response from DAC code to displacement at the skin, its inverse, and their limits."""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Samples: TypeAlias = NDArray[np.float64]
Codes: TypeAlias = NDArray[np.int16]
Filter: TypeAlias = tuple[Samples, Samples]

# Fingers feel textures up to 400 Hz, and little above 800 Hz, where the Pacinian band ends; a boost there is wasted.
COMPENSATED_HZ = 400.0
# The skin moves between the DAC's samples too. Samples at the DAC's rate alone fold the hold's images into the band:
# PIEZO_STACK would seem 0.51 dB too loud at 400 Hz. At this rate it is 0.03 dB.
SKIN_OVERSAMPLING = 4

FOLLOWED_DB = 1.0
"""An actuator follows where its displacement is this near to the one asked for; touch distinguishes 1 to 2 dB."""

OCTAVES_HZ = (31.5, 63.0, 125.0, 250.0, 500.0)
"""The middles of the octaves that touch feels best (IEC 61260-1)."""

MAX_DIFFERENCE = 0.25
"""Of an actuator's frequency and stroke from its data sheet; more is another actuator, or a broken one."""
MIN_FULL_SCALE_VOLTS, MAX_FULL_SCALE_VOLTS = 0.001, 1000.0
"""From a headphone jack at a low volume to a piezo amplifier."""


@dataclass(frozen=True)
class Actuator:
    """A linear actuator with its amplifier and DAC. It rests in the middle of its range at DAC code 0.

    Attributes:
        name: A name for people.
        stroke_um: Displacement from end to end in um. A resonant actuator reaches it at `corner_hz`.
        volts: Voltage range of the full DAC scale, peak to peak. A unipolar actuator rests on a bias of half of it.
        corner_hz: Without `quality`, the -3 dB frequency of a first-order low-pass. With it, the resonance of a
            second-order one. In Hz.
        quality: Q of the resonance; None for a first-order low-pass.
        slew_volts_per_second: Highest slew of the drive voltage.
        volts_limit: Highest drive voltage from rest.
        power_limit: Highest mean of the squared drive over any second, where full scale is 1.
        dac_bits: Bits of the DAC.
        dac_rate_hz: Sample rate of the DAC in Hz.
        maximum_boost: Highest factor by which the compensation of a resonance raises the drive.
    """

    name: str
    stroke_um: float
    volts: float
    corner_hz: float
    quality: float | None
    slew_volts_per_second: float
    volts_limit: float
    power_limit: float
    dac_bits: int = 16
    dac_rate_hz: int = 3000
    maximum_boost: float = 8.0

    def with_full_scale(self, volts: float) -> "Actuator":
        """Return this actuator behind an amplifier that gives it these volts, from rest, at full drive.

        The actuator is linear: its stroke grows with the voltage, and the mean square of the drive at its power limit
        falls with the square. The limits in volts stay. `volts` is positive.
        """
        factor = volts / (self.volts / 2)
        return replace(
            self,
            stroke_um=self.stroke_um * factor,
            volts=2 * volts,
            power_limit=min(1.0, self.power_limit / factor**2),
        )

    @property
    def excursion_um(self) -> float:
        """The displacement from rest at full drive, in um."""
        return self.stroke_um / 2

    @property
    def full_scale(self) -> int:
        """The DAC codes from rest to full drive."""
        return 1 << (self.dac_bits - 1)

    @property
    def code_limit(self) -> int:
        """The highest DAC code that the voltage limit allows."""
        return min(self.full_scale - 1, math.floor(self.volts_limit / (self.volts / 2) * self.full_scale))

    @property
    def code_step_limit(self) -> int:
        """The largest step between two DAC codes in sequence that the slew limit allows."""
        step = math.floor(self.slew_volts_per_second / self.dac_rate_hz / (self.volts / 2) * self.full_scale)
        return max(1, step)

    @property
    def band_hz(self) -> tuple[float, float]:
        """The lower and upper -3 dB frequencies in Hz; the lower one is 0 without a resonance."""
        if self.quality is None:
            return 0.0, self.corner_hz
        half_width = 1 / (2 * self.quality)
        middle = math.hypot(1.0, half_width)
        return self.corner_hz * (middle - half_width), self.corner_hz * (middle + half_width)

    def response(self, rate_hz: float) -> Filter:
        """Return (b, a): the digital filter from drive to displacement, both in parts of full scale.

        Exact at the sampling instants for a drive held constant over each 1 / rate_hz (zero-order hold).
        First order: w / (s + w). Resonance: (w^2 / Q) / (s^2 + w s / Q + w^2), which is 1 at w = 2 pi corner_hz.
        """
        from scipy import signal

        w = 2 * math.pi * self.corner_hz
        if self.quality is None:
            b, a = np.array([w]), np.array([1.0, w])
        else:
            b, a = np.array([w * w / self.quality]), np.array([1.0, w / self.quality, w * w])
        numerator, denominator, _ = signal.cont2discrete((b, a), 1 / rate_hz, method="zoh")
        return np.ravel(numerator), np.asarray(denominator)

    def inverse(self) -> Filter:
        """Return (b, a): the compensation filter at the DAC's rate.

        First order: the exact inverse of `response`, one DAC sample late, times a second-order low-pass, whose Q makes
        up for the DAC's hold (`_low_pass`). With it, the displacement follows up to 400 Hz within 0.07 dB, between the
        sampling instants too; below 2 kHz, up to a fifth of the DAC's rate. PIEZO_STACK follows within 0.06 dB.
        Including phase, it follows within 3.2 % of the amplitude, 1.7 DAC samples late. The boost is at most 2.31; the
        inverse alone reaches 3.63.

        Resonance: the filter is (Q / Q') (s^2 + w s / Q + w^2) / (s^2 + w s / Q' + w^2), by the bilinear transform
        matched at w. Q' = Q / maximum_boost makes the resonance `maximum_boost` times as broad. The gain is 1 at w, and
        at most the boost elsewhere. The gain of a plain inverse would grow with the square of the frequency.
        """
        from scipy import signal

        if self.quality is None:
            numerator, denominator = self.response(self.dac_rate_hz)
            tangent, quality = self._low_pass()
            b, a = signal.bilinear([tangent**2], [1, tangent / quality, tangent**2], fs=0.5)
            return np.convolve(denominator / numerator[1], b), np.asarray(a)
        # w in units of 2 x rate, pre-warped so that the bilinear transform keeps the resonance in place.
        w = math.tan(math.pi * self.corner_hz / self.dac_rate_hz)
        boost = max(1.0, self.maximum_boost)
        broad = self.quality / boost
        b, a = signal.bilinear([boost, boost * w / self.quality, boost * w * w], [1, w / broad, w * w], fs=0.5)
        return np.asarray(b), np.asarray(a)

    def inverse_section(self) -> tuple[float, float, tuple[float, float, float, float]]:
        """Return `inverse` as a state variable filter: g = tan(pi corner / rate), Q, and the weights of its outputs.

        The outputs are high-pass, band-pass s / (s^2 + s / Q + 1), low-pass, and the band-pass one sample before. The
        first-order response's inverse is (1 - p / z) / (1 - p) = 1 + p / (1 - p) (1 - 1 / z). A low-pass grows by g
        (band-pass + band-pass one sample before) from sample to sample.
        """
        if self.quality is None:
            tangent, quality = self._low_pass()
            decay = 2 * math.pi * self.corner_hz / self.dac_rate_hz
            growth = tangent * math.exp(-decay) / -math.expm1(-decay)
            return tangent, quality, (0.0, growth, 1.0, growth)
        boost = max(1.0, self.maximum_boost)
        tangent = math.tan(math.pi * self.corner_hz / self.dac_rate_hz)
        return tangent, self.quality / boost, (boost, boost / self.quality, boost, 0.0)

    @property
    def low_pass_delay_seconds(self) -> float:
        """Delay at low frequencies of the low-pass in `inverse`; 0 for a resonance, which has no low-pass.

        It is 1 / (2 Q g) samples, that of 1 / (s^2 + s / Q + 1), bilinear with g = tan(pi corner / rate).
        """
        if self.quality is not None:
            return 0.0
        tangent, quality = self._low_pass()
        return 1 / (2 * quality * tangent * self.dac_rate_hz)

    def _low_pass(self) -> tuple[float, float]:
        """Return g = tan(pi corner / rate) and Q of the low-pass in `inverse`: 1 / (s^2 + s / Q + 1), bilinear.

        g is twice tan(pi f / rate) at the edge of the band, f = COMPENSATED_HZ or a fifth of the rate. There s = j / 2,
        and the squared gain is 1 / (9/16 + 1 / (4 Q^2)). Q makes it cancel the squared gain of all the rest there:
        - the hold, sinc(f / rate)^2;
        - the analog response, 1 / (1 + (f / corner_hz)^2);
        - its inverse at the sampling instants, |1 - p / z|^2 / (1 - p)^2 = 1 + 4 p sin(pi f / rate)^2 / (1 - p)^2.
        For any corner and rate, Q lies between 0.75 and 1.11.
        """
        edge_hz = min(COMPENSATED_HZ, self.dac_rate_hz / 5)
        angle = math.pi * edge_hz / self.dac_rate_hz
        decay = 2 * math.pi * self.corner_hz / self.dac_rate_hz
        hold = (math.sin(angle) / angle) ** 2
        response = 1 / (1 + (edge_hz / self.corner_hz) ** 2)
        inverse = 1 + math.exp(-decay) * (2 * math.sin(angle) / math.expm1(-decay)) ** 2
        return 2 * math.tan(angle), 1 / (2 * math.sqrt(hold * response * inverse - 9 / 16))

    def displacement_um(self, codes: Codes, oversampling: int = 1) -> Samples:
        """Return the displacement at the skin, um from rest, for DAC codes (n, channels) that begin at rest.

        The result (n * oversampling, channels) has `oversampling` samples per DAC sample; the code is held between
        them.
        """
        from scipy import signal

        held = np.repeat(codes / self.full_scale, oversampling, axis=0)
        b, a = self.response(self.dac_rate_hz * oversampling)
        return self.excursion_um * np.asarray(signal.lfilter(b, a, held, axis=0))


def resonant(
    name: str, corner_hz: float, quality: float, stroke_um: float, volts: float, dac_rate_hz: int = 8000
) -> Actuator:
    """Return a resonant actuator, an LRA or a voice coil, by its resonance, Q, stroke and voltage range (peak to peak).

    The mean power limit is a fifth of full drive, because a coil heats up. The slew limit allows a sine of full scale
    up to 1 kHz.
    """
    slew_volts_per_second = 2 * math.pi * 1000 * volts / 2
    return Actuator(
        name, stroke_um, volts, corner_hz, quality, slew_volts_per_second, volts / 2, 0.2, dac_rate_hz=dac_rate_hz
    )


# The piezo stack of the DCT paper on material-like textures: 80 um at 150 V, linear, -3 dB at 270 Hz, no resonance up
# to 400 Hz, driven at 3 kHz. Full scale at 400 Hz needs 190 kV/s; the amplifier is assumed to allow 300 kV/s. A sine of
# full scale has a mean square of 0.5 and passes the power limit; a square wave does not.
PIEZO_STACK = Actuator(
    name="piezo-stack",
    stroke_um=80.0,
    volts=150.0,
    corner_hz=270.0,
    quality=None,
    slew_volts_per_second=300_000.0,
    volts_limit=75.0,
    power_limit=0.65,
)

# Typical values; replace them by those of your part: LRA 150-235 Hz, Q 10-20; voice coil 60-125 Hz, Q 2-5.
LRA = resonant("lra", corner_hz=175.0, quality=15.0, stroke_um=200.0, volts=5.6)
VOICE_COIL = resonant("voice-coil", corner_hz=90.0, quality=3.0, stroke_um=400.0, volts=8.0)

ACTUATORS = {actuator.name: actuator for actuator in (PIEZO_STACK, LRA, VOICE_COIL)}


def analog_response(frequencies_hz: Samples, corner_hz: float, quality: float | None) -> NDArray[np.complex128]:
    """Return the response from drive to displacement, in parts of full scale, as of `Actuator.response`."""
    s = 1j * frequencies_hz / corner_hz
    return np.asarray(1 / (1 + s) if quality is None else (1 / quality) / (1 + s / quality + s * s), np.complex128)


def actuator_differences(expected: Actuator, found: Actuator) -> list[str]:
    """Return how two actuators differ by more than MAX_DIFFERENCE, in words: order, frequency, stroke per volt."""
    if (expected.quality is None) != (found.quality is None):
        kinds = ["a low-pass" if each.quality is None else "a resonance" for each in (found, expected)]
        return [f"{kinds[0]} instead of {kinds[1]}"]
    figures = {
        "Hz": (found.corner_hz, expected.corner_hz),
        "um/V": (found.stroke_um / found.volts, expected.stroke_um / expected.volts),
    }
    return [
        f"{found_value:.4g} instead of {expected_value:.4g} {unit}"
        for unit, (found_value, expected_value) in figures.items()
        if abs(found_value / expected_value - 1) > MAX_DIFFERENCE
    ]


def followed_gain(frequency_hz: Samples, driven: Actuator, skin: Actuator | None = None) -> Samples:
    """Return the amplitude of the displacement over the one asked for, at each frequency: (n,).

    No limit acts. The gain is the product of the compensation of `driven`, of the DAC's hold, and of the response of
    `skin`. The hold is sin(pi f / rate) / (pi f / rate). `driven`: the actuator by which the controller works. `skin`:
    the one that moves; None = the same.
    """
    from scipy import signal

    skin = skin or driven
    _, inverse = signal.freqz(*driven.inverse(), worN=frequency_hz, fs=driven.dac_rate_hz)
    hold = np.sinc(frequency_hz / driven.dac_rate_hz)
    ratio = 1j * frequency_hz / skin.corner_hz
    resonance = 0.0 if skin.quality is None else skin.quality * (1 + ratio**2) - 1
    response = 1 / (1 + ratio + resonance)
    gain: Samples = np.abs(inverse * hold * response) * skin.excursion_um / driven.excursion_um
    return gain


def followed_band_hz(driven: Actuator, skin: Actuator | None = None) -> tuple[float, float] | None:
    """Return the widest band from 20 to 1000 Hz in which the displacement is within 1 dB of the one asked for.

    The actuators as in `followed_gain`. None where there is no such band.
    """
    frequency_hz = np.geomspace(20.0, min(1000.0, 0.45 * driven.dac_rate_hz), 400)
    follows = np.abs(20 * np.log10(followed_gain(frequency_hz, driven, skin))) <= FOLLOWED_DB
    edges = np.flatnonzero(np.diff(follows, prepend=False, append=False))
    bands = [
        (float(frequency_hz[low]), float(frequency_hz[high - 1]))
        for low, high in zip(edges[::2], edges[1::2], strict=True)
    ]
    return max(bands, key=lambda band: band[1] / band[0], default=None)


def octave_gains_db(driven: Actuator, skin: Actuator | None = None) -> dict[str, float]:
    """Return `followed_gain` in dB in the middle of octaves, by the frequency in Hz as text."""
    frequency_hz = np.array([each for each in OCTAVES_HZ if each < 0.45 * driven.dac_rate_hz])
    gains_db = 20 * np.log10(followed_gain(frequency_hz, driven, skin))
    return {f"{each:g}": round(gain_db, 2) for each, gain_db in zip(frequency_hz, gains_db.tolist(), strict=True)}
