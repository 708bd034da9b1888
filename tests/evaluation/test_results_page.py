"""Tests of the page of results, its charts and tables."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from click.testing import CliRunner
from polars.testing import assert_frame_equal

from vibrocast.codec import CODECS
from vibrocast.evaluation import bench, results_page
from vibrocast.evaluation.bd_rate import PSNR, SNR, ST_SIM_2800
from vibrocast.evaluation.comparison import (
    FIT,
    TIMES,
    Measurements,
    at_needed_snr,
    bd_regions,
    bits_to_reach,
    cost_points,
    curve_costs,
    mean_bd_rates,
    mean_curves,
    rate_excesses,
    ratio_points,
    recommendations,
    trace_bd_rates,
)
from vibrocast.evaluation.cost import CodecCost
from vibrocast.evaluation.kinds import TraceKind
from vibrocast.evaluation.points import Failure, Point, Timing, read_rows
from vibrocast.evaluation.results_page import Description, write_results
from vibrocast.evaluation.speed import Speed
from vibrocast.evaluation.tables import as_rows

SAMPLES = 1_000_000
MAX_CHART_BYTES = 200_000
SNRS_DB = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0)
DESCRIPTION = Description("recordings", "one core", "vibrocast bench recordings --out docs/benchmarks")


def curve(
    codec: str, trace: str = "a", rate_factor: float = 1.0, snrs_db: Sequence[float] = SNRS_DB, source: str = "measured"
) -> list[Point]:
    """Return points of bits per sample = rate_factor * 2^(SNR / 12) / 2, all other qualities rising with the SNR."""
    return [
        Point(
            trace,
            codec,
            f"{snr_db} dB",
            SAMPLES,
            round(SAMPLES * rate_factor * 2 ** (snr_db / 12) / 16),
            snr_db,
            2800.0,
            snr_db + 13,
            *(1 - 10 ** (-(snr_db + 1) / 10),) * 3,
            3.0,
            delay_ms=20.0 * rate_factor,
            source=source,
        )
        for snr_db in snrs_db
    ]


def timed(points: Sequence[Point], encode_s: float, decode_s: float) -> list[Timing]:
    return [Timing(point.trace, point.codec, point.setting, encode_s, decode_s, point.source) for point in points]


def measured() -> Measurements:
    """Return three codecs on two traces: slp needs 1.9 times the bits of mdct and half the time, vcpwq four times."""
    mdct = curve("mdct") + curve("mdct", "b", 1.1)
    slp = curve("slp", rate_factor=1.9) + curve("slp", "b", 2.09)
    peer = curve("vcpwq", rate_factor=4, source="imported") + curve("vcpwq", "b", 4.4, source="imported")
    timings = timed(mdct, 2.0, 1.0) + timed(slp, 1.0, 0.5) + timed(peer, 0.1, 0.1)
    costs = [CodecCost("mdct", 9000, 5_000_000, "core"), CodecCost("slp", None, None, "")]
    return Measurements(mdct + slp + peer, timings, costs, [])


MEASURED = measured()


def of(*points: Point, timings: Sequence[Timing] = ()) -> Measurements:
    """Return measurements of points alone, or with timings."""
    return Measurements(points, timings, [], [])


def write(out: Path, measurements: Measurements) -> str:
    """Write the rows as a benchmark does, and the page; return the page."""
    (out / "results").mkdir(parents=True, exist_ok=True)
    bench.write(out / "results", measurements)
    write_results(out, measurements, DESCRIPTION)
    return (out / "results.md").read_text()


def test_a_mean_curve_spans_the_rates_of_every_recording() -> None:
    rows = [row for row in as_rows(mean_curves(MEASURED, SNR)) if row.codec == "mdct"]
    assert rows[0].bits_per_sample == pytest.approx(0.55)
    assert rows[-1].bits_per_sample == pytest.approx(2.0)
    for row in rows:
        first, second = (12 * math.log2(2 * row.bits_per_sample / factor) for factor in (1, 1.1))
        assert row.mean == pytest.approx((first + second) / 2, abs=0.01)
        assert second <= row.low <= row.mean <= row.high <= first
        assert row.traces == 2


def test_a_codec_that_lacks_a_recording_has_no_mean_and_one_too_short_to_compare_is_in_none() -> None:
    points = curve("mdct") + curve("mdct", "b") + curve("slp")
    measurements = of(*points, timings=timed(points, 1, 1))
    assert set(mean_curves(measurements, SNR)["codec"]) == {"mdct"}
    assert set(cost_points(measurements, SNR, TIMES)["codec"]) == {"mdct"}
    assert set(rate_excesses(measurements)["codec"]) == {"mdct", "slp"}
    short = Point("short", "mdct", "", 1, 24, 30.0, 2800.0, 30.0)
    assert_frame_equal(mean_curves(of(*points, short), SNR), mean_curves(measurements, SNR))
    assert of(short).compared == ["short"]


def test_imported_points_stand_aside_and_get_their_psnr_from_the_crest_factor() -> None:
    """Where the codec was measured, and on traces that were not."""
    points = curve("mdct") + curve("mdct", rate_factor=9, source="imported") + curve("peer", "c", source="imported")
    assert of(*points).curves == {"mdct": {"a": curve("mdct")}}
    only_imported = curve("peer", "c", source="imported")
    assert of(*only_imported).curves == {"peer": {"c": only_imported}}
    peer = [replace(point, psnr_db=None) for point in curve("peer", source="imported")]
    (imported,) = of(*curve("mdct"), *peer).curves["peer"].values()
    assert [point.psnr_db for point in imported] == [snr_db + 13 for snr_db in SNRS_DB]


def test_times_are_those_of_the_nearest_rate_and_the_front_is_of_measured_codecs() -> None:
    timings = [timing for point in MEASURED.points for timing in timed([point], point.bits_per_sample, 1.0)]
    marks = as_rows(cost_points(replace(MEASURED, timings=timings), SNR, TIMES))
    encoding = {(mark.bits_per_sample, mark.codec): mark for mark in marks if mark.cost == "encode_s_per_megasample"}
    assert encoding[1.6, "mdct"].value == pytest.approx((1.587 + 1.746) / 2, abs=0.001)
    assert encoding[1.6, "mdct"].quality == pytest.approx(12 * math.log2(3.2) - 6 * math.log2(1.1), abs=0.01)
    assert encoding[1.6, "mdct"].flash_bytes == 9000
    assert (1.6, "vcpwq") not in encoding and (3.0, "mdct") not in encoding
    decoding = [mark for mark in marks if mark.cost == "decode_s_per_megasample" and mark.bits_per_sample == 1.6]
    assert {mark.codec: mark.on_front for mark in decoding} == {"mdct": True, "slp": False}


def test_excess_bits_are_counted_from_the_best_of_each_recording() -> None:
    rows = {(row.trace, row.codec): row for row in as_rows(rate_excesses(MEASURED))}
    assert rows["a", "mdct"].bits_per_sample == pytest.approx(1.0, abs=0.001)
    assert {key: round(row.excess_percent) for key, row in rows.items()} == {
        (trace, codec): percent for trace in "ab" for codec, percent in (("mdct", 0), ("slp", 90), ("vcpwq", 300))
    }


def test_bd_rates_are_relative_to_every_anchor_at_every_quality() -> None:
    rows = as_rows(mean_bd_rates(trace_bd_rates(MEASURED)))
    snr = {(row.anchor, row.codec): round(row.mean) for row in rows if row.quality == "snr_db"}
    assert snr == {
        ("mdct", "slp"): 90,
        ("mdct", "vcpwq"): 300,
        ("slp", "mdct"): -47,
        ("slp", "vcpwq"): 111,
        ("vcpwq", "mdct"): -75,
        ("vcpwq", "slp"): -53,
    }
    assert {row.quality for row in rows} == {"snr_db", "psnr_db", "st_sim_2800", "st_sim_8000", "spqi"}
    assert {row.traces for row in rows} == {2}
    (by_cubic,) = [row for row in rows if (row.quality, row.anchor, row.codec) == ("psnr_db", "mdct", "slp")]
    assert by_cubic.cubic_mean == pytest.approx(90, abs=0.1)


def test_costs_are_of_the_codec_that_a_rate_point_set_belongs_to() -> None:
    rows = {row.codec: row for row in as_rows(curve_costs(MEASURED))}
    assert rows["mdct"].real_time_factor == pytest.approx(3.0 * 2800 / 1e6)
    assert (rows["mdct"].peak_memory_bytes, rows["mdct"].settings, rows["mdct"].delay_ms) == (5_000_000, 7, 21)
    assert (rows["vcpwq"].decoder_bytes, rows["vcpwq"].source) == (None, "imported")
    rate_point_set = next(rate_point_set for rate_point_set in CODECS["dct"].rate_point_sets if rate_point_set != "dct")
    costs = [CodecCost("dct", 7, None, "")]
    assert curve_costs(Measurements(curve(rate_point_set), [], costs, []))["decoder_bytes"].to_list() == [7]


def test_advice_follows_its_rules_and_never_names_an_imported_codec() -> None:
    exact = [replace(point, codec="exact", snr_db=math.inf, delay_ms=0.0) for point in curve("x", snrs_db=[24.0])]
    exact += [replace(point, trace="b") for point in exact]
    with_copy = replace(MEASURED, points=[*MEASURED.points, *exact])
    assert list(bits_to_reach(with_copy, 10)) == ["mdct", "slp", "exact", "vcpwq"]
    assert bits_to_reach(with_copy, 60) == {"exact": 2.0}
    advice, more = ({row.need: row for row in as_rows(recommendations(each))} for each in (MEASURED, with_copy))
    fewest = advice["the fewest bits at 10 dB SNR or more"]
    assert (fewest.codec, fewest.bits_per_sample) == ("mdct", pytest.approx(1.05 * 2 ** (10 / 12) / 2, rel=0.01))
    fastest = "the fastest decoder at 10 dB SNR or more, with at most {} times the fewest bits"
    assert [advice[fastest.format(times)].codec for times in ("1.1", "2")] == ["mdct", "slp"]
    assert advice["the smallest decoder and model, of those counted, at 10 dB SNR or more"].flash_bytes == 9000
    copy = "a copy, of 60 dB SNR or more, in the fewest bits"
    assert copy not in advice and more[copy].codec == "exact"
    assert more["the shortest delay at 10 dB SNR or more"].codec == "exact"


def test_the_bits_at_a_needed_snr_stand_with_delay_and_saving() -> None:
    points = [replace(point, delay_ms=None) if point.codec == "vcpwq" else point for point in MEASURED.points]
    rows = {row.codec: row for row in as_rows(at_needed_snr(replace(MEASURED, points=points)))}
    mdct, vcpwq = rows["mdct"], rows["vcpwq"]
    assert mdct.bits_per_sample == pytest.approx(1.05 * 2 ** (10 / 12) / 2, rel=0.01)
    assert mdct.bits_per_second == 2800 * mdct.bits_per_sample
    assert (mdct.delay_low_ms, mdct.delay_high_ms, mdct.delay_from) == (20, 22, "measured")
    assert mdct.anchor_percent is None
    assert (vcpwq.name, vcpwq.source, vcpwq.delay_from) == ("VC-PWQ", "imported", "frames")
    assert vcpwq.delay_low_ms == vcpwq.delay_high_ms == pytest.approx(512 / 2.8)
    assert (round(vcpwq.anchor_percent), vcpwq.recordings) == (-75, 2)
    mixed = [*MEASURED.points, *curve("mdct", "c"), *(replace(point, rate_hz=4000.0) for point in curve("slp", "c"))]
    assert at_needed_snr(of(*mixed))["bits_per_second"].null_count() > 0


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of `measured`, with failures; not to be changed."""
    out = tmp_path_factory.mktemp("page")
    failures = [Failure("a", "slp", f"step={number}", "a | b\n<c>") for number in range(25)]
    write(out, replace(MEASURED, failures=failures))
    return out


