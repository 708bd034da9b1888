"""A simulated observer, for tests of a study and for planning its size. It is not a person.

It stands on textbook properties of touch: detection thresholds, just noticeable differences that grow with the level,
and internal noise. It feels how the strength of each band goes on in time. So it feels rhythm and envelope, but no fine
structure faster than its integration. Numbers marked "assumed" have no source; settings replace them.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.threshold import MAX_HZ, MIN_HZ, read_threshold, threshold_amplitude
from vibrocast.errors import InputError
from vibrocast.study.methods import PRACTICE
from vibrocast.study.trials import Choices, Sliders, Trial

Samples = NDArray[np.float64]

INTEGRATION_S = 0.01
"""Time constant of the leaky integrator of a band's power. Spike timing of afferents shapes what people feel of
vibration (Mackevicius et al., "Millisecond precision spike timing shapes tactile perception", Journal of Neuroscience
32(44), 2012). The course of the strength stands in the rates of cortical neurons (Harvey et al., "Multiplexing stimulus
information through rate and temporal codes in primate somatosensory cortex", PLoS Biology 11(5), 2013). So a mean over
the stimulus is too coarse. The value is assumed: the order of the shortest gap that people feel in a vibration."""
COURSE_RATE_HZ = 1000.0
"""Of the courses; the integrator leaves little above half of it."""
_RATE_HZ = 4 * MAX_HZ  # so that squares of bands below MAX_HZ do not alias
_LEAST_S = 0.2
_RAMP_S = 0.05  # at both ends, so that they do not click; it counts for nothing
BANDS_HZ = np.geomspace(MIN_HZ, MAX_HZ, 11)
"""Edges of ten bands, two thirds of an octave each. Assumed: bands that the skin tells apart side by side. Critical
bands of touch are about this wide or wider (Makous, Friedman and Vierck, "A critical band filter in touch", Journal of
Neuroscience 15(4), 1995). Within a band, a strong component masks a weak one; across bands, nothing is masked."""
AT_THRESHOLD_DB = 10 * math.log10(2)
"""A level of 10 log10(1 + power over that at threshold), at the detection threshold."""


@dataclass(frozen=True)
class ObserverSettings:
    """Properties of the observers.

    Attributes:
        weber_db: Just noticeable difference in level of one band, in dB. Israr, Tan and Reed measured 1.65 to 2.71 dB
            on fingerpads at 35 dB over threshold ("Frequency and amplitude discrimination along the
            kinesthetic-cutaneous continuum", JASA 120(5), 2006). The default is their middle.
        threshold_spread_db: Standard deviation of detection thresholds between people, in dB. Assumed.
        noise: Standard deviation of the internal noise of each interval, in just noticeable differences. At 1, stimuli
            one such difference apart have a d' of 1, which is 76 % correct of two alternatives.
        criterion_spread: Standard deviation of the logarithm of criteria between people. Assumed.
        lapse_rate: Part of answers that are guesses: 0 to 5 % (Wichmann and Hill, Perception & Psychophysics 63(8),
            2001).
    """

    weber_db: float = 2.2
    threshold_spread_db: float = 3.0
    noise: float = 1.0
    criterion_spread: float = 0.25
    lapse_rate: float = 0.02


GRADE_CRITERIA = (1.5, 2.5, 3.5)
"""Felt differences, in just noticeable ones, from which on the grades 1, 2 and 3 are given. Two intervals with noise of
1 each differ by 1.5 or more in 29 % of trials with the same stimulus. Assumed."""
QUALITY_PER_DIFFERENCE = 12.0
"""How far a slider from 0 to 100 falls for each just noticeable difference beyond the first criterion. Assumed."""


@dataclass(frozen=True, eq=False)
class Skin:
    """The displacement at the skin: float64 (n, channels) in um, at a rate; and how fast its course is felt."""

    displacement_um: Samples
    rate_hz: float
    integration_s: float = INTEGRATION_S

    @cached_property
    def over_threshold(self) -> Samples:
        """The power of each band over its power at the detection threshold, float64 (bands, times).

        A leaky integrator of `integration_s` follows the square of each band, with COURSE_RATE_HZ values a second. Of
        several channels the strongest counts in each band and moment. Raises InputError for values that are no finite
        numbers.
        """
        if not np.all(np.isfinite(self.displacement_um)) or not self.rate_hz > 0:
            raise InputError("the skin's displacement has values that are no numbers; check the stimulus")
        count = max(len(self.displacement_um), round(_LEAST_S * self.rate_hz))
        signal = np.zeros((count, self.displacement_um.shape[1]))
        if len(self.displacement_um):
            ramp = np.minimum(1, np.minimum(np.arange(count), np.arange(count)[::-1]) / (_RAMP_S * self.rate_hz))
            signal[: len(self.displacement_um)] = self.displacement_um - np.mean(self.displacement_um, axis=0)
            signal *= ramp[:, None]
        fine = round(count / self.rate_hz * _RATE_HZ)
        spectrum = np.zeros((fine // 2 + 1, signal.shape[1]), complex)
        own = np.fft.rfft(signal, axis=0)[: len(spectrum)] * (fine / count)
        spectrum[: len(own)] = own
        bins_hz = np.fft.rfftfreq(fine, 1 / _RATE_HZ)
        spectrum /= threshold_amplitude(read_threshold(), np.maximum(bins_hz, 1), "um")[:, None] / math.sqrt(2)
        leak = 1 / (1 + 2j * np.pi * bins_hz * self.integration_s)
        courses = []
        for low_hz, high_hz in itertools.pairwise(BANDS_HZ):
            within = (bins_hz >= low_hz) & (bins_hz < high_hz)
            band = np.fft.irfft(spectrum * within[:, None], fine, axis=0)
            power = np.fft.irfft(np.fft.rfft(band**2, axis=0) * leak[:, None], fine, axis=0)
            courses.append(np.max(power, axis=1, initial=0.0))
        ramp_samples = round(_RAMP_S * _RATE_HZ)
        return np.array(courses)[:, ramp_samples : -ramp_samples : round(_RATE_HZ / COURSE_RATE_HZ)]

    def excitation_db(self, threshold_db: float = 0.0) -> Samples:
        """Return the course of the level of each band (bands, times): 10 log10(1 + power over that at threshold).

        So a band far over the threshold has its level over it, and one far under it has 0. `threshold_db`: by which a
        person's thresholds are higher.
        """
        return np.asarray(10 * np.log10(1 + self.over_threshold * 10 ** (-threshold_db / 10)))


SILENCE = Skin(np.zeros((0, 1)), 1000.0)


class Observer:
    """One simulated observer; the same numbers give the same answers.

    `participant` draws its thresholds and criteria; each trial draws its noise from the trial's number. An interval
    is felt as its place on a line, in just noticeable differences, and noise is added to each. Macmillan and Creelman,
    Detection Theory, 2nd edition, 2005, chapters 7 and 9, derive d' from these decisions. So a study finds a d' that is
    the difference over the noise.
    """

    def __init__(self, seed: int, participant: int, settings: ObserverSettings | None = None) -> None:
        self._settings = settings or ObserverSettings()
        self._seeds = [seed, participant]
        random = np.random.default_rng([*self._seeds, 0])
        self.threshold_db = float(self._settings.threshold_spread_db * random.standard_normal())
        self._criteria = np.array(GRADE_CRITERIA) * math.exp(
            float(self._settings.criterion_spread * random.standard_normal())
        )
        self._distances: dict[tuple[Skin, Skin], float] = {}

    def answer(self, method: str, trial: Trial, skins: Mapping[str, Skin | None]) -> tuple[int, ...]:
        """Return the answer to a trial from the skin of each label; None = silence. Raises InputError."""
        kind = 1 if trial.phase == PRACTICE else 2
        random = np.random.default_rng([*self._seeds, kind, trial.number])
        if random.random() < self._settings.lapse_rate:
            return _guess(trial.response, random)
        felt = {label: SILENCE if skin is None else skin for label, skin in skins.items()}
        if isinstance(trial.response, Sliders):
            return self._qualities(trial.response, felt, random)
        return (self._choice(method, trial, felt, random),)

    def _choice(self, method: str, trial: Trial, felt: Mapping[str, Skin], random: np.random.Generator) -> int:
        labels = [each.label for each in trial.intervals]
        noise = self._settings.noise * random.standard_normal(len(labels))
        if method in ("degradation", "same_different"):
            difference = abs(self.distance(felt[labels[0]], felt[labels[1]]) + noise[1] - noise[0])
            grade = int(np.searchsorted(self._criteria, difference, side="right"))
            return grade if method == "degradation" else min(grade, 1)
        if method == "abx":
            places = np.array([self.distance(felt["A"], felt[label]) for label in labels]) + noise
            to_a, to_b = abs(places[2] - places[0]), abs(places[2] - places[1])
            return int(to_b < to_a)
        if method == "staircase":
            places = np.array([self.detectability(felt[label]) for label in labels])
        elif method == "two_alternative":
            # It knows the reference from practice, and takes the interval that lies farther from it.
            reference = felt[labels[1 - int(trial.facts["correct"] or 0)]]
            places = np.array([self.distance(reference, felt[label]) for label in labels])
        else:  # Which one it prefers: the weaker one. Assumed.
            places = np.array([-self._strength(felt[label]) for label in labels])
        return int(places[1] + noise[1] > places[0] + noise[0])

    def _qualities(self, response: Sliders, felt: Mapping[str, Skin], random: np.random.Generator) -> tuple[int, ...]:
        """Return a slider for each label. The nearest one to the reference gets all: ITU-R BS.1534-3 asks for that."""
        distances = np.array([self.distance(felt["Reference"], felt[label]) for label in response.labels])
        noise = self._settings.noise * random.standard_normal((2, len(distances)))
        beyond = np.maximum(0, np.abs(distances + noise[1] - noise[0]) - self._criteria[0])
        part = 1 - QUALITY_PER_DIFFERENCE / 100 * (beyond - np.min(beyond))
        span = response.high - response.low
        return tuple(round(response.low + span * max(0.0, float(each))) for each in part)

    def distance(self, one: Skin, other: Skin) -> float:
        """Return how far two stimuli differ, in just noticeable differences.

        Levels over threshold differ in each band and moment. The differences combine over bands as independent
        observations do: the root of the sum of squares (Green and Swets, Signal Detection Theory and Psychophysics,
        1966, chapter 9). Moments count as independent observations too, in the mean: a steady difference has the size
        of the just noticeable one, which was measured with steady vibrations. Nobody knows where
        in a texture it begins: the shift counts at which the two are most alike. A part under the threshold, or far
        under a stronger one in its band, hardly changes a level. The longer one counts as far as the shorter one lasts.
        """
        if (one, other) not in self._distances:
            a, b = one.excitation_db(self.threshold_db), other.excitation_db(self.threshold_db)
            times = min(a.shape[1], b.shape[1])
            a, b = a[:, :times], b[:, :times]
            alike = np.sum(np.fft.rfft(a) * np.conj(np.fft.rfft(b)), axis=0)
            b = np.roll(b, int(np.argmax(np.fft.irfft(alike, times))), axis=1)
            self._distances[one, other] = math.sqrt(np.sum((a - b) ** 2) / times) / self._settings.weber_db
        return self._distances[one, other]

    def detectability(self, one: Skin) -> float:
        """Return how far a stimulus lies over nothing: 1 at the detection threshold.

        That is d' with noise of 1: 76 % correct of two alternatives, as thresholds are measured. The power of all bands
        adds up, as in the Pacinian channel (Bensmaia, Hollins and Yau, Perception & Psychophysics 67(5), 2005).
        """
        power = float(np.sum(np.mean(one.over_threshold, axis=1))) * 10 ** (-self.threshold_db / 10)
        return 10 * math.log10(1 + power) / AT_THRESHOLD_DB

    def _strength(self, one: Skin) -> float:
        """Return the mean level over bands and time, in just noticeable differences."""
        return float(np.mean(one.excitation_db(self.threshold_db)) / self._settings.weber_db)


def _guess(response: Choices | Sliders, random: np.random.Generator) -> tuple[int, ...]:
    if isinstance(response, Choices):
        return (int(random.integers(len(response.options))),)
    return tuple(int(random.integers(response.low, response.high + 1)) for _ in response.labels)
