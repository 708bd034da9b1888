"""The study of several channels: its waves, its figures, its page, and the targets in its table."""

import csv
from pathlib import Path

import numpy as np
import pytest

from studies import several_channels as study

TABLE = Path(__file__).parents[2] / "docs" / "benchmarks" / "results" / "several_channels.csv"


def table() -> list[dict[str, str]]:
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_wave_reaches_each_actuator_later() -> None:
    samples = study.wave("ridges", 3, 4, -200.0)
    for place in (1, 2):
        np.testing.assert_allclose(samples[4 * place :, place], samples[: -4 * place, 0], atol=1e-8)


def test_noise_has_the_stated_level() -> None:
    noise = study.wave("rough", 2, 3, -20.0) - study.wave("rough", 2, 3, -400.0)
    assert 20 * np.log10(np.std(noise)) == pytest.approx(-20, abs=0.5)


def test_equal_channels_take_about_the_bits_of_one() -> None:
    samples = np.repeat(study.wave("rough", 2, 0, -400.0)[:5600, :1], 2, axis=1)
    row = study.measured(study.Case(study.COPIES, "two equal", samples))
    assert row.bd_percent is not None
    assert -50 < row.bd_percent < -40
    assert (row.channels, row.section_bytes, row.delay_samples) == (2, 4, 0)


def test_recordings_that_are_not_there_are_left_out(tmp_path: Path) -> None:
    assert list(study.recorded(tmp_path)) == []


def test_three_axes_of_a_tool_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "p1918_reference"
    folder.mkdir()
    for axis in "XYZ":
        np.savetxt(folder / f"Direct_-_tool_-_stone_-_slow_{axis}.txt", np.arange(10.0))
    (case,) = study.recorded(tmp_path)
    assert (case.kind, case.name, case.samples.shape) == ("tool, three axes", "Direct_-_tool_-_stone_-_slow", (10, 3))


def test_the_page_leads_with_the_wave_and_the_unrelated_channels() -> None:
    rows = [
        study.Row(study.WAVE, "a wave", *study.TABLE_CASE, -66.0, 70.0, 68.0, 62.0, 9, 12),
        study.Row(study.UNRELATED, "two", 2, None, None, 0.3, None, -0.1, None, 4, 0),
    ]
    first = study.page(rows).split("##")[0]
    assert "saves 68 % of the bits at 15 dB" in first
    assert "lose at most 0.30 %" in first


def test_unrelated_channels_lose_at_most_half_a_percent() -> None:
    percents = [float(row["bd_percent"]) for row in table() if row["kind"] == study.UNRELATED]
    assert len(percents) >= 10
    assert max(percents) <= 0.5


def test_the_waves_of_the_target_save_at_least_60_percent() -> None:
    channels, delay, noise_db = study.TABLE_CASE
    of_table = (str(channels), str(delay), str(noise_db))
    rows = [row for row in table() if (row["channels"], row["delay"], row["noise_db"]) == of_table]
    assert len(rows) == len(study.GENERATORS)
    assert all(float(row[f"saved_{snr_db}"]) >= 60 for row in rows for snr_db in study.SNRS_DB)
