"""Tests of `convert`, and of clips in the commands that take recordings."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command import OAK, ROOT, answer, fails, succeeds
from vibrocast import textures
from vibrocast.textures import clips

KNOCK = ROOT / "examples" / "clips" / "knock.ahap"


@pytest.mark.parametrize("suffix", textures.SAVED_SUFFIXES)
def test_a_clip_becomes_a_recording_of_every_format(suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"out{suffix}"
    facts = answer("convert", KNOCK, out)
    assert (facts["rate_hz"], facts["unit"], facts["seconds"]) == (8000, "full scale", 1)
    options: dict[str, Any] = {"rate_hz": 8000, "unit": "full scale"} if suffix == ".npy" else {}
    loaded = textures.load(out, **options)
    np.testing.assert_allclose(loaded.samples, textures.load(KNOCK).samples, atol=1e-7)


def test_the_constants_are_told(tmp_path: Path) -> None:
    told = succeeds("convert", KNOCK, tmp_path / "out.wav").splitlines()
    assert told[0].endswith("1.000 s at 8000 Hz, 1.0 is 1 full scale")
    assert told[1:] == [f"  {note}" for note in textures.load(KNOCK).notes]


@pytest.mark.parametrize("suffix", clips.WRITERS)
def test_a_texture_becomes_a_clip(suffix: str, tmp_path: Path) -> None:
    out, coded = tmp_path / f"out{suffix}", tmp_path / "oak.vct"
    facts = answer("convert", OAK, out)
    assert (facts["unit"], facts["seconds"]) == ("m/s^2", 4) and textures.load(out).seconds == pytest.approx(4)
    assert 0 < facts["quality"]["third_octave_distance_db"] < 12
    succeeds("encode", OAK, coded)
    told = succeeds("convert", coded, out).splitlines()
    assert re.search(r"4\.000 s, amplitude 1 is 1\d\.\d m/s\^2", told[0])
    assert re.match(r"  SNR -\d\.\d dB, third-octave distance \d+\.\d dB, log spectral distance \d+\.\d dB", told[1])
    assert re.fullmatch(r"  frequency limited to \d+ to \d+ Hz: \d+\.\d % of the energy", told[2])


def test_the_log_names_what_a_clip_leaves_open(tmp_path: Path) -> None:
    succeeds("--log", tmp_path / "log", "encode", KNOCK, tmp_path / "knock.vct")
    assert f"{KNOCK}: {'; '.join(textures.load(KNOCK).notes)}" in (tmp_path / "log").read_text()


def test_a_clip_is_not_written_over(tmp_path: Path) -> None:
    clip = tmp_path / "clip.ahap"
    clip.write_bytes(KNOCK.read_bytes())
    assert "are the same file" in fails(2, "convert", clip, clip)
    assert "must end in .wav or" in fails(2, "convert", clip, tmp_path / "clip.hjif")


@pytest.mark.usefixtures("simulated_time")
def test_a_folder_with_clips_and_recordings_plays(tmp_path: Path) -> None:
    for path in (KNOCK, ROOT / "examples" / "taps.wav"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert "played 2 track(s)" in succeeds("play", tmp_path)


@pytest.mark.usefixtures("simulated_time")
@pytest.mark.parametrize("path", sorted(KNOCK.parent.iterdir()), ids=lambda path: path.name)
def test_a_clip_of_each_format_plays(path: Path) -> None:
    told = succeeds("play", path)
    assert "decoded as sent  yes" in told and "DAC as computed  yes" in told
