"""The cost of int8: the page of the study, and the limit that every model that ships keeps."""

import csv
from pathlib import Path

import pytest
from click.testing import CliRunner

from studies import integer_networks
from studies.integer_networks import Row
from vibrocast import models, textures
from vibrocast.codec import eva
from vibrocast.textures.generate import wood

SHIPPED = [model for model in models.shipped() if model.codec_identifier == eva.IDENTIFIER]
TABLE = Path(__file__).parents[2] / "docs" / "benchmarks" / "results" / f"{integer_networks.STEM}.csv"


def test_no_model_that_ships_loses_more_than_the_limit() -> None:
    with TABLE.open() as file:
        rows = [
            Row(row["family"], row["model"], row["recording"], float(row["snr_db"]), float(row["snr_db_by_onnx"]))
            for row in csv.DictReader(file)
        ]
    losses = integer_networks.losses_of(rows)
    assert {loss.model for loss in losses} == {model.name for model in SHIPPED}
    for loss in losses:
        assert loss.snr_db > integer_networks.LIMIT_TO_SNR_DB or loss.mean_db <= integer_networks.LIMIT_DB, loss


@pytest.mark.slow
def test_the_command_writes_page_table_and_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    textures.save(tmp_path / "wood.wav", wood(seed=1, seconds=1.0))
    monkeypatch.setattr(models, "shipped", lambda: SHIPPED[:2])
    out = tmp_path / "docs"
    done = CliRunner().invoke(integer_networks.main, [str(tmp_path), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "| mean loss, dB |" in (out / "integer_networks.md").read_text()
    assert (out / "results" / "integer_networks.png").stat().st_size > 5000
    with (out / "results" / "integer_networks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == sorted(model.name for model in SHIPPED[:2])
    assert all(abs(float(row["snr_db"]) - float(row["snr_db_by_onnx"])) < 1 for row in rows)
