"""Pictures for papers."""

from pathlib import Path

import pytest

from vibrocast.evaluation.pictures import figure_file, remove


def test_a_figure_comes_as_pdf_and_pgf_too_without_latex(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with figure_file(tmp_path / "chart.svg", 3, 2) as figure:
        figure.subplots().set(xlabel="a_b & 5 %", xscale="log", xlim=(1, 100))
    assert b"/Type3" not in (tmp_path / "chart.pdf").read_bytes()
    pgf = (tmp_path / "chart.pgf").read_text()
    assert r"a\_b \& 5 \%" in pgf and "10^{2}" in pgf
    remove(tmp_path / "chart.svg")
    assert not list(tmp_path.iterdir())


def test_a_figure_with_an_image_has_no_pgf(tmp_path: Path) -> None:
    with figure_file(tmp_path / "map.svg", 3, 2) as figure:
        figure.subplots().imshow([[0, 1]])
    assert {path.name for path in tmp_path.iterdir()} == {"map.svg", "map.pdf"}
