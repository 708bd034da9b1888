"""Recording: levels, clipping, losses, drift, early ends, and what is on the disk then."""

import json
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.device_protocol.transports import TransportError
from vibrocast.harness import recorder
from vibrocast.harness.recorder import Levels, record
from vibrocast.host.sources import AnalogueSensor
from vibrocast.textures import TextureError, sidecar
from vibrocast.textures.sensitivity import parse

RATE_HZ = 48_000
VOLTS = 2.0
SENSITIVITY = parse("100mV/(m/s^2)")


class Card:
    """A sound card that brings these blocks, and then fails; a block may also be lost, or be an error."""

    def __init__(self, blocks: Iterator[NDArray[np.float32] | BaseException | None]) -> None:
        self.rate_hz, self.overruns = RATE_HZ, 0
        self._blocks = blocks

    def read(self, timeout_s: float) -> NDArray[np.float32]:
        block = next(self._blocks, TransportError("the card is gone; it was unplugged"))
        if block is None:
            self.overruns += 1
            return self.read(timeout_s)
        if isinstance(block, BaseException):
            raise block
        return block


def sensor(blocks: list[NDArray[np.float32] | BaseException | None], axes: str = "xyz") -> AnalogueSensor:
    return AnalogueSensor("a card", Card(iter(blocks)), axes, 3, SENSITIVITY, VOLTS)


def blocks(
    seconds: float = 1.0, peak: float = 0.5, offset: float = 0.2
) -> list[NDArray[np.float32] | BaseException | None]:
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    tones = peak * np.sin(np.outer(times_s, 2 * np.pi * np.array([100.0, 200.0, 300.0]))) + offset
    return [tones[start : start + 480].astype(np.float32) for start in range(0, len(tones), 480)]


def facts(path: Path) -> dict[str, object]:
    content = json.loads(sidecar.path_of(path).read_text())
    assert isinstance(content, dict)
    return content


def test_volts_become_acceleration_without_the_offset(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    recorded = record(sensor(blocks(4.0)), path, seconds=4.0)
    assert recorded.warnings == ()
    assert recorded.peaks == pytest.approx((14.0,) * 3, rel=1e-3)  # 0.7 of 2 V at 0.1 V for a m/s^2
    recording = textures.load(path)
    assert (recording.unit, recording.axes, recording.rate_hz) == ("m/s^2", ("X", "Y", "Z"), RATE_HZ)
    settled = recording.samples[2 * RATE_HZ :]
    assert np.abs(settled.mean(axis=0)).max() < 0.02
    assert np.sqrt(2 * np.mean(np.square(settled), axis=0)) == pytest.approx([10.0] * 3, rel=1e-3)
    assert facts(path)["sensitivity"] == "100mV/(m/s^2)"
    assert facts(path)["full_scale"] == pytest.approx(20.0)
    assert facts(path)["highpass_hz"] == recorder.DRIFT_HZ


def test_an_offset_may_be_kept_and_channels_are_put_in_the_order_of_their_axes(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    levels = np.array([0.1, 0.2, 0.3], np.float32)
    record(sensor([np.tile(levels, (480, 1))], "zxy"), path, seconds=0.01, highpass_hz=None)
    assert textures.load(path).samples[0] == pytest.approx([4.0, 6.0, 2.0])


def test_clipping_is_counted_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    pieces = blocks(1.0, 0.5, 0.0)
    for number in (20, 21, 60):
        piece = pieces[number]
        assert isinstance(piece, np.ndarray)
        piece[:, 1] = 1.0
    single = pieces[80]
    assert isinstance(single, np.ndarray)
    single[7:9, 0] = 1.0  # two samples: a peak that just fits
    recorded = record(sensor(pieces), path, seconds=1.0)
    assert (recorded.clipping.runs, recorded.clipping.samples) == (2, 3 * 480)
    assert recorded.clipping.places == [(0.2, 2, 960), (0.6, 2, 480)]
    assert "clipped 2 times, first at 0.200 s, 0.600 s" in recorded.warnings[0]
    assert facts(path)["clipped"]["runs"] == 2  # type: ignore[index]


def test_overruns_are_counted_with_their_place(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    pieces = blocks()
    pieces[50:50] = [None]
    recorded = record(sensor(pieces), path, seconds=0.9)
    assert recorded.losses.places == [(0.5, None)]
    assert "lost 1 times, first at 0.500 s" in recorded.warnings[0]
    assert facts(path)["lost"] == {"gaps": 1, "samples": 0, "first": [{"at_s": 0.5, "samples": None}]}


def test_a_lost_card_leaves_what_came_before(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    with pytest.raises(TransportError, match=r"unplugged; the first 0.500 s are saved in .*out.wav"):
        record(sensor(blocks(0.5)), path, seconds=10.0)
    assert len(textures.load(path).samples) == RATE_HZ // 2
    assert facts(path)["samples"] == RATE_HZ // 2


def test_a_card_that_brings_nothing_leaves_an_earlier_file(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    record(sensor(blocks(0.1)), path, seconds=0.1)
    before = path.read_bytes()
    with pytest.raises(TransportError, match="unplugged"):
        record(sensor([]), path, seconds=1.0)
    assert path.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out.json", "out.wav"]


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of files")
def test_a_full_disk_leaves_a_file_and_its_sidecar(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4 << 20, before[1]))
    try:
        with pytest.raises(TransportError, match=r"the disk: File too large; free some space.* saved in"):
            record(sensor(blocks(10.0)), path, seconds=10.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    recording = textures.load(path)
    assert 7.0 < recording.seconds < 7.3  # of 7.28 s that fit, 64 kB make room for the sidecar
    assert facts(path)["samples"] == len(recording.samples)


def test_the_list_of_clipped_places_stays_short() -> None:
    levels = Levels(sensor([]))
    clipped = np.ones((10, 3)) * 20.0
    for _ in range(1000):
        levels.watch(clipped)
        levels.watch(0 * clipped)
    levels.finish()
    assert levels.clipping.runs == 3000
    assert len(levels.clipping.places) == 100


def test_a_file_that_would_be_too_large_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(TextureError, match="do not fit into a WAV file of 4 GiB"):
        record(sensor(blocks(0.1)), tmp_path / "out.wav", seconds=10_000)
    assert list(tmp_path.iterdir()) == []


@given(st.lists(st.lists(st.booleans(), min_size=1, max_size=12), max_size=12))
def test_runs_do_not_depend_on_the_pieces(pieces: list[list[bool]]) -> None:
    def watched(parts: list[list[bool]]) -> list[tuple[float, int, int]]:
        source = AnalogueSensor("a card", Card(iter([])), "", 1, SENSITIVITY, VOLTS)
        levels = Levels(source)
        for part in parts:
            levels.watch(np.where(np.array(part), 20.0, 0.0)[:, None])
        levels.finish()
        return levels.clipping.places

    whole = [each for part in pieces for each in part]
    assert watched(pieces) == watched([whole] if whole else [])
    runs = "".join("x" if each else " " for each in whole).split()
    assert [run for _, _, run in watched(pieces)] == [len(run) for run in runs if len(run) >= 3]
