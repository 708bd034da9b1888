"""Tests of the command that compares rate and distortion with peers."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from evaluation import rate_distortion
from evaluation.bd_rate import bd_rate, summary
from evaluation.points import by_codec_and_trace, read_points, write_points
from tests.evaluation.curves import curve
from textures import save_wav
from textures.generate import rough

SHARED = Path(__file__).parents[2] / ".." / "shared"


def write_recordings(folder: Path) -> list[Path]:
    paths = [folder / "first.wav", folder / "second.wav"]
    for seed, path in enumerate(paths):
        save_wav(path, rough(seed, 0.5))
    return paths


def test_finer_steps_cost_more_and_are_nearer(tmp_path: Path) -> None:
    path = write_recordings(tmp_path)[0]
    points = [rate_distortion.measure(path, "mdct", step) for step in rate_distortion.STEPS]
    assert all(point.samples == 1400 and point.trace == "first" for point in points)
    assert points[0].snr_db < 5 and points[-1].snr_db > 20
    sizes, snrs_db = [point.bytes_total for point in points], [point.snr_db for point in points]
    assert sizes == sorted(sizes) and snrs_db == sorted(snrs_db)


def test_the_command_writes_points_rates_and_charts(tmp_path: Path) -> None:
    write_recordings(tmp_path)
    snrs_db = [0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0]
    peers = [point for trace in ("first", "second") for point in curve(snrs_db, trace=trace, codec="peer")]
    write_points(tmp_path / "peers.csv", [*peers, *curve(snrs_db[:3], trace="first", codec="too short")])
    arguments = [str(tmp_path), "--peers", str(tmp_path / "peers.csv"), "--out", str(tmp_path / "deep" / "out")]
    result = CliRunner().invoke(rate_distortion.main, arguments)
    assert result.exit_code == 0, result.output
    assert "peer" in result.output and "too short" not in result.output
    out = tmp_path / "deep" / "out"
    points = read_points(out / "rate_distortion_points.csv")
    assert len(points) == 2 * len(rate_distortion.STEPS)
    record = json.loads((out / "rate_distortion.json").read_text())
    ours = by_codec_and_trace(points)["mdct"]["first"]
    expected = bd_rate(by_codec_and_trace(peers)["peer"]["first"], ours)
    assert expected is not None
    assert record["bd_rate"]["peer"]["first"]["percent"] == pytest.approx(expected.percent)
    assert record["summary"]["peer"]["traces"] == 2
    assert f"| peer | {record['summary']['peer']['mean']:+.1f} % |" in (out / "rate_distortion.md").read_text()
    for name in ("rate_distortion.png", "rate_distortion_traces.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("wav", "peers", "message"),
    [(False, "trace\n", "no WAV files"), (True, "trace\n", "no column codec")],
)
def test_the_command_says_what_is_wrong(tmp_path: Path, wav: bool, peers: str, message: str) -> None:
    if wav:
        write_recordings(tmp_path)
    (tmp_path / "peers.csv").write_text(peers)
    result = CliRunner().invoke(rate_distortion.main, [str(tmp_path), "--peers", str(tmp_path / "peers.csv")])
    assert result.exit_code == 1
    assert message in result.output


def test_a_file_that_is_no_recording_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.wav").write_bytes(b"RIFF")
    write_points(tmp_path / "peers.csv", [])
    result = CliRunner().invoke(rate_distortion.main, [str(tmp_path), "--peers", str(tmp_path / "peers.csv")])
    assert result.exit_code == 1
    assert "broken.wav: not a WAV file" in result.output


@pytest.mark.skipif(not SHARED.is_dir(), reason="the development recordings are not here")
@pytest.mark.parametrize(("peer", "percent"), [("vcpwq", -48), ("speex_nb@relabel", -33)])
def test_the_codec_beats_its_peers(peer: str, percent: float) -> None:
    """Three traces stand for the eleven, to be quick; the command gives the figures of all."""
    names = ("lmt-Brick_3_Z", "textsense-text9_ref", "p1918-polyesterPad_-_slow_X")
    paths = [SHARED / "peers" / "dev_2800" / f"{name}.wav" for name in names]
    points = [rate_distortion.measure(path, "mdct", step) for path in paths for step in rate_distortion.STEPS]
    rates = rate_distortion.compare(points, read_points(SHARED / "peers" / "dev_2800.csv"), "mdct")
    assert summary([rates[peer][name] for name in names]).mean < percent
