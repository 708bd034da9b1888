"""A serial port at 115 200 baud, with default settings: playing, live streams and uploads in simulated time."""

from pathlib import Path

import numpy as np
import pytest

from tests.conftest import linked
from vibrocast import models, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.messages import State
from vibrocast.host import live, playback, uploader
from vibrocast.host.controller import Controller
from vibrocast.host.devices import session_with
from vibrocast.host.live import LiveStream
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault
from vibrocast.simulated_device.memory_link import MemoryLink

OAK = Path(__file__).parents[2] / "examples/oak.wav"
BITS_PER_S = 0.8 * 115_200
SIMULATED = Settings()
# As in firmware/build.py; the link carries less than this board captures.
STM32F405 = Settings(channels=2, buffer_samples=16_384, capture_samples=2048)


def connect(settings: Settings = SIMULATED) -> tuple[MemoryLink, Controller]:
    """Return a session over a link of 115 200 baud."""
    return linked(settings, [Fault(bits_per_second=BITS_PER_S)])


@pytest.mark.parametrize("settings", [SIMULATED, STM32F405])
def test_a_texture_plays_without_a_gap_while_it_is_read_back(settings: Settings) -> None:
    link, controller = connect(settings)
    encoding = encode_recording(textures.load(OAK), live=True)
    began_s = link.clock()
    report = playback.play(session_with(controller, "slow"), OAK.name, encoding.stream, encoding).report
    assert (report.underruns, report.lost_packets, report.wire.bad_frames, report.wire.bad_frames_back) == (0, 0, 0, 0)
    assert report.reconnects == 0
    assert not report.differs
    # Hardly a frame is sent twice, there or back.
    assert (report.wire.bytes_sent or 0) < 2.5 * (report.stream_bytes or 0)
    assert (report.wire.bytes_received or 0) < 56_000
    if settings is STM32F405:
        assert report.comparison_note is not None
        assert "the link or this computer is too slow" in report.comparison_note
    else:
        assert report.decoded_equals_offline is report.dac_equals_offline is True
        assert link.clock() - began_s < 10.0


@pytest.mark.parametrize(("rate_hz", "channels"), [(2800, 1), (2800, 4), (8000, 1)])
def test_a_live_stream_loses_nothing(rate_hz: int, channels: int) -> None:
    _, controller = connect()
    texture = textures.GENERATORS["wood"](seconds=3.0, rate_hz=rate_hz)
    samples = np.tile(texture.samples, channels)
    peaks, rms = np.max(np.abs(samples), axis=0), np.sqrt(np.mean(np.square(samples), axis=0))
    stream = LiveStream(controller, live_format(rate_hz, texture.unit, peaks.tolist(), rms.tolist()))
    result = live.play(stream, (block for _, block in live.paced(stream, samples)))
    assert result.status.state == State.FINISHED
    assert (result.underruns, result.lost_packets, result.dropped_packets, result.streams) == (0, 0, 0, 1)


def test_an_upload_sends_every_piece_once() -> None:
    link, controller = connect()
    image = models.find("eva-16-3").image
    began_s = link.clock()
    uploader.flash(controller, image)
    assert link.clock() - began_s < 1.2 * len(image) / (BITS_PER_S / 8)
    assert controller.bytes_sent < 1.05 * len(image)
