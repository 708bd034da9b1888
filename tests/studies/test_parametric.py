"""The page on parametric coding: similar rates, measures next to each other, nothing left out."""

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from studies import parametric
from vibrocast import textures
from vibrocast.textures.generate import wood


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recordings = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2):
        textures.save(recordings / f"wood{seed}.wav", wood(seed=seed, seconds=1.0))
    return recordings


@pytest.mark.slow
def test_the_command_writes_page_table_and_chart(folder: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(parametric.main, [str(folder), "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    page = (tmp_path / "parametric.md").read_text()
    assert "2 recordings" in page
    assert f"studies.parametric {folder.name} --out" in page
    assert (tmp_path / "results" / "parametric.svg").stat().st_size > 5000
    with (tmp_path / "results" / "parametric.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["trace"] for row in rows} == {"wood1", "wood2"}
    of_curve = {name: [row for row in rows if row["codec"] == name] for name in parametric.CURVES}
    assert len(of_curve[parametric.DESCRIPTION]) == 2 * 5
    described, same, _ = (
        np.mean([[float(row["third_octave_distance_db"]), float(row["snr_db"])] for row in of_curve[name]], axis=0)
        for name in parametric.CURVES
    )
    assert described[0] < 0.5 * same[0]
    assert described[1] < 0 < same[1]


def test_means_are_of_curves_that_every_recording_has() -> None:
    rows = [
        parametric.Row(trace, "coarsest", name, 30.0, 5.0, None, 0.01, -3.0)
        for trace, name in (("one", "parametric"), ("two", "parametric"), ("two", parametric.curve_name(1)))
    ]
    (mean,) = parametric.means(rows)
    assert mean == parametric.Row("mean", "coarsest", "parametric", 30.0, 5.0, None, 0.01, -3.0)


def test_a_folder_without_recordings_is_reported(tmp_path: Path) -> None:
    done = CliRunner().invoke(parametric.main, [str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "no recordings" in done.output
