"""`vibrocast encode --live`: constant and capped rates, and what cannot be asked for."""

import re
from pathlib import Path

import pytest

from tests.command import OAK, run
from vibrocast import textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.stream import read_stream


def encode(out: Path, *options: str) -> str:
    return run("encode", OAK, out, "--live", *options).output


def test_a_constant_rate_is_reported_with_its_frames(tmp_path: Path) -> None:
    out = tmp_path / "oak.vct"
    printed = encode(out, "--rate-bps", "1000")
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
    printed = encode(out, "--rate-bps", "4000", "--snr-db", "12")
    peak = re.search(r"at most (\d+) over 2 s; limit 4000", printed)
    assert peak is not None and 3000 < int(peak[1]) <= 4000
    assert " ms each, SNR 1" in printed


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--rate-bps", "100"], "choose 264 bit/s or more"),
        (["--rate-bps", "9000", "--codec", "parametric"], "have one quality"),
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
    outcome = encode_recording(silence, target=RateTarget(constant_rate_bps=2000)).outcome
    assert outcome is not None
    assert outcome.furthest is not None
    assert abs(outcome.furthest) < 0.01
    assert outcome.padding > 0.5
    assert outcome.packet_snrs_db == ()
