"""The simulated observer: its distances, its decisions, and what studies find of both."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.errors import InputError
from vibrocast.study import statistics
from vibrocast.study.methods import GRADES
from vibrocast.study.observer import Observer, ObserverSettings, Skin
from vibrocast.study.staircases import Bayesian, TransformedUpDown
from vibrocast.study.trials import Choices, Interval, Sliders, Trial
from vibrocast.textures import generate

RATE_HZ = 2800.0
SECONDS = 1.0
EVERYONE = ObserverSettings(threshold_spread_db=0, criterion_spread=0, lapse_rate=0)
"""Observers without differences between them and without lapses."""


def tone(frequency_hz: float, over_threshold_db: float, rate_hz: float = RATE_HZ) -> np.ndarray:
    """Return a sine (n, 1) in um, at a level over the detection threshold."""
    time_s = np.arange(round(SECONDS * rate_hz)) / rate_hz
    amplitude = threshold_amplitude(read_threshold(), np.array([frequency_hz]), "um") * 10 ** (over_threshold_db / 20)
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency_hz * time_s))[:, None]


def skin(*parts: np.ndarray) -> Skin:
    return Skin(np.sum(parts, axis=0), RATE_HZ)


@cache
def texture(kind: str) -> np.ndarray:
    """Return a generated texture (n, 1) in um."""
    return generate.SURFACES[kind](1, SECONDS, 50.0, RATE_HZ).samples


def trial(method: str, labels: str, number: int, correct: int | None = None) -> Trial:
    intervals = tuple(Interval("Reference" if label == "R" else label, f"wood/{label}") for label in labels)
    response: Choices | Sliders = Choices(("1", "2"))
    if method == "degradation":
        response = Choices(GRADES)
    elif method == "mushra":
        response = Sliders(tuple(each.label for each in intervals[1:]))
    return Trial(number, None, "main", 1, "wood", intervals, "?", response, facts={"correct": correct})


def observer(participant: int = 1, settings: ObserverSettings = EVERYONE) -> Observer:
    return Observer(1, participant, settings)


def grades(reference: Skin, other: Skin, count: int = 300) -> float:
    """Return the mean grade of a pair."""
    skins = {"Reference": reference, "A": other}
    return float(
        np.mean([observer().answer("degradation", trial("degradation", "RA", n), skins) for n in range(count)])
    )


# ---- what it feels ----


@pytest.mark.parametrize("frequency_hz", [20.0, 60.0, 125.0, 250.0, 400.0, 800.0])
def test_a_tone_at_its_threshold_is_just_detected(frequency_hz: float) -> None:
    assert observer().detectability(skin(tone(frequency_hz, 0))) == pytest.approx(1.0, abs=0.12)
    assert observer().detectability(skin(tone(frequency_hz, -20))) < 0.05


def test_a_difference_of_the_weber_fraction_is_one_just_noticeable_difference() -> None:
    louder = skin(tone(200, 30 + EVERYONE.weber_db))
    assert observer().distance(skin(tone(200, 30)), louder) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", ["wood", "rough", "grating"])
def test_more_noise_lies_farther_away(kind: str) -> None:
    noise = np.random.default_rng(2).standard_normal((texture(kind).shape[0], 1))
    noisy = [skin(texture(kind), level_um * noise) for level_um in (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)]
    distances = [observer().distance(noisy[0], each) for each in noisy]
    assert distances[0] == 0
    assert np.all(np.diff(distances) > 0)
    found = [grades(noisy[0], each) for each in noisy]
    assert np.all(np.diff(found) > -0.05) and found[-1] > found[0] + 1


@pytest.mark.parametrize("frequency_hz", [30.0, 250.0, 600.0])
def test_what_is_far_under_the_threshold_or_masked_does_not_count(frequency_hz: float) -> None:
    wood = texture("wood")
    assert observer().distance(skin(wood), skin(wood, tone(frequency_hz, -24))) < 0.1
    loud = tone(220, 40)
    # 35 dB under a tone of the same band, though 5 dB over the threshold. A stronger one beats with it.
    assert observer().distance(skin(loud), skin(loud, tone(240, 5))) < 0.15
    assert observer().distance(skin(loud), skin(loud, tone(240, 25))) > 0.5


def test_the_course_in_time_is_felt_and_its_beginning_is_not() -> None:
    # Clicks every 50 ms, and the same power spectrum with other phases: noise that repeats as often.
    clicks = np.zeros((2800, 1))
    clicks[::140] = 20.0
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, 1401)
    noise = np.fft.irfft(np.fft.rfft(clicks[:, 0]) * np.exp(1j * phases), 2800)[:, None]
    assert observer().distance(skin(clicks), skin(noise)) > 2
    assert observer().distance(skin(noise), skin(np.roll(noise, 60, axis=0))) < 0.5


def test_offset_silence_rate_and_a_still_channel_do_not_matter_and_what_is_no_number_is_rejected() -> None:
    still, nothing = Skin(np.full((2800, 1), 50.0), RATE_HZ), Skin(np.zeros((0, 1)), RATE_HZ)
    assert observer().detectability(still) == pytest.approx(0, abs=1e-6)
    assert observer().distance(still, nothing) == pytest.approx(0, abs=1e-6)
    fine = tone(100, 20, 8000)
    both = Skin(np.column_stack([fine, np.zeros_like(fine)]), 8000)
    assert observer().distance(skin(tone(100, 20)), both) == pytest.approx(0, abs=0.05)
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="no numbers"):
            observer().distance(Skin(np.full((10, 1), value), RATE_HZ), still)


# ---- how it decides ----


SENSITIVITY = 1.5


@cache
def pair() -> tuple[Skin, Skin]:
    """Return two tones whose distance is SENSITIVITY."""
    return skin(tone(200, 30)), skin(tone(200, 30 + SENSITIVITY * EVERYONE.weber_db))


def right(method: str, labels: str, number: int, same: bool = False) -> bool:
    """Return whether an observer answers correctly; the sides change from trial to trial."""
    reference, other = pair()
    if method == "same_different":
        return observer().answer(
            method, trial(method, labels, number), {"1": reference, "2": reference if same else other}
        )[0] == int(not same)
    correct = number // 2 % 2
    skins: dict[str, Skin | None] = dict(zip("AB" if method == "abx" else "12", (reference, other), strict=True))
    if method == "abx":
        skins["X"] = pair()[correct]
    elif correct == 0:
        skins = {"1": other, "2": reference}
    return observer().answer(method, trial(method, labels, number, correct), skins) == (correct,)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "labels"), [("two_alternative", "12"), ("abx", "ABX"), ("same_different", "12")])
def test_studies_find_the_sensitivity_that_the_observer_has(method: str, labels: str) -> None:
    count = 3000
    correct = sum(right(method, labels, number) for number in range(count))
    counts = [[correct, count]]
    if method == "same_different":
        false_alarms = sum(not right(method, labels, number, same=True) for number in range(count, 2 * count))
        counts = [[correct, count, false_alarms, count]]
    found = statistics.sensitivity(method, counts).value
    assert found == pytest.approx(SENSITIVITY, abs=0.15)


def level_of(staircase: TransformedUpDown | Bayesian, frequency_hz: float, participant: int) -> float | None:
    """Return the threshold of an observer, found by a staircase, in dB over the usual one."""
    number = 0
    while not staircase.done and number < 200:
        number += 1
        correct = number % 2
        skins = {"12"[correct]: skin(tone(frequency_hz, staircase.level())), "12"[1 - correct]: None}
        answer = Observer(1, participant, replace(EVERYONE, threshold_spread_db=6)).answer(
            "staircase", trial("staircase", "12", number, correct), skins
        )
        staircase.update(answer == (correct,))
    return staircase.threshold().value


@pytest.mark.slow
def test_staircases_find_the_thresholds_of_observers() -> None:
    people = range(1, 9)
    offsets_db = [Observer(1, each, replace(EVERYONE, threshold_spread_db=6)).threshold_db for each in people]
    bayesian = [level_of(Bayesian(-30, 30, 60), 250, each) for each in people]
    up_down = [level_of(TransformedUpDown(2, 20, (8, 4, 2), -30, 30, 14), 250, each) for each in people]
    for found in (bayesian, up_down):
        errors = np.array(found, float) - offsets_db
        assert abs(np.mean(errors)) < 2.5 and np.max(np.abs(errors)) < 8
        assert np.corrcoef(np.array(found, float), offsets_db)[0, 1] > 0.8


def test_the_hidden_reference_gets_the_highest_quality_and_the_weaker_of_two_is_preferred() -> None:
    reference = skin(texture("wood"))
    noise = np.random.default_rng(2).standard_normal(texture("wood").shape)
    skins = {
        "Reference": reference,
        "A": skin(texture("wood"), 5 * noise),
        "B": reference,
        "C": skin(texture("wood"), noise),
    }
    values = np.array([observer().answer("mushra", trial("mushra", "RABC", number), skins) for number in range(100)])
    worst, hidden, middle = values.mean(axis=0)
    assert worst < middle < hidden
    assert np.all(values.max(axis=1) == 100) and values.min() >= 0
    assert statistics.is_reliable(values[:, 1])
    skins = {"A": reference, "B": skin(3 * texture("wood"))}
    pairs = [trial("paired_comparison", "AB", number) for number in range(200)]
    assert np.mean([observer().answer("paired_comparison", each, skins)[0] for each in pairs]) < 0.2


def test_answers_depend_on_seed_participant_and_trial_alone() -> None:
    reference, other = pair()
    skins = {"Reference": reference, "A": other}

    def answers(seed: int, participant: int) -> list[tuple[int, ...]]:
        one = Observer(seed, participant)
        return [one.answer("degradation", trial("degradation", "RA", number), skins) for number in range(40)]

    assert answers(1, 1) == answers(1, 1)
    assert answers(1, 1) != answers(1, 2) != answers(2, 2)
    once = Observer(1, 1).answer("degradation", trial("degradation", "RA", 7), skins)
    assert once == answers(1, 1)[7]


def test_lapses_are_guesses() -> None:
    guessing = Observer(1, 1, replace(EVERYONE, lapse_rate=1.0))
    reference, other = pair()
    skins = {"Reference": reference, "A": other}
    found = {guessing.answer("degradation", trial("degradation", "RA", number), skins)[0] for number in range(100)}
    assert found == {0, 1, 2, 3}
    sliders = guessing.answer("mushra", trial("mushra", "RA", 1), skins)
    assert 0 <= sliders[0] <= 100
