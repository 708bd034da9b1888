"""The speed benchmark: figures of every step, as a table and as JSON."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from evaluation import speed


def test_writes_a_page_and_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "SECONDS", 2.0)
    done = CliRunner().invoke(speed.main, ["--repeats", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "speed.json").read_text())
    assert [result["step"] for result in figures["results"]] == list(speed.STEPS)
    assert all(result["encode_s_per_megasample"] > 0 for result in figures["results"])
    page = (tmp_path / "speed.md").read_text()
    assert all(f"| {result['snr_db']:.1f} |" in page for result in figures["results"])
