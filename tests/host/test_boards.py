"""The README's streams on every controller that ships: each plays them to the end, as computed here."""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import vibrocast
from tests.conftest import session
from vibrocast import codec, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.host import devices, playback
from vibrocast.host.controller import Controller
from vibrocast.host.devices import session_with
from vibrocast.simulated_device.memory_link import MemoryLink
from vibrocast.simulated_device.serial_port import has_pseudo_terminals

README = Path(__file__).parents[2] / "README.md"
OAK = Path(__file__).parents[2] / "examples" / "oak.wav"
CONTROLLERS = [name for name in devices.SIMULATED if name != "host" or has_pseudo_terminals()]

every_controller = pytest.mark.parametrize("address", CONTROLLERS)


@contextlib.contextmanager
def opened(address: str) -> Iterator[Controller]:
    """Open a session, in simulated time where the controller allows it: then no busy computer makes a packet late."""
    emulated = devices.is_emulated(address)
    if not emulated and address not in devices.IN_THIS_PROCESS:
        with devices.connect(address) as controller:
            yield controller
        return
    device = devices.emulated(address) if emulated else devices.simulated("core")
    yield session(MemoryLink(device))


def check_plays(address: str, stream: Stream) -> playback.Playback:
    """Play a stream, and check that nothing was late and all is as computed."""
    with opened(address) as controller:
        outcome = playback.play(session_with(controller, address), "oak", stream)
    report = outcome.report
    assert report.underruns == report.lost_packets == 0
    assert report.dac_equals_offline is True
    # A board may keep fewer samples than a packet has.
    assert report.decoded_equals_offline is not False
    return outcome


@pytest.mark.slow
@every_controller
def test_the_readmes_stream_plays(address: str) -> None:
    text = README.read_text(encoding="utf-8")
    assert "vibrocast.encode(oak, snr_db=15)" in text
    stream = vibrocast.encode(vibrocast.load(OAK), snr_db=15)
    assert re.search(rf"^{stream.size_bytes} True$", text, re.MULTILINE)
    assert (check_plays(address, stream).stream != stream) == (address in ("stm32f405", "rp2040"))


@pytest.mark.slow
@every_controller
def test_the_readmes_recording_plays_as_play_codes_it(address: str) -> None:
    assert "vibrocast play examples/oak.wav" in README.with_name("Makefile").read_text(encoding="utf-8")
    check_plays(address, encode_recording(vibrocast.load(OAK), live=True).stream)


@pytest.mark.slow
@pytest.mark.parametrize("address", [name for name in CONTROLLERS if name != "rp2040"])  # it is too slow for 7000 Hz
def test_files_of_any_rate_and_quality_play(address: str) -> None:
    """At 7000 Hz packets are longer, and at 50 dB they have more bytes, than the smallest board takes."""
    for rate_hz, snr_db in ((7000, 15.0), (2800, 50.0)):
        stream = encode_recording(vibrocast.load(OAK), rate_hz, snr_db=snr_db).stream
        check_plays(address, stream)


@pytest.mark.slow
@pytest.mark.parametrize("codec_name", ["mdct", "dct", "slp", "eva", "parametric"])
def test_default_files_of_every_codec_of_the_core_fit_the_smallest_board(codec_name: str) -> None:
    stream = encode_recording(vibrocast.load(OAK), codec_name=codec_name).stream
    split = codec.codec_by_name(codec_name).repack is not None
    assert (check_plays("stm32f405", stream).stream != stream) == split


def test_the_longest_default_packets_below_5600_hz_fit_the_smallest_board() -> None:
    from vibrocast.firmware.build import TARGETS

    setting: codec.Setting = {"hop": "128", "step": 2.0}
    long = textures.GENERATORS["rough"](seconds=12.0)
    stream = encode_recording(long, setting=setting).stream
    packet_samples = TARGETS["stm32f405"].defines["VC_PACKET_SAMPLES"]
    assert isinstance(packet_samples, int)
    assert len(stream.packets) > 1
    assert stream.packet_samples <= packet_samples < stream.packet_samples + 384
