"""The page of rate control: measured on a folder of recordings, with its charts and tables."""

import csv
import math
import shutil
from pathlib import Path

import pytest

from studies import rate_control

OAK = Path(__file__).parents[2] / "examples" / "oak.wav"


@pytest.mark.slow
def test_a_folder_is_measured_into_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, values in {"RATES_BPS": (1000, 8000), "MAIN_RATES_BPS": (8000,), "REFRESHES_S": (0.25, math.inf)}.items():
        monkeypatch.setattr(rate_control, name, values)
    recordings, out = tmp_path / "recordings", tmp_path / "docs"
    recordings.mkdir()
    shutil.copy(OAK, recordings)
    rate_control.main([str(recordings), "--out", str(out)], standalone_mode=False)
    page = (out / "rate_control.md").read_text()
    assert "python -m studies.rate_control" in page
    for name in ("recordings", "codecs", "buffers"):
        assert f"(results/rate_control_{name}.png)" in page
        assert (out / "results" / f"rate_control_{name}.png").stat().st_size > 1000
    with (out / "results" / "rate_control.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    held = [row for row in rows if row["codec"] == "mdct" and row["rate_buffer_s"] == "0.018"]
    assert [row["bits_per_second"] for row in held] == ["1000", "8000"]
    assert all(abs(float(row["furthest_percent"])) < 1 for row in held)
    rejected = [row for row in rows if row["codec"] == "wavpack"]
    assert all("cannot be held" in row["rejected"] for row in rejected)
    even = [row for row in rows if row["rate_buffer_s"] == "1.0"]
    assert float(even[0]["snr_deviation_db"]) < float(held[1]["snr_deviation_db"])
    with (out / "results" / "rate_control_refreshes.csv").open(newline="") as file:
        often, once = (float(row["snr_db"]) for row in csv.DictReader(file) if row["bits_per_second"] == "8000")
    assert often < once
