"""Tests of the picture: every shape of input gives one, and its spectra state the right levels."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from vibrocast.host.picture import Trace, draw, third_octave_levels

RATE_HZ = 2800


def traces(values: NDArray[np.float64]) -> list[Trace]:
    """Three traces as `play` draws them, of the same values."""
    signals = [Trace(name, values, RATE_HZ, "m/s^2", values, RATE_HZ) for name in ("recording", "decoded")]
    return [*signals, Trace("skin", np.repeat(values, 4, axis=0), 4 * RATE_HZ, "um", values, RATE_HZ)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("samples", "channels"),
    [(1, 1), (2, 1), (20_000, 1), (1, 6), (300, 6)],
)
def test_draws_every_length_and_channel_count(samples: int, channels: int, tmp_path: Path) -> None:
    values = np.random.default_rng(samples).normal(size=(samples, channels))
    path = tmp_path / "picture.png"
    draw(path, "noise", "caption", traces(values))
    assert imread(path).std() > 0.05
    assert [entry.name for entry in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 1e-30, 1e30])
def test_draws_silence_and_extremes(level: float, tmp_path: Path) -> None:
    draw(tmp_path / "picture.svg", "flat", "caption", traces(np.full((500, 1), level)))
    text = (tmp_path / "picture.svg").read_text()
    assert text.endswith("</svg>\n")


@pytest.mark.filterwarnings("error")
def test_draws_any_name_as_it_is(tmp_path: Path) -> None:
    draw(tmp_path / "picture.svg", "$x_{$ \u6728", "$y^{$", traces(np.ones((500, 1))))
    assert "$x_{$" in (tmp_path / "picture.svg").read_text()


@pytest.mark.parametrize("frequency_hz", [60.0, 250.0, 700.0])
@pytest.mark.parametrize("seconds", [0.5, 20.0])
def test_level_of_a_sine_is_its_amplitude(frequency_hz: float, seconds: float) -> None:
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    frequencies_hz, levels_db = third_octave_levels(3.0 * np.sin(2 * np.pi * frequency_hz * time_s), RATE_HZ)
    nearest = np.argmin(np.abs(frequencies_hz - frequency_hz))
    assert levels_db[nearest] == pytest.approx(20 * np.log10(3.0), abs=0.2)
    assert levels_db[frequencies_hz > 2 * frequency_hz].max(initial=-200) < -20
