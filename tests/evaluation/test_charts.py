"""Tests of the choice of curves in charts, of their labels, and of their files."""

from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import polars as pl
import pytest

from vibrocast import pictures
from vibrocast.evaluation import charts
from vibrocast.evaluation.bd_rate import SNR
from vibrocast.evaluation.comparison import best_of
from vibrocast.evaluation.curves import Curve, Panel
from vibrocast.evaluation.curves import curves as draw_curves
from vibrocast.evaluation.labels import spread
from vibrocast.evaluation.peers import named, peers

SVG = "{http://www.w3.org/2000/svg}"


def curves(*codecs: str) -> pl.DataFrame:
    """Return mean curves of two points; each codec is 1 dB better than the one before."""
    rows = [
        (codec, "measured", bits, 10 * bits + place, 5.0, 15.0)
        for place, codec in enumerate(codecs)
        for bits in (1.0, 2.0)
    ]
    return pl.DataFrame(rows, ["codec", "source", "bits_per_sample", "mean", "low", "high"], orient="row")


def texts(path: Path) -> list[str]:
    return ["".join(text.itertext()) for text in ElementTree.parse(path).iter(f"{SVG}text")]


@pytest.mark.parametrize(
    ("codec", "group"),
    [("mdct-live", "mdct"), ("mpeg_native", "mpeg"), ("dct-log", "dct"), ("g726@relabel", "g72"), ("haar", "haar")],
)
def test_a_curve_belongs_to_a_group(codec: str, group: str) -> None:
    assert charts.group_of(codec) == group


def test_a_group_is_drawn_by_its_own_name_or_else_by_its_best_curve() -> None:
    table = curves("slp", "mdct", "mdct-live", "eva-16", "eva-32", "haar")
    assert list(charts.mean_curves_by_group(table)) == ["mdct", "eva-32", "haar", "slp"]


def test_known_codecs_keep_their_colour_and_unknown_ones_get_one() -> None:
    assert charts.style_of("mdct-live").colour == charts.style_of("mdct").colour == pictures.BLUE
    assert charts.is_grey("slp") and not charts.is_grey("haar")
    colours = [style.colour for style in (*pictures.CODECS.values(), pictures.OTHERS)]
    assert len(set(colours)) == len(colours) and pictures.GREY not in colours


def test_a_chart_is_the_same_each_time_and_its_text_stays_text(tmp_path: Path) -> None:
    first, second = tmp_path / "first.svg", tmp_path / "second.svg"
    for path in (first, second):
        table = curves("mdct", "vcpwq", "slp")
        charts.plot_quality_against_rate(path, table, "A title", SNR, rate_hz=2800)
    assert first.read_bytes() == second.read_bytes()
    assert {"A title", "mdct", "VC-PWQ", "slp", "SNR, dB"} <= set(texts(first))
    assert any("2.8 kbit/s at 2800 Hz" in text for text in texts(first))


def test_the_first_look_has_few_lines(tmp_path: Path) -> None:
    table = curves("mdct", "vcpwq", "vcpwq_bl128", "slp", "eva-16", "opus", "opus_celt@relabel")
    charts.plot_comparison(tmp_path / "look.svg", table, "At equal SNR", None)
    drawn = set(texts(tmp_path / "look.svg"))
    assert {"mdct", "VC-PWQ", "Opus", "slp", "eva-16"} <= drawn
    assert not {"VC-PWQ, block 128", "Opus, CELT mode"} & drawn


def test_no_decoder_lies_above_the_line_of_loads(tmp_path: Path) -> None:
    """Of three, one takes more and gives less than another."""
    rows = [("mdct", 10.0, 1.0, 50_000), ("slp", 9.0, 2.0, 20_000), ("eva-16", 11.0, 4.0, 200_000)]
    table = pl.DataFrame(rows, ["codec", "value", "load_percent", "memory_bytes"], orient="row").with_columns(
        quality=pl.lit("snr_db"), cost=pl.lit("load of a processor, %")
    )
    assert best_of((load, value) for _, value, load, _ in rows) == [(1.0, 10.0), (4.0, 11.0)]
    charts.plot_loads(tmp_path / "load.svg", table, "Loads", [SNR])
    assert {"mdct", "slp", "eva-16", "load of a processor, %", "20 kB"} <= set(texts(tmp_path / "load.svg"))


def test_the_best_of_those_drawn_are_joined(tmp_path: Path) -> None:
    """A host's decoder, which is not drawn, does not push the controller's off the line."""
    rows = [("eva-16 (core)", 15.0, 1.0), ("eva-16 (onnx)", 15.0, 0.5), ("mdct", 17.0, 2.0)]
    marks = pl.DataFrame(rows, ["codec", "quality", "value"], orient="row").with_columns(
        bits_per_sample=1.6, source=pl.lit("measured"), cost=pl.lit("delay_ms"), flash_bytes=1
    )
    charts.plot_cost_points(tmp_path / "cost.svg", marks, "", SNR)
    assert {"eva-16", "mdct"} <= set(texts(tmp_path / "cost.svg"))
    paths = ElementTree.parse(tmp_path / "cost.svg").iter(f"{SVG}path")
    (line,) = (path for path in paths if f"stroke: {pictures.GREY}" in path.get("style", ""))
    assert line.get("d", "").split()[::3] == ["M", "L"]


def test_every_known_peer_has_a_name_of_its_own_or_shares_it_with_an_imported_one() -> None:
    assert named("vcpwq").software.startswith("IEEE 1918.1.1 reference software")
    assert named("mpeg_native_bl1024").delay_samples == 1024
    assert named("haar").name == "haar"
    labels = [peer.name for peer in peers().values() if "@" not in peer.codec]
    assert len(set(labels)) == len(labels)


def test_labels_that_fit_stay_at_their_targets() -> None:
    assert spread([0.2, 0.5, 0.9], [0.1, 0.1, 0.1]) == pytest.approx([0.2, 0.5, 0.9])
    assert spread([], []) == []


def test_labels_that_collide_move_apart_and_stay_in_the_panel() -> None:
    assert spread([0.5, 0.5], [0.1, 0.3]) == pytest.approx([0.5, 0.7])
    assert spread([0.9, 0.95], [0.1, 0.1]) == pytest.approx([0.85, 0.95])
    assert spread([0.0, 1.0], [0.2, 0.2]) == pytest.approx([0.1, 0.9])


def test_too_many_labels_shrink() -> None:
    heights = spread([0.5] * 20, [0.1] * 20)
    assert [after - before for before, after in pairwise(heights)] == pytest.approx([0.05] * 19)
    assert 0 < heights[0] < heights[-1] < 1


def test_names_of_curves_do_not_collide(tmp_path: Path) -> None:
    same = [Curve(f"curve {number}", [1, 2], [5, 5], [False, True]) for number in range(12)]
    draw_curves(tmp_path / "same.png", [Panel("", "", "", same, lines=(5,))])
    assert (tmp_path / "same.png").stat().st_size > 1000
