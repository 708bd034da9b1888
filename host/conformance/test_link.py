"""The link: faults on the way, a connection that breaks, and two clocks that differ."""

from collections.abc import Callable

import numpy as np
import pytest

from device_protocol.frames import FrameReader
from device_protocol.messages import State, Status, StreamData, unpack
from host import player
from host.coding import Stream
from host.conformance.fixtures import long, section
from host.conformance.probe import Probe, in_state, same_samples, told
from host.conformance.streams import decoded, need_capture, stream_for
from host.controller import Controller
from simulated_device.memory_link import FaultyLine

_FAULTY_SECONDS = 1.0
# Of each frame, in both directions.
_CHANCES = {
    "lost": {"lost": 0.05},
    "damaged": {"flipped": 0.05},
    "doubled": {"doubled": 0.3},
    "reordered": {"swapped": 0.3},
    "lost, damaged, doubled and reordered": {"lost": 0.02, "flipped": 0.02, "doubled": 0.1, "swapped": 0.1},
}
_DRIFT_SECONDS = 3.0
_PPM = 1e6


class NotedLine(FaultyLine):
    """A faulty line that keeps the payloads that arrive."""

    def __init__(self, seed: int, chances: dict[str, float]) -> None:
        super().__init__(seed, **chances)
        self.arrived: list[bytes] = []
        self._reader = FrameReader()

    def carry(self, data: bytes) -> bytes:
        """Take what is sent; return what arrives."""
        arrived = super().carry(data)
        self.arrived += self._reader.feed(arrived)
        return arrived


def host(probe: Probe) -> Controller:
    """Return a session as a host has it, which repeats what is not answered."""
    return Controller(probe.line, probe.line.clock, probe.line.sleep)


@section("Playing: Stream data")
@pytest.mark.parametrize("fault", _CHANCES)
def test_faults_on_the_line(probe: Probe, fault: str) -> None:
    """On a line with frames {fault} in both directions, what arrives is played, and only what does not is concealed."""
    need_capture(probe.description)
    stream = stream_for(probe.description, seconds=_FAULTY_SECONDS)
    # All of it must have room before it plays, whatever is missing, so that nothing comes late; and its captures must
    # last until their end, for reading them back takes long here.
    granted_s = probe.configure(stream).credit_until / stream.header.rate_hz
    highest_rate_hz = max(stream.header.rate_hz, probe.description.actuator.dac_rate_hz)
    captured_s = probe.description.limits.capture_samples / highest_rate_hz
    stream = stream_for(probe.description, seconds=min(_FAULTY_SECONDS, 0.8 * granted_s, 0.8 * captured_s))
    for seed in range(round(_FAULTY_SECONDS / stream.seconds)):
        play_with_faults(probe, stream, seed, fault)


def play_with_faults(probe: Probe, stream: Stream, seed: int, fault: str) -> None:
    """Play a stream on a faulty line, and compare what was decoded with what arrived."""
    controller = host(probe)
    there = probe.line.to_controller = NotedLine(2 * seed, _CHANCES[fault])
    probe.line.to_host = FaultyLine(2 * seed + 1, **_CHANCES[fault])
    result = player.play(
        controller,
        stream.header,
        stream.packets,
        stream.decoder().packet_samples,
        buffer_s=2 * stream.seconds,
        capture=True,
    )
    probe.line.heal()
    in_state(result.status, State.FINISHED, "the end of the stream")
    messages = [unpack(payload)[1] for payload in there.arrived if payload[0] == StreamData.TYPE]
    arrived = {packet for message in messages if isinstance(message, StreamData) for packet in message.packets}
    missing = [number for number, packet in enumerate(stream.packets) if packet not in arrived]
    assert result.lost_packets == len(missing), f"expected {len(missing)} lost packets, came {told(result.status)}"
    assert result.decoded is not None, "the capture was asked for"
    same_samples(result.decoded, decoded(stream, missing=missing), f"with frames {fault}")


@section("Session: Sequence numbers")
def test_connection_that_breaks(probe: Probe) -> None:
    """A connection that breaks while playing, and is opened anew with a Hello, leaves the stream whole."""
    need_capture(probe.description)
    stream = stream_for(probe.description, seconds=1.0)
    cuts: list[float] = []

    def cut_once(progress: player.Progress) -> None:
        if not cuts and progress.status.state == State.PLAYING:
            cuts.append(progress.position_s)
            probe.line.cut()

    result = player.play(
        host(probe),
        stream.header,
        stream.packets,
        stream.decoder().packet_samples,
        buffer_s=stream.seconds,
        capture=True,
        progress=cut_once,
    )
    assert cuts, "expected to play long enough for a cut"
    assert result.reconnects == 1, f"expected one new connection, came {result.reconnects}"
    assert result.lost_packets == 0, f"expected no loss, came {told(result.status)}"
    assert result.decoded is not None, "the capture was asked for"
    same_samples(result.decoded, decoded(stream), "over two connections")


@long
@section("Playing: Positions")
def test_clocks(probe: Probe, record_property: Callable[[str, object], None]) -> None:
    """The device's clock runs forward, its samples with it, and a stream paced by it plays without an underrun."""
    stream = stream_for(probe.description, seconds=_DRIFT_SECONDS, buffered=False)
    seen: list[tuple[float, Status]] = []

    def note(progress: player.Progress) -> None:
        if progress.status.state == State.PLAYING:
            seen.append((probe.line.clock(), progress.status))

    packet_samples = stream.decoder().packet_samples
    result = player.play(host(probe), stream.header, stream.packets, packet_samples, progress=note)
    in_state(result.status, State.FINISHED, "the end of the stream")
    assert (result.underruns, result.lost_packets) == (0, 0), f"expected no loss, came {told(result.status)}"
    assert len(seen) > 2, f"expected a Status every 100 ms, came {len(seen)}"
    device_s = np.array([status.device_time_us for _, status in seen]) / 1e6
    played_s = np.array([status.position for _, status in seen]) / stream.header.rate_hz
    assert (np.diff(device_s) >= 0).all(), "expected a clock that never goes back"
    assert (np.diff(played_s) >= 0).all(), "expected a position that never goes back"
    # Positions come in whole packets, more or less; what is over two of them is no sampling of the clock.
    apart_s = np.ptp(played_s - device_s)
    allowed_s = 2 * packet_samples / stream.header.rate_hz
    assert apart_s <= allowed_s, (
        f"expected samples and clock to go together within {allowed_s} s, came {apart_s} s apart"
    )
    host_s = np.array([at_s for at_s, _ in seen])
    drift = (np.polyfit(host_s, device_s, 1)[0] - 1) * _PPM
    record_property("measured", f"device clock against this computer's: {drift:+.0f} ppm over {np.ptp(host_s):.1f} s")
