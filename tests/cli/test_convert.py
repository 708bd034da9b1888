"""Tests of `convert`, and of clips in the commands that take recordings."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command import ROOT, answer, fails, succeeds
from vibrocast import textures

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


def test_a_clip_is_not_written_over(tmp_path: Path) -> None:
    clip = tmp_path / "clip.ahap"
    clip.write_bytes(KNOCK.read_bytes())
    assert "must end in .wav or" in fails(2, "convert", clip, clip)


@pytest.mark.usefixtures("simulated_time")
def test_a_folder_with_clips_and_recordings_plays(tmp_path: Path) -> None:
    for path in (KNOCK, ROOT / "examples" / "taps.wav"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert "played 2 track(s)" in succeeds("play", tmp_path)
    assert "decoded as sent  yes" in succeeds("play", KNOCK)
