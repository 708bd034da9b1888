"""An excerpt of each kind of shared recording, played in real time through controllers that need no hardware."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vibrocast import textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.host import playback
from vibrocast.host.devices import connect, session_with

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
EXCERPT_S = 0.5

KINDS: dict[str, dict[str, Any]] = {
    "lmt_acceleration/Brick_3_Z.wav": {},
    "textsense_fingertip/text9_v4.wav": {},
    "p1918_reference/Direct_-_1spike_Probe_-_polyesterPad_-_slow_X.txt": {"unit": "m/s^2"},
    "vibviz_effects/v-09-11-4-8.wav": {},
    "surface_profiles/mts_Bu_1_56_ak.csv": {"hand_speed_mm_s": 20},
    "vibtac12/texture3.wav": {},
    "biotac_training.npz": {"key": "mat1_1", "unit": "full scale"},
}


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not beside this checkout")
@pytest.mark.parametrize("device", ["sim", "cortex-m4"])
@pytest.mark.parametrize("name", KINDS)
def test_every_kind_plays_as_computed(name: str, device: str) -> None:
    recording = textures.load(DATA / name, **KINDS[name])
    count = round(EXCERPT_S * recording.rate_hz)
    first = max(0, len(recording.samples) - count) // 2
    encoding = encode_recording(replace(recording, samples=recording.samples[first : first + count]), live=True)
    with connect(device) as controller:
        report = playback.play(session_with(controller, device), name, encoding.stream, encoding).report
    assert (report.underruns, report.lost_packets, report.reconnects) == (0, 0, 0)
    assert report.decoded_equals_offline is True
    assert report.dac_equals_offline is True