@pytest.fixture
def copied(written: Path, tmp_path: Path) -> Path:
    return shutil.copytree(written, tmp_path / "copied")


@pytest.mark.slow
def test_the_page_has_every_chart_and_is_drawn_again_from_its_files(written: Path, copied: Path) -> None:
    page, images = (written / "results.md").read_text(), sorted((written / "results").glob("*.svg"))
    assert len(images) == 11 and all(f"(results/{image.name})" in page for image in images)
    assert all(5000 < image.stat().st_size < MAX_CHART_BYTES for image in images)
    for words in (
        r"| a \| b &lt;c> | slp | 25 | a step=0 |",
        "`mdct` reaches 10 dB SNR with 0.94 bit/sample on average.",
        "| VC-PWQ | 3.74 | -75.0 % | 80 to 88 | ≈ 0.1 |",
        "| slp | +90.0 % |",
    ):
        assert words in page
    # The page itself keeps the commit of its figures.
    (copied / "results.md").write_text(f"# Results\n\n{page.splitlines()[-1]}\n")
    for path in (copied / "results").glob("*.svg"):
        path.unlink()
    result = CliRunner().invoke(results_page.main, [str(copied)])
    assert result.exit_code == 0, result.output
    files = [path.relative_to(written) for path in written.rglob("*.*")]
    assert len(files) > 20
    for file in files:
        assert (copied / file).read_bytes() == (written / file).read_bytes()
    assert "no codec has the values" in write(copied, of())
    assert list((copied / "results").glob("*.svg")) == []


