"""Tests of times in tables: the rates that they give, what each flaw is called, and samples at equal steps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vibrocast.textures import TextureError, load
from vibrocast.textures.recording import Signal
from vibrocast.textures.times import interpolated

COUNT = 1000
PLACES = np.arange(COUNT)
VALUES = np.random.default_rng(8).normal(size=COUNT)


def written(folder: Path, times: Signal, form: str = "%.6f", name: str = "time_s", values: Signal = VALUES) -> Path:
    path = folder / "file.csv"
    lines = [f"{form % time},{value:.6f}" for time, value in zip(times, values, strict=True)]
    path.write_text("\n".join([f"{name},x_g", *lines]))
    return path


@pytest.mark.parametrize("rate_hz", [800, 1344, 1600, 3200, 4000])
@pytest.mark.parametrize("rounded", [np.floor, np.rint])
def test_times_in_whole_ms_give_their_rate(tmp_path: Path, rate_hz: int, rounded: Callable[[Signal], Signal]) -> None:
    path = written(tmp_path, rounded(1000 * PLACES / rate_hz), "%d", "time_ms")
    recording = load(path)
    assert (recording.rate_hz, len(recording.notes)) == (rate_hz, 1)
    assert f"1 ms; its mean step says {rate_hz} Hz" in recording.notes[0]
    assert load(path, rate_hz=rate_hz).rate_hz == rate_hz
    with pytest.raises(TextureError, match=f"the time column says {rate_hz} Hz"):
        load(path, rate_hz=0.9 * rate_hz)


def test_a_few_rounded_times_leave_the_rate_open(tmp_path: Path) -> None:
    path = written(tmp_path, np.floor(PLACES[:30] / 0.8), "%d", "time_ms", VALUES[:30])
    with pytest.raises(TextureError, match=r"rounded to 1 ms, and its 30 lines leave the rate open; give `rate_hz`"):
        load(path)
    assert load(path, rate_hz=800).rate_hz == 800


@pytest.mark.parametrize(
    ("times", "message", "remedy"),
    [
        (PLACES // 2 / 500, "500 of 1000 lines repeat .* line 3: the sensor was read in bursts", {"rate_hz": 1000}),
        (PLACES // 32 * 32 / 800, "968 of 1000 lines repeat .* in bursts; .* about 80", {"rate_hz": 800}),
        ((PLACES - (PLACES == 401)) / 800, "1 of 1000 .* line 403: samples without a time of", {"rate_hz": 800}),
        ((PLACES + 0.55 * (PLACES == 300)) / 500, "line 302 .* 55% of a step: only this line", {"resample": True}),
        ((PLACES + 0.6 * (PLACES % 300 == 9)) / 500, "line .*: only 4 lines are", {"resample": True}),
        ((PLACES + 0.4 * (PLACES % 3 == 0)) / 500, "334 of 1000 lines jitter", {"resample": True}),
        ((PLACES + 40 * (PLACES > 300)) / 500, "a gap of 0.082 after line 302, .* step is 0.002", {"resample": True}),
        ((PLACES + 9 * (PLACES > 99) + 9 * (PLACES > 500)) / 500, "after line 101, and 1 more", {"resample": True}),
        (PLACES % 600 / 800, "runs back after line 601, from 0.74875 to 0: a second recording.* own file", None),
        ((PLACES - 2 * (PLACES == 400)) / 800, "runs back after line 401, .* out of order; sort the lines", None),
        ((PLACES + 1500 * (PLACES > 300)) / 500, "a gap of 3", None),
    ],
)
def test_each_flaw_has_its_error_and_a_remedy_that_works(
    tmp_path: Path, times: Signal, message: str, remedy: dict[str, float] | None
) -> None:
    path = written(tmp_path, times)
    with pytest.raises(TextureError, match=message) as raised:
        load(path)
    if remedy is None:
        with pytest.raises(TextureError, match=message.partition(",")[0]):
            load(path, resample=True)
        return
    assert load(path, resample=True).rate_hz == pytest.approx(COUNT / (times[-1] - times[0]), rel=0.06)
    assert all(f"`{name}`" in str(raised.value) for name in remedy)
    assert load(path, **remedy).rate_hz == pytest.approx(round(COUNT / (times[-1] - times[0])), rel=0.05)  # type: ignore[arg-type]


def test_repeated_lines_are_left_out_on_request(tmp_path: Path) -> None:
    places = np.insert(PLACES, 400, 400)
    path = written(tmp_path, places / 800, values=VALUES[places])
    with pytest.raises(TextureError, match=r"line 403: duplicates, .*; give `resample` to leave them out"):
        load(path)
    recording = load(path, resample=True)
    assert "1 repeated line(s) left out" in recording.notes[0]
    np.testing.assert_allclose(recording.samples[:, 0], 9.80665 * VALUES, atol=1e-4)


@pytest.mark.parametrize("form", ["%.6f", "%.3f"])
def test_resampling_follows_a_sine_through_jitter_and_fills_gaps(tmp_path: Path, form: str) -> None:
    times_s = (PLACES + np.random.default_rng(2).uniform(-0.4, 0.4, COUNT)) / 800 + 0.05 * (PLACES > 500)
    path = written(tmp_path, times_s, form, values=np.sin(2 * np.pi * 20 * times_s))
    recording = load(path, resample=True)
    assert recording.rate_hz == pytest.approx(800, abs=1)
    assert " in 1 gap(s)" in recording.notes[0]
    assert len(recording.samples) == pytest.approx(1040, abs=2)
    if form == "%.6f":
        grid_s = times_s[0] + np.arange(len(recording.samples)) / 800
        expected = 9.80665 * np.sin(2 * np.pi * 20 * grid_s)
        around_gap = (grid_s > times_s[499]) & (grid_s < times_s[502])
        np.testing.assert_allclose(recording.samples[~around_gap, 0], expected[~around_gap], atol=0.05)


def test_interpolation_is_exact_for_parabolas() -> None:
    times = np.array([0.0, 1.0, 2.5, 3.0, 4.2])
    grid = np.linspace(1, 3, 9)
    np.testing.assert_allclose(interpolated(times, times[:, None] ** 2, grid, gap=9)[:, 0], grid**2)
    np.testing.assert_allclose(interpolated(times, times[:, None] ** 2, np.array([1.75]), gap=1.2)[:, 0], [3.625])


@pytest.mark.parametrize(
    ("name", "per_s", "form", "start", "rate_hz"),
    [
        ("timestamp", 1e9, "%d", 1767620467350470700, 400),
        ("time (ns)", 1e9, "%d", 0, 800),
        ("timestamp", 1e6, "%d", 17e14, 800),
        ("t", 1e3, "%.2f", 1.7e12, 800),
        ("epoch", 1, "%.6f", 1.7e9, 3200),
        ("elapsed_s", 1, "%.6f", 0, 3200),
        ("time", 1, "%.6f", 3, 10_000),
        ("T", 1, "%.6f", 3, 10_000),
        ("seconds_elapsed", 1, "%.6f", 7, 50),
        ("millis", 1e3, "%.3f", 0, 800),
        ("time_us", 1e6, "%d", 2**32 - 10_000, 800),
    ],
)
def test_units_of_times(tmp_path: Path, name: str, per_s: float, form: str, start: float, rate_hz: int) -> None:
    times = start + np.rint(1e6 * PLACES / rate_hz * (per_s / 1e6)) if per_s > 1e5 else start + PLACES / rate_hz * per_s
    path = written(tmp_path, times % 2**32 if name == "time_us" else times, form, name)
    assert load(path).rate_hz == pytest.approx(rate_hz)
    assert load(path, rate_hz=rate_hz).rate_hz == rate_hz


@pytest.mark.parametrize(
    ("name", "unit", "per_s"), [("time_ms", "s", 1.0), ("time_us", "ms", 1e3), ("t [ns]", "us", 1e6)]
)
def test_a_rate_that_no_sensor_has_comes_from_a_wrong_unit(tmp_path: Path, name: str, unit: str, per_s: float) -> None:
    path = written(tmp_path, PLACES / 3200 * per_s, "%.6f", name)
    with pytest.raises(TextureError, match=rf"which no sensor has; name it by its unit \(3200 Hz in {unit}\), or give"):
        load(path)
    assert load(path, rate_hz=3200).rate_hz == 3200


@pytest.mark.parametrize("form", ["2024-05-01T12:00:0{:.6f}Z", "01/05/2024 9:59:0{:.6f}", "12:00:0{:.6f}"])
def test_dates_and_times_of_day(tmp_path: Path, form: str) -> None:
    path = tmp_path / "file.csv"
    rows = [f"{form.format(place / 800)},{value:.6f}" for place, value in zip(PLACES, VALUES, strict=True)]
    path.write_text("\n".join(["Date,x_g", *rows]))
    assert load(path).rate_hz == 800


def test_of_two_columns_of_times_those_at_equal_steps_count(tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    arrival = (PLACES + np.random.default_rng(1).uniform(0, 0.9, COUNT)) / 800
    rows = [
        f"{late:.6f},0.00125,{place / 800:.6f},{VALUES[place]}" for place, late in zip(PLACES, arrival, strict=True)
    ]
    path.write_text("\n".join(["host_time_s,dt_s,sensor_time_s,x_g", *rows]))
    assert load(path).rate_hz == 800
    rows = [f"{place / 800:.6f},{place / 400:.6f},{VALUES[place]}" for place in PLACES]
    path.write_text("\n".join(["a_s,b_s,x_g", *rows]))
    with pytest.raises(TextureError, match="different rates: 'a' 800 Hz, 'b' 400 Hz"):
        load(path)
