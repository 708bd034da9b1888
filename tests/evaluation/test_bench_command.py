"""Tests of `vibrocast bench`: what it prints and writes, its exit codes, and what it rejects."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from tests.command import run
from tests.evaluation.conftest import here
from vibrocast import textures, workers
from vibrocast.evaluation import cost, results_page, speed
from vibrocast.evaluation.points import Failure, Point, Timing, read_rows
from vibrocast.textures.generate import wood

FAST = "g726,dct-threshold"


@pytest.fixture(autouse=True)
def quick(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure in this process, without the memory that codecs take, and draw no page, unless the test is slow."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(workers, "on_cores", lambda tasks, processes: here(tasks))
        monkeypatch.setattr(results_page, "write_results", lambda *_: None)
        monkeypatch.setattr(cost, "measure_costs", lambda *_: [])
        monkeypatch.setattr(speed, "measure", lambda *_: [])


def points_in(out: Path) -> list[Point]:
    return read_rows(out / "results" / "points.csv", Point)


def measured(recordings: Path, out: Path, *arguments: object, repeats: int = 0) -> tuple[Result, list[Point]]:
    """Return what the command says, and its points."""
    result = run("bench", recordings, "--out", out, "--repeats", repeats, *arguments)
    assert result.exit_code == 0, result.output
    return result, points_in(out)


def fails(exit_code: int, *arguments: object) -> str:
    """Return what is on stderr; the error is its last line, for a person, without a traceback."""
    result = run("bench", *arguments)
    assert result.exit_code == exit_code, result.output
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "unexpected" not in result.stderr
    return result.stderr


@pytest.mark.slow
def test_figures_are_written_and_the_table_names_the_curves(folder: Path, tmp_path: Path) -> None:
    textures.save(folder / "silent.wav", textures.Recording(np.zeros((900, 1)), 2800.0, "um", "silent"))
    textures.save(folder / "short.wav", textures.Recording(np.ones((1, 1)), 2800.0, "um", "short"))
    result, points = measured(folder, tmp_path / "out", "--codecs", "g726", repeats=1)
    assert "4 recordings, 1 curves, 4 settings" in result.stdout
    (row,) = (line.split() for line in result.stdout.splitlines() if line.split()[:1] == ["g726"])
    assert len(row) == 5 and all(float(bits) < 16 for bits in row[1:])
    results = tmp_path / "out" / "results"
    assert len(points) == 16
    assert len((results / "timings.csv").read_text().splitlines()) == 17
    assert (results / "costs.csv").read_text().splitlines()[1].startswith("g726,")
    assert "recordings, 4 recordings" in (tmp_path / "out" / "results.md").read_text().replace("`", "")


def test_failures_are_listed_and_the_exit_code_says_so(folder: Path, tmp_path: Path) -> None:
    np.savetxt(folder / "nan.csv", [0.0, np.nan, 1.0], header="rate_hz: 2800\n# unit: um")
    textures.save(folder / "stereo.wav", textures.Recording(np.zeros((99, 2)), 2800.0, "full scale", "stereo"))
    said = fails(1, folder, "--codecs", FAST, "--out", tmp_path / "out", "--repeats", "0")
    assert "failed: nan: " in said and "is nan" in said
    assert "failed: dct-threshold: stereo" in said and "and 10 more: the detection threshold is a" in said
    assert "12 recordings or cells failed" in said
    failures = read_rows(tmp_path / "out" / "results" / "failures.csv", Failure)
    assert {failure.trace for failure in failures} == {"nan", "stereo"}
    assert {point.trace for point in points_in(tmp_path / "out")} == {"rough", "stereo", "wood"}


def test_a_rate_point_set_that_needs_a_unit_is_left_out_unless_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir()
    signal = textures.Recording(wood(1, 0.2).samples, 2800.0, "full scale", "plain")
    textures.save(tmp_path / "recordings" / "plain.wav", signal)
    result, _ = measured(tmp_path / "recordings", tmp_path / "out", "--codecs", "dct")
    said = "left out, because no recording states a physical unit (--unit, or a manifest): dct-threshold"
    assert said in result.stdout
    fails(1, tmp_path / "recordings", "--out", tmp_path / "out", "--repeats", "0", "--codecs", "dct-threshold")
    manifest = tmp_path / "manifest.csv"
    manifest.write_text("file,unit,full_scale\nrecordings/plain.wav,m/s^2,10\n")
    result, _ = measured(manifest, tmp_path / "out", "--codecs", "dct")
    assert "dct-threshold" in result.stdout and "left out" not in result.stdout


def test_peers_and_programs_join(folder: Path, tmp_path: Path) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text(f"{HEADER}\nwood,other,1,840,100,9\n")
    (tmp_path / "copy.toml").write_text(
        '[copy]\nencoder = ["cp", "{input}", "{output}"]\ndecoder = ["cp", "{input}", "{output}"]\n'
        '[lost]\nencoder = ["no-such-program"]\ndecoder = ["no-such-program"]\n'
    )
    arguments = ("--codecs", "g726", "--out", tmp_path / "out", "--peers", peers, "--programs", tmp_path / "copy.toml")
    said = fails(2, folder, *arguments)
    assert "copy.toml: [copy] starts the program 'cp'; read the file, and pass --allow-programs" in said
    said = fails(1, folder, *arguments, "--allow-programs")
    assert "lost: rough and 1 more: lost: no-such-program not found" in said
    points = points_in(tmp_path / "out")
    assert [(point.trace, point.codec) for point in points if point.source == "imported"] == [("wood", "other")]
    copies = [point for point in points if point.codec == "copy"]
    assert len(copies) == 2 and all(point.snr_db and point.snr_db > 60 for point in copies)
    timings = read_rows(tmp_path / "out" / "results" / "timings.csv", Timing)
    assert {(one.codec, one.source) for one in timings} == {("g726", "measured"), ("copy", "program")}


HEADER = "trace,codec,setting,samples,bytes_total,snr_db"
IMPORTED = "rough,other,1,840,100,9,2800"


@pytest.mark.parametrize(
    ("column", "row", "message"),
    [
        ("psnr", "wood,other,1,840,100,9,20", "row 1: no column is called 'psnr'; expected some of trace"),
        (
            "rate_hz",
            "wood.wav,other,1,840,100,9,",
            "row 3, trace: the data set has no 'wood.wav'; expected one of 2 names such as 'wood'",
        ),
        ("rate_hz", "wood,other,1,9999,100,9,", "row 3, samples: 9999; expected 840, as 'wood' has here"),
        ("rate_hz", "wood,other,1,840,100,9,8000", "row 3, rate_hz: 8000; expected 2800"),
    ],
)
def test_peers_on_other_recordings_are_rejected(
    folder: Path, tmp_path: Path, column: str, row: str, message: str
) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text(f"{HEADER},{column}\n{IMPORTED}\n{row}\n")
    said = fails(2, folder, "--codecs", "flac", "--out", tmp_path / "out", "--peers", peers, "--repeats", "0")
    assert f"{peers}, {message}" in said
    assert not (tmp_path / "out" / "results" / "points.csv").exists()


def test_one_folder_of_many_kinds_rates_and_folders(tmp_path: Path) -> None:
    data = tmp_path / "data"
    (data / "deep").mkdir(parents=True)
    for name, rate_hz in (("slow.wav", 1000), ("fast.wav", 8000), ("deep/fast.wav", 10_000)):
        plain = textures.Recording(wood(0, 0.2, rate_hz=rate_hz).samples, rate_hz, "full scale", name)
        textures.save(data / name, plain)
    (data / "stated.csv").write_text("# unit: g\n# rate_hz: 2800\n" + "1\n2\n" * 50)
    for axis in "XYZ":
        np.savetxt(data / f"Direct_-_Probe_-_cork_-_slow_{axis}.txt", wood(1, 0.1).samples)
    (data / "notes.md").touch()
    for _ in range(2):  # the second time the results lie in the folder, and are no recordings
        result, points = measured(data, data / "out", "--codecs", "flac", "--unit", "m/s^2")
        assert "skipped 1 file: notes.md (of another kind)" in result.stderr
        assert "relative to full scale: deep/fast and 2 more; a manifest gives the full" in result.stdout
    assert (data / "out" / "results" / "skipped.csv").read_text() == "file,reason\nnotes.md,of another kind\n"
    assert {point.trace: point.rate_hz for point in points} == {
        "Direct_-_Probe_-_cork_-_slow": 2800,
        "deep/fast": 10_000,
        "fast": 8000,
        "slow": 1000,
        "stated": 2800,
    }


def test_an_offset_does_not_change_the_quality(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    texture = wood(1, 1.0)
    for name, offset in (("flat", 0.0), ("gravity", 9.81)):
        shifted = textures.Recording(texture.samples + offset, texture.rate_hz, "m/s^2", name)
        textures.save(tmp_path / "data" / f"{name}.wav", shifted, sixteen_bit=False)
    result, points = measured(tmp_path / "data", tmp_path / "out", "--codecs", "mdct-live")
    assert "more than 50% of the energy of gravity (--keep-dc" in result.stdout
    flat, gravity = ([point.snr_db for point in points if point.trace == name] for name in ("flat", "gravity"))
    np.testing.assert_allclose(np.array(flat, float), np.array(gravity, float), atol=0.02)
    result, kept = measured(tmp_path / "data", tmp_path / "kept", "--codecs", "mdct-live", "--keep-dc")
    assert "removed below" not in result.stdout
    assert kept[0].bytes_total > 0 and [p.snr_db for p in kept if p.trace == "gravity"] != gravity


def test_what_cannot_be_used_is_rejected(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    assert "no such folder" in fails(2, tmp_path / "missing", "--out", out)
    assert "no codec or set of rate points 'mp3'" in fails(2, folder, "--out", out, "--codecs", "mp3")
    assert "does not state the material" in fails(2, folder, "--out", out, "--split", "test", "--split-by", "material")
    (tmp_path / "thesis" / "results").mkdir(parents=True)
    (tmp_path / "thesis" / "results.md").touch()
    assert "choose another --out" in fails(2, folder, "--out", tmp_path / "thesis")
    assert not out.exists()
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    assert "no Dask scheduler answers" in fails(1, folder, "--out", out, "--scheduler", "tcp://127.0.0.1:1")
