"""A simulated observer, for tests of a study and for planning its size. It is not a person.

It stands on textbook properties of touch: channels with detection thresholds, just noticeable differences that grow
with the level, and internal noise. Numbers marked "assumed" have no source; settings replace them all.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.threshold import MAX_HZ, band_parts, read_threshold, threshold_amplitude
from vibrocast.host.study.methods import PRACTICE, QUALITIES
from vibrocast.host.study.trials import Choices, Sliders, Trial

Samples = NDArray[np.float64]

FRAME_S = 0.2
"""The skin sums vibration over about this time: Verrillo, "Temporal summation in vibrotactile sensitivity", JASA 37,
1965."""
BANDS_HZ = (10.0, MAX_HZ)
BANDS_PER_OCTAVE = 1.5
"""Assumed: bands as wide as the skin tells apart side by side; critical bands of touch are about this wide or wider
(Makous, Friedman and Vierck, "A critical band filter in touch", Journal of Neuroscience 15(4), 1995)."""


@dataclass(frozen=True)
class ObserverSettings:
    """Properties of the observers.

    Attributes:
        weber_db: Least difference in level that one band tells, in dB: 20 % of amplitude, in the middle of the 10 to
            41 % that studies find (Craig, "Difference threshold for intensity of tactile stimuli", Perception &
            Psychophysics 11, 1972).
        threshold_spread_db: Standard deviation of detection thresholds between people, in dB. Assumed.
        noise: Standard deviation of the internal noise, in just noticeable differences: 1 by their definition.
        criterion_spread: Standard deviation of criteria between people, relative. Assumed.
        lapse_rate: Part of answers that are guesses: 0 to 5 % (Wichmann and Hill, Perception & Psychophysics 63,
            2001).
    """

    weber_db: float = 1.6
    threshold_spread_db: float = 3.0
    noise: float = 1.0
    criterion_spread: float = 0.25
    lapse_rate: float = 0.02


GRADE_CRITERIA = (1.0, 2.0, 3.0)
"""Distances, in just noticeable differences, from which on the grades 1, 2 and 3 are given. Assumed."""
QUALITY_PER_DISTANCE = 12.0
"""How far a slider from 0 to 100 falls for each just noticeable difference. Assumed."""


@dataclass(frozen=True)
class Skin:
    """The displacement at the skin: float64 (n, channels) in um, at a rate."""

    displacement_um: Samples
    rate_hz: float


class Observer:
    """One simulated observer; the same numbers give the same answers.

    `participant` draws its thresholds and criteria; each trial draws its noise from the trial's number.
    """

    def __init__(self, seed: int, participant: int, settings: ObserverSettings | None = None) -> None:
        self._settings = settings or ObserverSettings()
        self._seeds = [seed, participant]
        random = np.random.default_rng([*self._seeds, 0])
        self._threshold_db = float(self._settings.threshold_spread_db * random.standard_normal())
        self._bias = math.exp(float(self._settings.criterion_spread * random.standard_normal()))
        self._excitations: dict[int, Samples] = {}

    def answer(self, method: str, trial: Trial, skins: Mapping[str, Skin | None]) -> tuple[int, ...]:
        """Return the answer to a trial from the skin of each label; None = silence."""
        kind = 1 if trial.phase == PRACTICE else 2
        random = np.random.default_rng([*self._seeds, kind, trial.number])
        response = trial.response
        if random.random() < self._settings.lapse_rate:
            return _guess(response, random)
        felt = {label: None if skin is None else self._excitation(skin) for label, skin in skins.items()}
        if isinstance(response, Sliders):
            return tuple(self._quality(felt["Reference"], felt[label], random) for label in response.labels)
        labels = [each.label for each in trial.intervals]
        return (self._choice(method, labels, felt, random),)

    def _choice(
        self, method: str, labels: list[str], felt: Mapping[str, Samples | None], random: np.random.Generator
    ) -> int:
        if method == "degradation":
            distance = self._noisy(self._distance(felt[labels[0]], felt[labels[1]]), random)
            return int(np.searchsorted(np.array(GRADE_CRITERIA) * self._bias, distance, side="right"))
        if method == "same_different":
            return int(self._noisy(self._distance(felt["1"], felt["2"]), random) >= self._bias * GRADE_CRITERIA[0])
        if method == "abx":
            to_a, to_b = (self._noisy(self._distance(felt["X"], felt[label]), random) for label in "AB")
            return int(to_b < to_a)
        if method == "staircase":
            heard = [self._noisy(self._detected(felt[label]), random) for label in labels]
            return int(heard[1] > heard[0])
        # Without a reference at hand, the rougher one counts as distorted, and the smoother one is preferred.
        heard = [self._noisy(_roughness(felt[label]), random) for label in labels]
        more = int(heard[1] > heard[0])
        return more if method == "two_alternative" else 1 - more

    def _quality(self, reference: Samples | None, other: Samples | None, random: np.random.Generator) -> int:
        distance = self._noisy(self._distance(reference, other), random) / self._bias
        return int(np.clip(round(100 - QUALITY_PER_DISTANCE * max(0.0, distance)), 0, 20 * len(QUALITIES)))

    def _noisy(self, distance: float, random: np.random.Generator) -> float:
        return distance + self._settings.noise * float(random.standard_normal())

    def _excitation(self, skin: Skin) -> Samples:
        """Return levels (frames, bands) in dB over the observer's detection threshold, at least 0."""
        key = id(skin)
        if key not in self._excitations:
            self._excitations[key] = excitation_db(skin, self._threshold_db)
        return self._excitations[key]

    def _distance(self, one: Samples | None, other: Samples | None) -> float:
        """Return how far two stimuli differ, in just noticeable differences.

        Levels over threshold differ in each band. The mean over time of a band's difference, over its just noticeable
        one, combines over bands as independent observations do: the root of the sum of squares (Green and Swets,
        Signal Detection Theory and Psychophysics, 1966, chapter 9). A part that is under the threshold in both, or
        masked by the noise of a neighbour in both, does not count.
        """
        if one is None or other is None:
            return self._detected(one if other is None else other)
        frames = min(len(one), len(other))
        average = [10 * np.log10(np.mean(10 ** (each[:frames] / 10), axis=0)) for each in (one, other)]
        differences = (average[0] - average[1]) / self._settings.weber_db
        return float(np.sqrt(np.sum(np.square(differences))))

    def _detected(self, one: Samples | None) -> float:
        """Return how far a stimulus lies over the threshold, in just noticeable differences."""
        if one is None or one.size == 0:
            return 0.0
        loudest = np.max(10 * np.log10(np.mean(10 ** (one / 10), axis=0)))
        return float(loudest / self._settings.weber_db)