def test_recordings_kept_apart_lead_the_page_and_files_that_cannot_be_drawn_are_named(copied: Path) -> None:
    results = copied / "results"
    (results / results_page.HELD_OUT).write_text(
        "codec,measure,peer,mean_percent,worst_percent\n"
        "mdct,SNR,VC-PWQ,-61.9,-47.8\nmdct,SNR,all peers,-47,-30.7\nmdct,SPQI,all peers,-41,-5\n"
    )
    (results / results_page.NOTE).write_text("Chosen on *these* recordings.\n")
    result = CliRunner().invoke(results_page.main, [str(copied)])
    assert result.exit_code == 0, result.output
    page = (copied / "results.md").read_text()
    assert "`mdct` needs fewer bits than the best of all peers: 47 % at equal SNR, 41 % at equal SPQI." in page
    assert "| VC-PWQ | 3.74 | -75.0 % | -61.9 % (worst -47.8 %) |" in page
    assert "\n\nChosen on *these* recordings.\n\n" in page
    for name, text, message in (
        (results_page.HELD_OUT, "codec,measure\n", "held_out.csv: no column"),
        ("description.csv", "data,machine,command\n", "description.csv: 0 rows"),
        ("description.csv", None, "No such file or directory; give the --out of a benchmark"),
    ):
        (results / name).unlink() if text is None else (results / name).write_text(text)
        result = CliRunner().invoke(results_page.main, [str(copied)])
        assert result.exit_code == 1 and message in result.output


