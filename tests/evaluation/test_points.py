"""Tests of the CSV files of measurements."""

import errno
import math
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.errors import InputError
from vibrocast.evaluation.points import Failure, Point, Timing, by_codec_and_trace, read_imported, read_rows, write_rows

SHARED = Path(__file__).parents[2] / ".." / "shared"
HEADER = "trace,codec,setting,samples,bytes_total,snr_db"
TIMED = f"{HEADER},encode_s,decode_s"


def test_points_come_back_from_a_file(tmp_path: Path) -> None:
    points = [
        Point("a, b", "mdct", 'step "1"', 100, 50, 12.5, 2800.0, 25.0, 0.99, 1.01, 0.8, 3.0, 22.5),
        Point("c", "peer", "", 7, 3, -1.0, source="imported"),
        Point("silent", "mdct", "", 7, 3, None),
        Point("exact", "flac", "", 7, 3, math.inf),
    ]
    write_rows(tmp_path / "points.csv", points, Point)
    assert read_rows(tmp_path / "points.csv", Point) == points
    lines = (tmp_path / "points.csv").read_text().splitlines()
    assert lines[0].startswith(HEADER) and lines[0].endswith("bits_per_sample")
    assert lines[1].endswith(",4.0") and (points[0].bits_per_sample, points[0].compression_ratio) == (4, 4)
    assert {point.source for point in read_imported(tmp_path / "points.csv")[0]} == {"imported"}
    failures = [Failure("a", "", "", 'no WAV file\n"a"')]
    write_rows(tmp_path / "failures.csv", failures, Failure)
    assert read_rows(tmp_path / "failures.csv", Failure) == failures


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column trace, codec"),
        ("trace,codec\na,b\n", "no column setting, samples"),
        (f"{HEADER}\na,b,c,many,1,1\n", "row 2, samples: invalid literal"),
        (f"{HEADER}\na,b,c,0,1,1\n", "row 2: samples and bytes must be positive"),
        (f"{HEADER}\na,b,c,1,{10**400},1\n", "row 2: samples and bytes must be positive"),
        (f"{HEADER}\na,b,c,1,1,nan\n", "row 2, snr_db: nan"),
        (f"{HEADER}\na,b,c,1,1,-inf\n", "row 2, snr_db: -inf"),
        (f"{HEADER},rate_hz\na,b,c,1,1,1,inf\n", "row 2: rate_hz and delay_ms must be finite"),
        (f"{HEADER},delay_ms\na,b,c,1,1,1,-1\n", "row 2: rate_hz and delay_ms must be finite"),
        (f"{HEADER}\na,b,c,1\n", "row 2"),
        *((f"{TIMED}\na,b,,1,1,1,{times}\n", "row 2: encode_s or") for times in ("soon,1", "1,nan", "inf,1", "-1,1")),
    ],
)
def test_rejected_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_imported(tmp_path / "points.csv")


def test_a_table_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    table = tmp_path / "failures.csv"
    table.write_text("before")

    def cut() -> Iterator[Failure]:
        yield Failure("wood", "mdct", "", "")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match=r"No space left .*failures\.csv"):
        write_rows(table, cut(), Failure)
    assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(table, "before")]


def test_imported_seconds_of_a_recording_become_seconds_per_million_samples(tmp_path: Path) -> None:
    (tmp_path / "peers.csv").write_text(f"{TIMED}\na,peer,-b 1,2000,10,5,0.004,0.002\na,peer,-b 2,2000,20,6,,\n")
    points, timings = read_imported(tmp_path / "peers.csv")
    assert [point.source for point in points] == ["imported", "imported"]
    assert timings == [Timing("a", "peer", "-b 1", 2.0, 1.0, "imported")]


@given(data=st.binary(max_size=200), headed=st.booleans())
def test_any_bytes_are_read_or_rejected(tmp_path_factory: pytest.TempPathFactory, data: bytes, headed: bool) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes((f"{TIMED}\n".encode() if headed else b"") + data)
    try:
        assert all(point.samples > 0 for point in read_imported(path)[0])
    except InputError as error:
        assert str(error)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the peers' points are not here")
def test_the_peers_are_read() -> None:
    points, timings = read_imported(SHARED / "peers" / "dev_2800.csv")
    curves = by_codec_and_trace(points)
    assert {len(curves[name]) for name in ("vcpwq", "speex_nb@relabel")} == {11}
    assert len(timings) == len(points) and {timing.source for timing in timings} == {"imported"}
