"""The page of the papers' claims: what counts as reproduced, what is missing, and that no other codec stands in."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from studies import papers, pvc_slp, texture_paper
from studies.texture_paper import Result
from vibrocast import textures
from vibrocast.evaluation import bench, cells
from vibrocast.evaluation.comparison import Measurements
from vibrocast.evaluation.cost import CodecCost
from vibrocast.evaluation.points import Point
from vibrocast.evaluation.speed import Speed
from vibrocast.textures.generate import wood

SNRS_DB = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0)


def curve(name: str, factor: float, setting: str = "") -> list[Point]:
    """Return a codec's points of two traces at `factor` times the rate of slp, all qualities rising alike."""
    points = []
    for trace in ("a", "p1918-b"):
        for number, snr_db in enumerate(SNRS_DB):
            size, st_sim = round(1e6 * factor * 2 ** (snr_db / 12)), 1 - 10 ** (-(snr_db + 1) / 10)
            text = f"{setting}{number}"
            points.append(
                Point(trace, name, text, 16_000_000, size, snr_db, 2800.0, snr_db + 13, st_sim, st_sim, st_sim)
            )
    return points


def measured(factor: float) -> Measurements:
    """Return slp, mdct with a network at half of its bits, and families of models, of one rate each and of all."""
    points = [*curve("slp", 1), *curve("net", 0.5, "step="), *curve("eva-64", factor, "quality=0 model=eva-64-")]
    points += [*curve("eva-16", 0.7, "quality=0 model=eva-16-"), *curve("eva-all", 0.1, "quality=")]
    coders = {"net": ("mdct", None), "eva-64": ("eva", 64), "eva-16": ("eva", 16), "eva-all": ("eva", 256)}
    costs = [CodecCost(name, 1, 1, "", 1000, coder, width) for name, (coder, width) in coders.items()]
    speeds = [Speed(name, 1.6, "core", "", 1, 1.6, 15.0, 2.0, 1.0) for name in ("slp", "eva-64")]
    return Measurements(points, [], costs, [], speeds)


@pytest.mark.parametrize(
    ("factor", "difference", "reproduced"),
    [(0.85, 0.0, "yes"), (0.5, -35.0, "yes"), (0.9, 5.0, "no"), (1.2, 35.0, "no")],
)
def test_a_target_of_eva_holds_for_its_widest_family_of_one_rate_each(
    factor: float, difference: float, reproduced: str
) -> None:
    claim, *_ = papers.eva_claims(measured(factor))
    assert claim.stated == "-14.98 %" and claim.here.startswith(f"{100 * (factor - 1):+.1f} %")
    assert claim.difference == pytest.approx(difference, abs=0.1)
    assert claim.reproduced == reproduced


@pytest.mark.parametrize(
    ("factor", "reading", "verdict"),
    [(0.5, 0.9, "yes"), (0.9, 2.0, "not decidable"), (1.1, 1.2, "not decidable"), (1.2, 1.1, "no"), (0.9, 0.95, "no")],
)
def test_a_verdict_that_hangs_on_the_reading_of_the_anchor_is_not_decidable(
    factor: float, reading: float, verdict: str
) -> None:
    """`reading`: the rate of another reading of PVC-SLP, relative to that of slp as it ships."""
    measurements = pvc_slp.with_points(measured(factor), curve("slp-shaping-1", reading))
    claim, *_ = papers.eva_claims(measurements)
    percents = sorted((100 * (factor - 1), 100 * (factor / reading - 1)))
    assert claim.here.startswith(f"{percents[0]:+.1f} to {percents[1]:+.1f} %")
    assert (claim.difference, claim.reproduced) == (None, verdict)
    rows = list(pvc_slp.sensitivity(measurements, ["eva-64", "eva-16"]))
    assert len(rows) == 2 * 2 * (2 + len(pvc_slp.BANDS))
    assert {(row.won, row.traces, row.best) for row in rows if row.codec == "eva-16"} == {(2, 2, "a")}


def test_another_codec_never_stands_in_for_a_family_that_is_missing() -> None:
    assert papers.families(measured(0.9)) == ["eva-64", "eva-16"]
    measurements = measured(0.9)
    without = Measurements(
        [point for point in measurements.points if "model=" not in point.setting], [], measurements.costs, []
    )
    claims = list(papers.eva_claims(without))
    assert [claim.reproduced for claim in claims[:-1]] == [papers.NOT_YET] * 8
    assert all(claim.here == "" for claim in claims[:3])


def test_times_are_not_called_reproduced() -> None:
    (time,) = (claim for claim in papers.eva_claims(measured(0.9)) if "encode" in claim.claim)
    assert time.here == "slp 2 s (core); eva-64 2 s (core), 1 times" and time.reproduced == papers.NOT_COMPARABLE


