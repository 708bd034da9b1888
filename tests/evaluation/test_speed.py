"""The speed benchmark: figures of every step, as a table and as JSON."""

import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner

from evaluation import speed


def test_figures_belong_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "SECONDS", 1.0)
    done = CliRunner().invoke(speed.main, ["--repeats", "1", "--out", str(tmp_path / "new")])
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "new" / "speed.json").read_text())
    assert (figures["samples"], figures["repeats"]) == (2800, 1)
    assert [result["step"] for result in figures["results"]] == list(speed.STEPS)
    page = (tmp_path / "new" / "speed.md").read_text()
    for result in figures["results"]:
        both_s = result["encode_s_per_megasample"] + result["decode_s_per_megasample"]
        assert math.isclose(result["both_over_reference"] * figures["reference_s"], both_s)
        assert f"| {result['snr_db']:.1f} |" in page


def test_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "SECONDS", 0.1)
    (tmp_path / "file").touch()
    done = CliRunner().invoke(speed.main, ["--repeats", "1", "--out", str(tmp_path / "file" / "below")])
    assert done.exit_code == 1
    assert "cannot be written" in done.output