def excitation_db(skin: Skin, threshold_db: float = 0.0) -> Samples:
    """Return the level of each band in each frame, (frames, bands), as 10 log10(1 + power over that at threshold).

    So a band far over the threshold has its level over it, and one far under it has 0. Hann windows of FRAME_S overlap
    by half. `threshold_db`: by which a person's thresholds are higher. Of several channels the strongest counts.
    """
    block = max(8, round(FRAME_S * skin.rate_hz))
    signal = np.pad(skin.displacement_um, ((0, max(0, block - len(skin.displacement_um))), (0, 0)))
    window = np.hanning(block + 1)[:-1]
    frames = np.lib.stride_tricks.sliding_window_view(signal, block, axis=0)[:: block // 2]
    power = 2 * np.abs(np.fft.rfft(frames * window, axis=-1)) ** 2 / (block * np.sum(window**2))
    spacing_hz = skin.rate_hz / block
    highest_hz = min(BANDS_HZ[1], skin.rate_hz / 2)
    count = math.floor(BANDS_PER_OCTAVE * math.log2(highest_hz / BANDS_HZ[0]))
    edges_hz = BANDS_HZ[0] * 2 ** (np.arange(count + 1) / BANDS_PER_OCTAVE)
    bins_hz = np.maximum(spacing_hz * np.arange(power.shape[-1]), spacing_hz)
    threshold = threshold_amplitude(read_threshold(), bins_hz, "um") ** 2 / 2 * 10 ** (threshold_db / 10)
    parts = band_parts(power.shape[-1], spacing_hz, edges_hz[:-1], edges_hz[1:])
    over = np.max(power / threshold, axis=1) @ parts
    return np.asarray(10 * np.log10(1 + over))


def _roughness(one: Samples | None) -> float:
    """Return the mean level over bands and frames, in dB; 0 for silence."""
    return 0.0 if one is None or one.size == 0 else float(np.mean(one))


def _guess(response: Choices | Sliders, random: np.random.Generator) -> tuple[int, ...]:
    if isinstance(response, Choices):
        return (int(random.integers(len(response.options))),)
    return tuple(int(random.integers(response.low, response.high + 1)) for _ in response.labels)
