"""Savings by planning: rows and page from generated recordings."""

import csv
import shutil
from itertools import product
from pathlib import Path

import pytest
from click.testing import CliRunner

from studies.planning import (
    FREE,
    HELD,
    ROWS,
    WEIGHTS,
    main,
)
from vibrocast import textures

RESULTS = Path(__file__).parents[2] / "docs/benchmarks/results"


@pytest.mark.slow
def test_the_page_and_its_rows(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    folder.mkdir()
    textures.save(folder / "rough.wav", textures.GENERATORS["rough"](seconds=0.5, rate_hz=2800))
    (folder / "bad.csv").write_text("no texture\n")
    done = CliRunner().invoke(main, [str(folder), "--out", str(tmp_path / "docs")])
    assert done.exit_code == 0, done.output
    page = (tmp_path / "docs" / "planning_results.md").read_text()
    assert "| made | 1 | " in page and "bad.csv" in page
    with (tmp_path / "docs" / "results" / ROWS).open() as file:
        every = list(csv.DictReader(file))
    assert [(row["delay"], row["weights"]) for row in every] == list(product((FREE, HELD), WEIGHTS))
    for row in every:
        assert float(row["planned_snr_db"]) >= float(row["default_snr_db"]) - 0.01
        assert row["delay"] == FREE or float(row["planned_delay_ms"]) <= float(row["default_delay_ms"]) + 0.1
    rows = {row["weights"]: row for row in every if row["delay"] == FREE}
    bits, instructions = rows["bits alone"], rows["instructions alone"]
    assert float(bits["planned_wire_bps"]) <= float(instructions["planned_wire_bps"])
    assert float(instructions["planned_instructions"]) <= float(bits["planned_instructions"])
    assert float(bits["planned_wire_bps"]) < float(bits["default_wire_bps"])


def test_the_page_is_written_again_from_its_rows(tmp_path: Path) -> None:
    shutil.copytree(RESULTS, tmp_path / "results")
    arguments = ["--out", str(tmp_path), "--measured-at", "abc1234", "--left-out", "one: too short"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    page = (tmp_path / "planning_results.md").read_text()
    assert "Version abc1234 measured all figures" in page and "- one: too short" in page
    (tmp_path / "results" / ROWS).write_text("group\nrough\n")
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 1 and "measure again" in done.output


def test_folders_or_stored_rows_are_needed(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["--out", str(tmp_path)])
    assert done.exit_code == 2 and "give either FOLDERS or --measured-at" in done.output


def test_a_folder_without_a_texture_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("no texture\n")
    done = CliRunner().invoke(main, [str(tmp_path), "--out", str(tmp_path)])
    assert done.exit_code == 1 and "none of the recordings can be planned" in done.output
