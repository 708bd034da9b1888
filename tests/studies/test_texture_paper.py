"""The paper's arithmetic beside real bytes: exact percentages, and what coding measures."""

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from studies import texture_paper
from studies.texture_paper import Result, measure, paper_percent
from vibrocast import textures


def test_arithmetic_of_the_paper() -> None:
    percents = [round(paper_percent(levels), 1) for levels in texture_paper.PAPER_LEVELS]
    assert percents == [23.8, 22.4, 20.8, 18.8, 16.2, 14.5, 12.5]


def profile() -> textures.Profile:
    return textures.surface_profile("rough", 1, 0.6, texture_paper.HAND_SPEED_MM_S)


def test_real_bytes_follow_the_arithmetic_of_the_entropy() -> None:
    """Huffman coding cannot take more than the fixed length and its tables; range coding takes less than both."""
    coarse, fine = (measure("rough", profile(), {"levels": levels}) for levels in (5, 32))
    assert coarse.range_percent < coarse.huffman_percent < coarse.paper_percent + 4
    assert fine.range_percent < fine.huffman_percent < fine.paper_percent + 4
    assert fine.snr_db > coarse.snr_db + 10
    assert fine.zeros_percent == 0
    assert fine.huffman_bits_per_sample == pytest.approx(fine.huffman_percent / 100 * 16 * 4 * 146 / 1680), "of 4 * 512"


def test_a_higher_cut_gives_more_zeros_and_less_of_the_signal() -> None:
    results = [
        measure("rough", profile(), {"levels": texture_paper.SIXTEEN_BITS}, b0_db) for b0_db in (-12.0, 0.0, 12.0)
    ]
    zeros, snrs_db = [result.zeros_percent for result in results], [result.snr_db for result in results]
    assert 0 < zeros[0] < zeros[1] < zeros[2] <= 100
    assert snrs_db == sorted(snrs_db, reverse=True)


def test_falls_are_found_between_neighbours() -> None:
    results = [Result("t", "linear", n, None, 0, 0, 0, 0, 0, snr_db, 0) for n, snr_db in ((6, 2.0), (4, 1.0), (5, 3.0))]
    assert texture_paper.falls(results) == [6]


def test_the_command_writes_page_table_and_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture_paper, "generated_profiles", lambda: {"rough": profile()})
    monkeypatch.setattr(texture_paper, "LEVELS", texture_paper.PAPER_LEVELS[::-1])
    own = tmp_path / "profiles"
    own.mkdir()
    textures.save_profile(own / "mine.csv", profile())
    done = CliRunner().invoke(texture_paper.main, ["--out", str(tmp_path / "out"), "--profiles", str(own)])
    assert done.exit_code == 0, done.output
    page = (tmp_path / "out" / "texture_paper.md").read_text()
    assert "| 14 | 23.8 % |" in page
    assert "mine: Huffman" in page
    with (tmp_path / "out" / "texture_paper.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["texture"] for row in rows} == {"rough", "mine"}
    assert np.all([float(row["huffman_percent"]) > 0 for row in rows])
    assert (tmp_path / "out" / "texture_paper.png").read_bytes().startswith(b"\x89PNG")


def test_files_that_are_no_profile_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("nothing\n")
    done = CliRunner().invoke(texture_paper.main, ["--out", str(tmp_path), "--profiles", str(tmp_path)])
    assert done.exit_code == 1
    assert "bad.csv" in done.output
    assert done.exception is None or isinstance(done.exception, SystemExit)


def test_a_folder_that_cannot_be_made_is_rejected_before_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(texture_paper, "measure_all", lambda profiles: pytest.fail("measured"))
    (tmp_path / "file").write_text("")
    done = CliRunner().invoke(texture_paper.main, ["--out", str(tmp_path / "file" / "out")])
    assert (done.exit_code, "Not a directory" in done.output) == (1, True)
