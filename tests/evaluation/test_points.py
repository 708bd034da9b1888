"""Tests of the CSV files of rate-distortion points."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.points import Point, PointsError, by_codec_and_trace, read_points, write_rows

SHARED = Path(__file__).parents[2] / ".." / "shared"
HEADER = "trace,codec,setting,samples,bytes_total,snr_db"


def test_points_come_back_from_a_file(tmp_path: Path) -> None:
    points = [Point("a, b", "mdct", 'step "1"', 100, 50, 12.5), Point("c", "mdct", "", 7, 3, -1.0)]
    write_rows(tmp_path / "points.csv", points, Point)
    assert read_points(tmp_path / "points.csv") == points
    assert (tmp_path / "points.csv").read_text().splitlines()[0].startswith(HEADER)
    assert points[0].bits_per_sample == 4


def test_points_are_sorted_by_codec_and_trace() -> None:
    points = [Point(trace, codec, "", 1, 1, 0.0) for codec in "xy" for trace in "abab"]
    curves = by_codec_and_trace(points)
    assert list(curves) == ["x", "y"]
    assert {trace: len(curve) for trace, curve in curves["y"].items()} == {"a": 2, "b": 2}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column trace, codec"),
        ("trace,codec\na,b\n", "no column setting, samples"),
        (f"{HEADER}\na,b,c,many,1,1\n", "row 2: invalid literal"),
        (f"{HEADER}\na,b,c,0,1,1\n", "row 2: samples and bytes must be positive"),
        (f"{HEADER}\na,b,c,1\n", "row 2"),
    ],
)
def test_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(PointsError, match=message):
        read_points(tmp_path / "points.csv")


@given(data=st.binary(max_size=200), headed=st.booleans())
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: bytes, headed: bool) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes((f"{HEADER}\n".encode() if headed else b"") + data)
    try:
        assert all(point.samples > 0 for point in read_points(path))
    except PointsError as error:
        assert str(error)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the peers' points are not here")
def test_the_peers_are_read() -> None:
    curves = by_codec_and_trace(read_points(SHARED / "peers" / "dev_2800.csv"))
    assert {len(curves[name]) for name in ("vcpwq", "speex_nb@relabel")} == {11}