def test_ratios_and_zeros_are_held_against_the_paper_where_its_listeners_noticed_nothing() -> None:
    rows = [
        Result("wood", "linear", 14, None, 23.796, 22.0, 99.0, 0.0, 99.0),
        Result("wood", "log", 14, None, 23.796, 99.0, 99.0, 0.0, 99.0),
        Result("wood", "linear", 65_535, -8.0, 100.0, 99.0, 99.0, 44.8, 99.0),
        Result("wood", "linear", 14, -8.0, 23.796, 99.0, 99.0, 1.0, 99.0),
    ]
    claims = {claim.claim: claim for claim in papers.dct_claims(rows)}
    ratio = claims["wood: ratio with Huffman codes, L = 14"]
    assert (ratio.difference, ratio.reproduced) == (-0.3, papers.YES)
    zeros = claims["wood: zeros by the cut, b0 = -8 dB"]
    assert (zeros.difference, zeros.reproduced) == (16.1, papers.NO)
    assert claims["leather: ratio with Huffman codes, L = 12"].reproduced == papers.NOT_YET
    assert claims["compression ratio log2(L) / 16"].reproduced == papers.YES
    assert claims["listeners noticed a cut at b0 = 0 dB"].reproduced == papers.NOT_YET


def test_the_model_of_the_display_is_the_papers() -> None:
    corner_db, falls, deviation_db = papers.display()
    assert corner_db == pytest.approx(-3.01, abs=0.02) and falls
    assert deviation_db < 0.06


def test_positions_in_steps_of_the_papers_sensor_change_the_heights_hardly() -> None:
    assert -70 < papers.sensed() < -50


def test_the_energy_of_a_quantised_spectrum_is_that_of_equation_2() -> None:
    """Of the first stretch of wood at L = 8, by the paper's equation alone."""
    coded = texture_paper.code(texture_paper.generated_profiles()["wood"], {"levels": 8})
    original_um = coded.original_um[0]
    step_um = np.ptp(original_um) / 7
    energies = [np.sum(each**2) for each in (step_um * np.rint(original_um / step_um), coded.coded_um[0], original_um)]
    assert 10 * np.log10(energies[0] / energies[2]) == pytest.approx(0.33, abs=0.03)
    assert energies[1] == pytest.approx(energies[0], rel=0.01)
    mean_db, peaks, stretches = papers.louder()["wood"]
    assert 0 < mean_db < 1 and 0 <= peaks <= stretches == texture_paper.STRETCHES


@pytest.mark.slow
def test_the_command_writes_page_note_and_waveforms(tmp_path: Path) -> None:
    recordings, results = tmp_path / "recordings", tmp_path / "out" / "results"
    recordings.mkdir()
    results.mkdir(parents=True)
    recording = wood(seed=1, seconds=1.0)
    textures.save(recordings / "wood.wav", recording)
    loaded = textures.load(recordings / "wood.wav")
    points = []
    for method in cells.methods(["slp", "mdct"]):
        if method.name in ("slp", "mdct"):
            for rate_point in method.rate_points[::2]:
                points.append(cells.Cell("wood", loaded, method, rate_point, 0).measure().point)
    bench.write(results, Measurements(points, [], [], []))
    (results / "texture_paper.csv").write_text(
        "surface,quantiser,levels,b0_db,paper_percent,huffman_percent,file_percent,zeros_percent,snr_db\n"
    )
    (results / "held_out.csv").write_text(
        "codec,measure,peer,mean_percent,worst_percent\nmdct,SNR,LC3,-55.1,-42.1\nmdct,SPQI,LC3,,\n"
    )
    done = CliRunner().invoke(papers.main, [str(recordings), "--out", str(results.parent)])
    assert done.exit_code == 0, done.output
    page = (results.parent / "papers.md").read_text()
    with (results / "pvc_slp_points.csv").open(newline="") as file:
        measured_sets = [row["codec"] for row in csv.DictReader(file)]
    readings = set(pvc_slp.readings()) - {"slp"}
    assert set(measured_sets) == readings and len(measured_sets) == 32 * len(readings)
    assert "No such family was measured." in page and "| `mdct` | " in page
    assert "| `mdct` | SNR | -55.1 (-42.1) |" in (results / "note.md").read_text()
    assert (results / "waveforms.svg").stat().st_size > 5000
    with (results / "waveforms.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["codec"] for row in rows} == {"slp", "mdct"}
    middle = loaded.samples[(len(loaded.samples) - 200) // 2 :][:200, 0]
    np.testing.assert_allclose([float(row["original"]) for row in rows], np.tile(middle, 6), atol=1e-6)

    missing = [replace(point, trace="other") for point in points]
    bench.write(results, Measurements(missing, [], [], []))
    done = CliRunner().invoke(papers.main, [str(recordings), "--out", str(results.parent)])
    assert done.exit_code == 1 and "no recording 'other'" in done.output
