"""The page of the shape for touch: what it measures of one recording, and the page as it stands."""

from dataclasses import replace

import numpy as np
import pytest

import vibrocast
from studies import perceptual as study
from vibrocast.codec.threshold import read_threshold, threshold_amplitude


def test_the_page_compares_the_default_with_flat_and_with_other_codecs() -> None:
    recording = replace(vibrocast.load("examples/oak.wav"), name="oak")
    points = {touch: study.measured(recording, touch) for touch in (0.0, 0.25)}
    twice = [[2 * point[0], *point[1:]] for point in points[0.0]]
    bits = study.compared("oak", points, [twice, twice[:2]])
    percent = {(row["touch"], row["quality"], row["anchor"]): row["percent"] for row in bits}
    assert percent[0.25, "SPQI", study.FLAT] < -5
    assert percent[0.0, "SNR", study.BEST_OTHER] == pytest.approx(-50, abs=0.01)
    coded = study.as_coded(recording)
    assert coded[1]["spqi"] > coded[0]["spqi"]
    assert coded[0]["lower_draws"] == 0
    unfelt = [study.least_unfelt(recording, touch) for touch in (0.0, 1.0)]
    other_strengths = [{**row, "touch": touch} for row in bits for touch in study.TOUCHES if row["touch"] == 0.25]
    page = study.page(other_strengths, coded, unfelt, ["twice"])
    assert f"takes {-percent[0.25, 'SPQI', study.FLAT]:.1f} % fewer bits than flat" in page
    assert f"in {coded[1]['lower_draws']} of 20 draws" in page


def test_the_stationary_level_of_a_sine_is_that_over_the_threshold() -> None:
    sine = np.sin(2 * np.pi * 250 * np.arange(28_000) / 2800)[:, None]
    amplitude = threshold_amplitude(read_threshold(), np.array([20 * 2 ** (11 / 3)]), study.UNIT)
    assert study.stationary_db(sine, 2800)[0] == pytest.approx(-20 * np.log10(amplitude[0]), abs=0.1)
