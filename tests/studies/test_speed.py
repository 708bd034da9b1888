"""The page of the speed of coding: one run, each codec by itself and as a search."""

import csv
from pathlib import Path

from click.testing import CliRunner

from studies import speed


def test_the_command_writes_page_and_table(tmp_path: Path) -> None:
    done = CliRunner().invoke(speed.main, ["--samples", "20000", "--repeats", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    with (tmp_path / "results" / speed.TABLE).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["codec"] for row in rows} == {"zlib -6", "flac", "opus", "mdct", "slp"}
    reached = {row["task"]: float(row["snr_db"]) for row in rows if row["codec"] == "mdct"}
    assert abs(reached[speed.TO_SNR] - speed.SNR_DB) <= 0.2
    assert abs(reached[speed.TO_RATE] - speed.SNR_DB) <= 0.5
    assert all(float(row["encode_s"]) > 0 for row in rows)
    page = (tmp_path / speed.PAGE).read_text()
    assert page.count("\n| `") == len(rows)
