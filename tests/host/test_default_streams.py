"""Streams that `encode` writes by default play on the board that ships: all of its codecs, rates and channels."""

import numpy as np
import pytest

from tests.conftest import session
from vibrocast import codec
from vibrocast.codec.core import decoding_cycles
from vibrocast.codec.encoding import encode_recording
from vibrocast.host import devices
from vibrocast.host.controller import Controller
from vibrocast.host.stream_session import configure_steps, fitted
from vibrocast.simulated_device.memory_link import MemoryLink
from vibrocast.textures import Recording

RATES_HZ = (100, 2800, 5600, 8000, 12_000)
"""The lowest and the highest that the board takes, and both sides of each change of a codec's block length."""
pytestmark = pytest.mark.slow  # it starts an emulated board
CODECS = ("mdct", "dct", "slp", "eva", "parametric")


@pytest.fixture(scope="module")
def board() -> Controller:
    """A session with the firmware of the board, emulated, in simulated time."""
    return session(MemoryLink(devices.emulated("stm32f405")))


def test_these_are_all_codecs_of_the_board_and_the_limits_of_its_rates(board: Controller) -> None:
    decoded = {identifier for identifier, _ in board.description.codecs}
    assert set(CODECS) == {each.name for each in codec.BUILT_IN.values() if each.identifier in decoded}
    limits = board.description.limits
    assert (limits.min_rate_hz, limits.max_rate_hz, limits.channels) == (RATES_HZ[0], RATES_HZ[-1], 2)


@pytest.mark.parametrize("codec_name", CODECS)
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_a_stream_with_default_settings_plays(codec_name: str, rate_hz: int, channels: int, board: Controller) -> None:
    # White noise has the largest packets at an SNR; longer than any packet.
    samples = np.random.default_rng(1).standard_normal((max(rate_hz, 9000), channels))
    stream = encode_recording(Recording(samples, rate_hz, "m/s^2", "noise"), rate_hz, codec_name).stream
    sent, limits = fitted(board, stream), board.description.limits
    assert max(map(len, sent.packets)) <= limits.sendable_packet_bytes
    cycles = decoding_cycles(sent.header.codec_identifier, sent.header.configuration, channels, sent.tables)
    assert cycles * rate_hz <= 1000 * limits.decoding_kilocycles_per_s
    if stream.image is None:
        # The board itself answers: it knows its memory.
        board.run(configure_steps(board, sent.header, sent.packet_samples, packets=len(sent.packets)))