WHATEVER = {
    "one codec and trace": curve("mdct"),
    "one point": curve("mdct", snrs_db=[12.0]),
    "a curve and a point": curve("other") + curve("mdct", snrs_db=[12.0]),
    "silence": [replace(point, snr_db=None, psnr_db=None, st_sim_2800=None, spqi=None) for point in curve("mdct")],
    "lossless": [
        replace(point, snr_db=math.inf, psnr_db=math.inf, st_sim_2800=1.0, spqi=1.0) for point in curve("flac")
    ],
    "lossless at the end": [*curve("mdct"), replace(curve("mdct", snrs_db=[30.0])[0], snr_db=math.inf)],
    "worthless": [replace(point, snr_db=-math.inf, st_sim_2800=-0.1, spqi=0.0) for point in curve("mdct")],
    "one quality": [replace(point, snr_db=3.0, psnr_db=20.0, st_sim_2800=1.2, spqi=0.5) for point in curve("mdct")],
    "odd names": curve("mdct", "only this | `trace` <b> $x_1$ \\") + curve("a | `codec` $x", "b"),
    "imported only": curve("peer", source="imported"),
}


@pytest.mark.slow
@pytest.mark.parametrize("points", WHATEVER.values(), ids=WHATEVER)
def test_a_page_of_whatever_there_is(tmp_path: Path, points: list[Point]) -> None:
    page = write(tmp_path, of(*points, timings=timed(points, 0.0, 1.0)))
    assert page.startswith("# Results\n") and page.endswith("\n")
    assert "nan" not in page
    shown = {name for name in page.split("(results/") if name.split(")")[0].endswith(".svg")}
    assert len(shown) == len(list((tmp_path / "results").glob("*.svg")))
    assert read_rows(tmp_path / "results" / "description.csv", Description) == [DESCRIPTION]


