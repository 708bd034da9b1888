"""The plan file: a written plan is read again, mistakes are errors, and a plan codes as it states."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from tests.planner.scenes import scene
from vibrocast.codec.threshold import sites
from vibrocast.errors import InputError
from vibrocast.planner.plan_file import (
    Forecast,
    Plan,
    PlannedController,
    PlannedTexture,
    prepared,
    read_plan,
    write_plan,
)
from vibrocast.planner.scene import Source
from vibrocast.textures import Recording

FORECAST = Forecast(
    payload_bps=1000.5,
    wire_bps=1200.0,
    load_percent=2.5,
    flash_bytes=30_000,
    ram_bytes=40_000,
    snr_db=12.25,
    spqi=0.9,
    third_octave_distance_db=3.0,
    error_over_threshold_db=-9.0,
    delay_ms=45.5,
)


def plan(folder: Path) -> Plan:
    read = scene(folder)
    texture = PlannedTexture(
        name="wood",
        source=read.textures[0].source,
        controller="one",
        hand_speed_mm_s=60.0,
        over_position=False,
        codec="mdct",
        model=None,
        setting={
            "step": 0.7,
            "rd_weight": 1.0,
            "hop": "32",
            "rotation": "none",
            "noise_filling": 0.03125,
            "shape": "flat",
        },
        rate=1600,
        lowest=30.0,
        highest=500.0,
        packet_samples=64,
        refresh_packets=5,
        buffer_ms=10.0,
        forecast=FORECAST,
    )
    return Plan(read.path, (PlannedController("one", "cortex-m4"),), read.actuators, (texture,))


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    written = plan(tmp_path)
    (tmp_path / "out").mkdir()
    write_plan(tmp_path / "out" / "plan.toml", written)
    read = read_plan(tmp_path / "out" / "plan.toml")
    assert read.threshold_path == written.threshold_path
    assert read.scene.resolve() == written.scene.resolve()
    assert replace(read, scene=written.scene) == written
    assert read.texture("wood").forecast == FORECAST
    capped = structs.replace(written.textures[0], capped_rate_bps=2450, packet_snr_db=9.5)
    write_plan(tmp_path / "out" / "capped.toml", replace(written, textures=(capped,)))
    assert read_plan(tmp_path / "out" / "capped.toml").textures == (capped,)
    with pytest.raises(InputError, match="the plan has no texture 'oak'; choose from wood"):
        read.texture("oak")


def test_a_plan_finds_its_files_from_its_folder_and_a_threshold_by_its_name(tmp_path: Path) -> None:
    written = plan(tmp_path)
    source = Source((tmp_path / "in" / "oak.wav",), None, {"unit": "m/s^2"})
    textures = (structs.replace(written.textures[0], source=source),)
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / "plan.toml"
    write_plan(path, replace(written, textures=textures, threshold_path=sites()["palm-large"]))
    assert 'file = ["../in/oak.wav"]' in path.read_text() and 'threshold = "palm-large"' in path.read_text()
    read = read_plan(path)
    assert read.textures[0].source.files[0].resolve() == source.files[0]
    assert read.threshold_path == sites()["palm-large"]


def test_a_texture_is_coded_as_planned(tmp_path: Path) -> None:
    (texture,) = plan(tmp_path).textures
    encoding = texture.encode()
    assert encoding.stream.header.rate_hz == 1600 and encoding.stream.packet_samples == 64
    assert encoding.stream.facts()["random_access_packets"] == -(-len(encoding.stream.packets) // 5)
    assert encoding.quality.snr_db is not None and encoding.quality.snr_db > 3


def test_what_is_below_the_band_is_taken_away_and_the_band_left_alone() -> None:
    time_s = np.arange(4000) / 2000
    low, tone = np.sin(2 * np.pi * 10 * time_s), np.sin(2 * np.pi * 100 * time_s)
    recording = Recording((low + tone)[:, None], 2000, "um", "two tones")
    cut = prepared(recording, 1.0, False, 2000, 60.0).samples[500:-500, 0]
    assert np.max(np.abs(cut - tone[500:-500])) < 0.02
    assert prepared(recording, 1.0, False, 2000, 0.0) is recording


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("rate = 1600", "rate = 40", "lowest = 30 must be below half of rate = 40"),
        ("[textures.options]", "[textures.options]\nfoo = 3", "[[textures]] 1: [options]: there is no key foo"),
        ('codec = "mdct"', 'codec = "mp3"', "[[textures]] 1: codec must be one of dct"),
        ("step = 0.7", "step = -1", "step is -1; it must be a number from"),
        ("rate = 1600", "rate = 1600\npacket_snr_db = 9", "capped_rate_bps and packet_snr_db go together"),
        ("format = 1", "format = 2", "format = 2 is out of range: version of the format"),
        ('controller = "one"\nhand', 'controller = "two"\nhand', "controller must be one of one, not 'two'"),
    ],
)
def test_a_mistake_in_a_plan_is_an_error_of_one_line(before: str, after: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    write_plan(path, plan(tmp_path))
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(InputError) as raised:
        read_plan(path)
    assert str(raised.value).startswith(f"{path}: ") and message in str(raised.value)


def test_files_that_changed_after_planning_are_reported(tmp_path: Path) -> None:
    file = tmp_path / "oak.csv"
    file.write_text("1\n2\n")
    source = Source((file,), None, {})
    texture = structs.replace(plan(tmp_path).textures[0], name="oak", source=source, sha256=source.sha256())
    file.write_text("1\n3\n")
    with pytest.raises(InputError, match=r"oak: .*oak.csv changed since the plan was made; plan the scene again"):
        texture.recording()
    file.unlink()
    with pytest.raises(InputError, match=r"oak: .*oak.csv does not exist; restore it, or plan the scene again"):
        texture.recording()
