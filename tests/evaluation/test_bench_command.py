"""Tests of `vibrocast bench`: what it prints and writes, its exit codes, and what it rejects."""

import os
import shutil
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command import run, started
from vibrocast import codec, textures, workers
from vibrocast.evaluation import bench, cost, results_page, speed
from vibrocast.evaluation.points import Failure, Point, Timing, read_rows
from vibrocast.textures.generate import rough, wood

FAST = "g726,dct-threshold"


vibrocast_bench = partial(run, "bench")


def fails(exit_code: int, *arguments: object) -> str:
    """Return what is on stderr; the error is its last line, for a person, without a traceback."""
    result = vibrocast_bench(*arguments)
    assert result.exit_code == exit_code, result.output
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "unexpected" not in result.stderr
    return result.stderr


def here(pieces: Any, processes: int) -> bench.Outcomes:
    for key, work in pieces:
        try:
            yield key, work()
        except Exception as error:
            yield key, error


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure in this process, without the memory that codecs take, and draw no page."""
    monkeypatch.setattr(workers, "on_cores", here)
    monkeypatch.setattr(results_page, "write_results", lambda *_: None)
    monkeypatch.setattr(cost, "measure_costs", lambda *_: [])
    monkeypatch.setattr(speed, "measure", lambda *_: [])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "recordings").mkdir()
    textures.save(tmp_path / "recordings" / "rough.wav", rough(0, 0.3))
    textures.save(tmp_path / "recordings" / "wood.wav", wood(1, 0.3))
    return tmp_path / "recordings"


def test_figures_are_written_and_the_table_names_the_curves(folder: Path, tmp_path: Path) -> None:
    result = vibrocast_bench(folder, "--codecs", "g726", "--out", tmp_path / "out", "--repeats", "1")
    assert result.exit_code == 0, result.output
    assert "2 recordings, 1 curves, 4 settings" in result.stdout
    assert "g726" in result.stdout
    results = tmp_path / "out" / "results"
    assert len(read_rows(results / "points.csv", Point)) == 8
    assert len((results / "timings.csv").read_text().splitlines()) == 9
    assert (results / "costs.csv").read_text().splitlines()[1].startswith("g726,")
    assert "recordings, 2 recordings" in (tmp_path / "out" / "results.md").read_text().replace("`", "")


@pytest.mark.usefixtures("quick")
def test_failures_are_listed_and_the_exit_code_says_so(folder: Path, tmp_path: Path) -> None:
    np.savetxt(folder / "nan.csv", [0.0, np.nan, 1.0], header="rate_hz: 2800\n# unit: um")
    textures.save(folder / "stereo.wav", textures.Recording(np.zeros((99, 2)), 2800.0, "full scale", "stereo"))
    said = fails(1, folder, "--codecs", FAST, "--out", tmp_path / "out", "--repeats", "0")
    assert "failed: nan: " in said and "is nan" in said
    assert "failed: dct-threshold: stereo" in said and "and 10 more: the detection threshold is a" in said
    assert "12 recordings or cells failed" in said
    failures = read_rows(tmp_path / "out" / "results" / "failures.csv", Failure)
    assert {failure.trace for failure in failures} == {"nan", "stereo"}
    assert {point.trace for point in read_rows(tmp_path / "out" / "results" / "points.csv", Point)} == {
        "rough",
        "stereo",
        "wood",
    }


@pytest.mark.usefixtures("quick")
def test_a_rate_point_set_that_needs_a_unit_is_left_out_unless_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir()
    signal = textures.Recording(wood(1, 0.2).samples, 2800.0, "full scale", "plain")
    textures.save(tmp_path / "recordings" / "plain.wav", signal)
    arguments = (tmp_path / "recordings", "--out", tmp_path / "out", "--repeats", "0", "--codecs")
    result = vibrocast_bench(*arguments, "dct")
    assert result.exit_code == 0, result.output
    assert (
        "left out, because no recording states a physical unit (--unit, or a manifest): dct-threshold" in result.stdout
    )
    fails(1, *arguments, "dct-threshold")
    manifest = tmp_path / "manifest.csv"
    manifest.write_text("file,unit,full_scale\nrecordings/plain.wav,m/s^2,10\n")
    result = vibrocast_bench(manifest, *arguments[1:], "dct")
    assert result.exit_code == 0, result.output
    assert "dct-threshold" in result.stdout and "left out" not in result.stdout


@pytest.mark.usefixtures("quick")
def test_peers_and_programs_join(folder: Path, tmp_path: Path) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text("trace,codec,setting,samples,bytes_total,snr_db\nwood,other,1,840,100,9\n")
    (tmp_path / "copy.toml").write_text(
        '[copy]\nencoder = ["cp", "{input}", "{output}"]\ndecoder = ["cp", "{input}", "{output}"]\n'
        '[lost]\nencoder = ["no-such-program"]\ndecoder = ["no-such-program"]\n'
    )
    arguments = ("--codecs", "g726", "--out", tmp_path / "out", "--peers", peers, "--programs", tmp_path / "copy.toml")
    said = fails(2, folder, *arguments)
    assert "copy.toml: [copy] starts the program 'cp'; read the file, and pass --allow-programs" in said
    said = fails(1, folder, *arguments, "--allow-programs")
    assert "lost: rough and 1 more: lost: no-such-program not found" in said
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    assert [(point.trace, point.codec) for point in points if point.source == "imported"] == [("wood", "other")]
    copies = [point for point in points if point.codec == "copy"]
    assert len(copies) == 2 and all(point.snr_db and point.snr_db > 60 for point in copies)
    timings = read_rows(tmp_path / "out" / "results" / "timings.csv", Timing)
    assert {(one.codec, one.source) for one in timings} == {("g726", "measured"), ("copy", "program")}


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "wood.wav,other,1,840,100,9,",
            "row 3, trace: the data set has no 'wood.wav'; expected one of 2 names such as 'wood'",
        ),
        ("wood,other,1,9999,100,9,", "row 3, samples: 9999; expected 840, as 'wood' has here"),
        ("wood,other,1,840,100,9,8000", "row 3, rate_hz: 8000; expected 2800"),
    ],
)
def test_peers_on_other_recordings_are_rejected(folder: Path, tmp_path: Path, row: str, message: str) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text(f"trace,codec,setting,samples,bytes_total,snr_db,rate_hz\nrough,other,1,840,100,9,2800\n{row}\n")
    said = fails(2, folder, "--codecs", "flac", "--out", tmp_path / "out", "--peers", peers, "--repeats", "0")
    assert f"{peers}, {message}" in said
    assert not (tmp_path / "out" / "results" / "points.csv").exists()


@pytest.mark.usefixtures("quick")
def test_peers_on_the_other_part_are_left_out(folder: Path, tmp_path: Path) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text(
        "trace,codec,setting,samples,bytes_total,snr_db\nrough,other,1,840,100,9\nwood,other,1,840,100,9\n"
    )
    arguments = (folder, "--codecs", "flac", "--out", tmp_path / "out", "--peers", peers, "--repeats", "0")
    assert vibrocast_bench(*arguments, "--split", "test").exit_code == 0
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    assert len({point.trace for point in points}) == 1
    assert {point.codec for point in points} == {"flac", "other"}


@pytest.mark.usefixtures("quick")
def test_a_column_that_peers_do_not_have_is_rejected(folder: Path, tmp_path: Path) -> None:
    peers = tmp_path / "peers.csv"
    peers.write_text("trace,codec,setting,samples,bytes_total,snr_db,psnr\nwood,other,1,840,100,9,20\n")
    said = fails(2, folder, "--out", tmp_path / "out", "--peers", peers)
    assert "row 1: no column is called 'psnr'; expected some of trace" in said


@pytest.mark.usefixtures("quick")
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
    arguments = (data, "--codecs", "flac", "--repeats", "0", "--unit", "m/s^2")
    for _ in range(2):  # the second time the results lie in the folder, and are no recordings
        result = vibrocast_bench(*arguments, "--out", data / "out")
        assert result.exit_code == 0, result.output
        assert "skipped 1 file: notes.md (of another kind)" in result.stderr
        assert "relative to full scale: deep/fast and 2 more; a manifest gives the full" in result.stdout
    assert (data / "out" / "results" / "skipped.csv").read_text() == "file,reason\nnotes.md,of another kind\n"
    points = read_rows(data / "out" / "results" / "points.csv", Point)
    assert {point.trace: point.rate_hz for point in points} == {
        "Direct_-_Probe_-_cork_-_slow": 2800,
        "deep/fast": 10_000,
        "fast": 8000,
        "slow": 1000,
        "stated": 2800,
    }


@pytest.mark.usefixtures("quick")
def test_an_offset_does_not_change_the_quality(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    texture = wood(1, 1.0)
    for name, offset in (("flat", 0.0), ("gravity", 9.81)):
        shifted = textures.Recording(texture.samples + offset, texture.rate_hz, "m/s^2", name)
        textures.save(tmp_path / "data" / f"{name}.wav", shifted, sixteen_bit=False)
    arguments = (tmp_path / "data", "--codecs", "mdct-live", "--repeats", "0")
    result = vibrocast_bench(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "more than 50% of the energy of gravity (--keep-dc" in result.stdout
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    flat, gravity = ([point.snr_db for point in points if point.trace == name] for name in ("flat", "gravity"))
    np.testing.assert_allclose(np.array(flat, float), np.array(gravity, float), atol=0.02)
    result = vibrocast_bench(*arguments, "--out", tmp_path / "kept", "--keep-dc")
    assert "removed below" not in result.stdout
    kept = read_rows(tmp_path / "kept" / "results" / "points.csv", Point)
    assert kept[0].bytes_total > 0 and [p.snr_db for p in kept if p.trace == "gravity"] != gravity


@pytest.mark.usefixtures("quick")
def test_a_manifest_in_place_of_a_folder(folder: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "manifest.csv"
    manifest.write_text(
        "file,material,split,rate_hz\nrecordings/rough.wav,cork,train,\nrecordings/wood.wav,oak,test,\n"
        "recordings/wood.npy,oak,test,1000\n"
    )
    arguments = (manifest, "--codecs", "flac", "--repeats", "0", "--out", tmp_path / "out", "--split", "test")
    assert "row 4, file: recordings/wood.npy does not exist" in fails(2, *arguments)
    np.save(folder / "wood.npy", np.ones(100))
    result = vibrocast_bench(*arguments, "--unit", "m/s^2")
    assert result.exit_code == 0, result.output
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    assert {point.trace for point in points} == {"recordings/wood.npy", "recordings/wood.wav"}


@pytest.mark.usefixtures("quick")
def test_a_silent_recording_leaves_the_means_of_the_others(folder: Path, tmp_path: Path) -> None:
    textures.save(folder / "silent.wav", textures.Recording(np.zeros((900, 1)), 2800.0, "um", "silent"))
    textures.save(folder / "short.wav", textures.Recording(np.ones((1, 1)), 2800.0, "um", "short"))
    result = vibrocast_bench(folder, "--codecs", "mdct", "--out", tmp_path / "out", "--repeats", "0")
    assert result.exit_code == 0, result.output
    (row,) = (line.split() for line in result.stdout.splitlines() if line.split()[:1] == ["mdct"])
    assert len(row) == 6 and all(float(bits) < 16 for bits in row[1:5])


@pytest.mark.usefixtures("quick")
def test_a_part_of_the_recordings(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    for material in ("cork", "felt", "foam"):
        for pace in ("slow", "fast"):
            name = f"Direct_-_1spike_Probe_-_{material}_-_{pace}_X.txt"
            np.savetxt(tmp_path / "set" / name, wood(1, 0.1).samples)
    parts = {}
    for part in ("train", "test"):
        arguments = ("--unit", "m/s^2", "--codecs", "g726", "--repeats", "0", "--split-by", "material")
        result = vibrocast_bench(tmp_path / "set", "--out", tmp_path / part, "--split", part, *arguments)
        assert result.exit_code == 0, result.output
        points = read_rows(tmp_path / part / "results" / "points.csv", Point)
        parts[part] = {point.trace.split("_-_")[2] for point in points}
    assert not parts["train"] & parts["test"]
    assert len(parts["train"]) == 2


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_used_is_rejected(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert "no such folder" in fails(2, tmp_path / "missing", "--out", out)
    assert "no recordings" in fails(2, tmp_path / "empty", "--out", out)
    assert "no codec or set of rate points 'mp3'" in fails(2, folder, "--out", out, "--codecs", "mp3")
    assert "does not state the material" in fails(2, folder, "--out", out, "--split", "test", "--split-by", "material")
    assert "no column trace" in fails(2, folder, "--out", out, "--peers", Path(__file__))
    assert "not a TOML file" in fails(2, folder, "--out", out, "--programs", Path(__file__))
    assert "Missing option '--out'" in fails(2, folder)
    (tmp_path / "thesis" / "results").mkdir(parents=True)
    (tmp_path / "thesis" / "results.md").touch()
    assert "choose another --out" in fails(2, folder, "--out", tmp_path / "thesis")
    assert not out.exists()
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    assert "no Dask scheduler answers" in fails(1, folder, "--out", out, "--scheduler", "tcp://127.0.0.1:1")


@pytest.mark.usefixtures("quick")
def test_a_run_in_which_all_fails_still_says_so(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        path.write_bytes(b"RIFF")
    said = fails(1, folder, "--codecs", "g726", "--out", tmp_path / "out")
    assert "2 recordings or cells failed" in said
    assert read_rows(tmp_path / "out" / "results" / "points.csv", Point) == []


@pytest.mark.slow
def test_interrupted_it_ends_in_one_line_and_keeps_what_it_has(folder: Path, tmp_path: Path) -> None:
    for copy in range(20):
        shutil.copy(folder / "wood.wav", folder / f"wood{copy}.wav")
    journal = tmp_path / "cut" / "results" / bench.JOURNAL
    with started("bench", folder, "--codecs", "mdct", "--out", tmp_path / "cut", session=True) as process:
        while process.poll() is None and not (journal.exists() and journal.stat().st_size):
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)  # to all processes, as a terminal does
        said = process.communicate(timeout=30)[1]
    assert process.returncode == 130
    assert [line for line in said.splitlines() if line and "measuring" not in line] == ["error: interrupted"]
    kept = journal.read_bytes().count(b"\n")
    assert 0 < kept < 22 * len(codec.CODECS["mdct"].rate_point_sets["mdct"])
    assert not (tmp_path / "cut" / "results" / "points.csv").exists()
