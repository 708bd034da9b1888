"""`vibrocast encode` with a policy: constant and capped rates, and what cannot be asked for."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from vibrocast import textures
from vibrocast.codec import rate_controlled
from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.codec.stream import read_stream
from vibrocast.host.cli.command_line import main

OAK = Path(__file__).parents[2] / "examples" / "oak.wav"


def encode(out: Path, *options: str) -> str:
    result = CliRunner().invoke(main, ["encode", str(OAK), str(out), *options])
    return result.output


def test_a_constant_rate_is_reported_with_its_frames(tmp_path: Path) -> None:
    out = tmp_path / "oak.vct"
    printed = encode(out, "--constant-rate-bps", "1000")
    assert "bit/s of 1000" in printed
    added = re.search(r"frames add ([\d.]+) %", printed)
    assert added is not None
    assert 8 < float(added[1]) <= 12
    furthest = re.search(r"at most ([\d.]+) % off over 2 s", printed)
    assert furthest is not None
    assert float(furthest[1]) < 1
    assert read_stream(out).seconds == pytest.approx(textures.load(OAK).seconds, abs=0.01)


def test_a_capped_rate_is_reported(tmp_path: Path) -> None:
    out = tmp_path / "oak.vct"
    peak = re.search(r"at most (\d+) over 2 s; limit 4000", encode(out, "--capped-rate-bps", "4000", "--snr-db", "12"))
    assert peak is not None and 3000 < int(peak[1]) <= 4000
    assert " ms each, SNR" in encode(out, "--capped-rate-bps", "9000", "--error-db", "6", "--packet-ms", "50")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--constant-rate-bps", "1000", "--snr-db", "4"], "a constant rate sets the quality itself"),
        (["--constant-rate-bps", "1000", "--rate-bps", "4"], "exclude each other"),
        (["--capped-rate-bps", "1000", "--constant-rate-bps", "1000"], "exclude each other"),
        (["--capped-rate-bps", "1000"], "--capped-rate-bps needs a quality; give either --snr-db or --error-db"),
        (["--capped-rate-bps", "1000", "--snr-db", "4", "--error-db", "0"], "give either --snr-db or --error-db"),
        (["--spatial", "--packet-ms", "20"], "a profile has no time"),
        (["--equal-error"], "--equal-error is for rate control; add one of --constant-rate-bps"),
        (["--constant-rate-bps", "1000", "--packet-ms", "20"], "longer packets"),
        (["--constant-rate-bps", "9000", "--codec", "parametric"], "have one quality"),
        (["--constant-rate-bps", "9000", "--codec", "slp", "--equal-error"], "choose another codec"),
    ],
)
def test_an_impossible_target_is_reported(tmp_path: Path, options: list[str], told: str) -> None:
    printed = encode(tmp_path / "oak.vct", *options)
    assert told in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "oak.vct").exists()


def test_silence_has_a_rate_and_no_snr(tmp_path: Path) -> None:
    recording = textures.load(OAK)
    silence = textures.Recording(0 * recording.samples, recording.rate_hz, recording.unit, "silence")
    _, outcome = rate_controlled.encode(silence, RateTarget(constant_rate_bps=2000))
    assert outcome.furthest is not None
    assert abs(outcome.furthest) < 0.01
    assert outcome.padding > 0.5
    assert outcome.packet_snrs_db == ()