def learned() -> Measurements:
    """Return a learned codec that needs nine tenths of the bits of slp, on fingertip textures fewer than mdct too."""
    points = [*MEASURED.points, *curve("eva-16", "a", 1.71), *curve("eva-16", "b", 1.0)]
    costs = [*MEASURED.costs, CodecCost("eva-16", 10_000, 1, "", 4000, "eva", 16)]
    setting = "4.0 dB"
    speeds = [
        Speed("mdct", 1.6, "", setting, 1000, 1.6, 17.0, 0.5, 0.03),
        Speed("eva-16", 1.6, "core", setting, 1000, 1.6, 17.0, 0.3, 0.2),
        Speed("eva-16", 1.6, "onnx", setting, 1000, 1.6, 17.1, 0.05, 0.02),
    ]
    kinds = [TraceKind("a", "tool"), TraceKind("b", "fingertip")]
    return Measurements(points, MEASURED.timings, costs, [], speeds, kinds)


@pytest.mark.slow
def test_trained_models_are_compared_by_kind_and_results_of_few_points_are_marked(tmp_path: Path) -> None:
    few = [point for trace in "ab" for point in curve("few", trace, 0.5, (4.0, 10.0, 16.0, 22.0))]
    page = write(tmp_path, replace(learned(), points=[*learned().points, *few]))
    # +71 % on the tool's recording, 1 / 1.1 - 1 = -9.1 % on the fingertip's.
    assert "| eva-16 | +31.0 % (1 of 2) | -9.1 % (1 of 1) | +71.0 % (0 of 1) |" in page
    assert set(pl.read_csv(tmp_path / "results" / "learned_bd_rate.csv")["anchor"]) == {"few", "mdct", "slp", "vcpwq"}
    row = next(line for line in page.splitlines() if line.startswith("| few | -"))
    assert row.count("†") == 4 and "† marks fewer than 6 points" in page
    rates = pl.read_csv(tmp_path / "results" / "bd_rate_traces.csv")
    assert set(rates.filter(codec="few")["points"]) == {4}
    assert set(rates.filter(codec="slp")["points"]) == {len(SNRS_DB)}


def test_charts_of_the_papers_form_show_the_widest_autoencoder_and_its_anchor() -> None:
    few = learned()
    assert few.paper_pair == ["eva-16", "slp"]
    wider = curve("eva-32", "a") + curve("eva-32", "b")
    costs = [*few.costs, CodecCost("eva-32", 10_000, 1, "", 4000, "eva", 32), CodecCost("net", 1, 1, "", 1, "mdct")]
    assert Measurements([*few.points, *wider, *curve("net")], [], costs, []).paper_pair == ["eva-32", "slp"]
    assert MEASURED.paper_pair == ["slp", "mdct"]
    assert of(*curve("mdct")).paper_pair == ["mdct"]


def test_the_fit_goes_through_the_points_of_all_recordings() -> None:
    """Quality is a straight line of the logarithm of the ratio on each trace, so the fit lies between the traces'."""
    rows = [row for row in as_rows(ratio_points(learned(), [PSNR])) if row.codec == "slp"]
    fit = [row for row in rows if row.trace == FIT]
    assert {row.trace for row in rows} == {"a", "b", FIT}
    assert len(fit) > 10 and all(4 <= row.compression_ratio <= 64 for row in rows)
    for row in fit:
        of_a, of_b = (13 + 12 * math.log2(2 * 16 / row.compression_ratio / factor) for factor in (1.9, 2.09))
        assert of_b - 0.5 < row.value < of_a + 0.5


def test_the_shaded_region_is_what_bd_rate_integrates() -> None:
    table = bd_regions(learned(), [PSNR, ST_SIM_2800])
    assert set(table["trace"]) == {"a"}  # of two traces, -52 and -10 %, the upper counts as the median
    assert set(table["codec"]) == {"eva-16", "slp"}
    region = {
        codec: as_rows(table.filter(codec=codec, quality="psnr_db", in_region=True)) for codec in ("eva-16", "slp")
    }
    for test, anchor in zip(*region.values(), strict=True):
        assert test.value == anchor.value and 18 <= test.value <= 33
        assert test.bits_per_sample == pytest.approx(0.9 * anchor.bits_per_sample, rel=1e-3)
        assert test.percent == pytest.approx(-10, abs=0.1)
    points = table.filter(codec="slp", quality="psnr_db", in_region=False)
    assert points["value"].to_list() == [snr_db + 13 for snr_db in SNRS_DB]
    assert bd_regions(of(*curve("mdct")), [PSNR]).is_empty()
