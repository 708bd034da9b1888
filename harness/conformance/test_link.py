"""The link: faults on the way, a connection that breaks, and two clocks that differ."""

from collections.abc import Callable

import numpy as np
import pytest

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.frames import FrameReader
from vibrocast.device_protocol.messages import PacketMessage, SinglePacket, State, Status, StreamData, unpack
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import Probe, describe, in_state, same_samples
from vibrocast.harness.conformance.streams import answered_s, decoded, decoded_as, host, need_capture, stream_for
from vibrocast.host import player
from vibrocast.simulated_device.faulty_wire import Fault, FrameDamage

_FAULTY_SECONDS = 1.0
_SEEDS = (5, 15, 25)
_PACKETS_READY = 4
# Of each frame, in both directions.
_FAULTS = {
    "lost": Fault(lost=0.1),
    "damaged": Fault(flipped=0.1),
    "doubled": Fault(doubled=0.3),
    "reordered": Fault(swapped=0.3),
    "lost and damaged and doubled and reordered": Fault(lost=0.05, flipped=0.05, doubled=0.1, swapped=0.1),
}
_DRIFT_SECONDS = 3.0
_PPM = 1e6


class NotedDamage(FrameDamage):
    """Damages frames, and keeps the payloads that arrive."""

    def __init__(self, fault: Fault, seed: int) -> None:
        super().__init__(fault, seed)
        self.arrived: list[bytes] = []
        self._reader = FrameReader()

    def carry(self, data: bytes) -> bytes:
        """Take what is sent; return what arrives."""
        arrived = super().carry(data)
        self.arrived += self._reader.feed(arrived)
        return arrived


@section("Playing: Stream data")
@pytest.mark.parametrize("fault", _FAULTS)
def test_faults_on_the_link(probe: Probe, fault: str, record_property: Callable[[str, object], None]) -> None:
    """The controller plays all packets that arrive over a link with frames {fault}, and conceals only the others."""
    need_capture(probe.description)
    stream = stream_for(probe.description, seconds=_FAULTY_SECONDS, buffered=False)
    for seed in _SEEDS:
        result, missing = play_with_faults(probe, stream, _FAULTS[fault], seed)
        if not result.underruns:
            break  # otherwise this computer may have paused for too long
    record_property("measured", f"{len(missing)} of {len(stream.packets)} packets did not arrive")
    in_state(result.status, State.FINISHED, "the end of the stream")
    assert result.lost_packets == len(missing), f"expected {len(missing)} lost packets, came {describe(result.status)}"
    decoded_as(probe, decoded(stream, missing=missing), f"with frames {fault}")


def play_with_faults(probe: Probe, stream: Stream, fault: Fault, seed: int) -> tuple[player.PlaybackResult, list[int]]:
    """Play a stream on a faulty link; return what happened, and the packets that did not arrive."""
    packet_samples = stream.packet_samples
    controller = host(probe)
    there = probe.link.to_controller = NotedDamage(fault, seed)
    probe.link.to_host = FrameDamage(fault, seed + 1)
    # Captures are read afterwards, and some packets lie ready, so that the host is not late with its data.
    buffer_s = max(answered_s(probe), _PACKETS_READY * packet_samples / stream.header.rate_hz)
    result = player.play(controller, stream, player.PlaybackSettings(buffer_s=buffer_s))
    probe.link.heal()
    probe.open()
    messages = [unpack(payload)[1] for payload in there.arrived if payload[0] in (StreamData.TYPE, SinglePacket.TYPE)]
    arrived = {packet for message in messages if isinstance(message, PacketMessage) for packet in message.packets}
    return result, [number for number, packet in enumerate(stream.packets) if packet not in arrived]


@section("Session: Sequence numbers")
def test_connection_that_breaks(probe: Probe) -> None:
    """The controller keeps its stream whole when the connection breaks and the host says Hello again."""
    need_capture(probe.description)
    stream = stream_for(probe.description, seconds=1.0)
    cuts: list[float] = []

    def cut_once(progress: player.Progress) -> None:
        if not cuts and progress.status.state == State.PLAYING:
            cuts.append(progress.position_s)
            probe.link.cut()

    result = player.play(
        host(probe), stream, player.PlaybackSettings(buffer_s=stream.seconds, capture=True, progress=cut_once)
    )
    assert cuts, "expected to play long enough for a cut"
    assert result.reconnects == 1, f"expected one new connection, came {result.reconnects}"
    assert result.lost_packets == 0, f"expected no loss, came {describe(result.status)}"
    assert result.decoded is not None, "the capture was asked for"
    same_samples(result.decoded, decoded(stream), "over two connections")


@long
@section("Playing: Positions")
def test_clocks(probe: Probe, record_property: Callable[[str, object], None]) -> None:
    """The controller's clock and position never go back and keep together. A stream that they pace has no underrun."""
    stream = stream_for(probe.description, seconds=_DRIFT_SECONDS, buffered=False)
    seen: list[tuple[float, Status]] = []

    def note(progress: player.Progress) -> None:
        if progress.status.state == State.PLAYING:
            seen.append((probe.link.clock(), progress.status))

    packet_samples = stream.packet_samples
    result = player.play(host(probe), stream, player.PlaybackSettings(buffer_s=answered_s(probe), progress=note))
    in_state(result.status, State.FINISHED, "the end of the stream")
    assert (result.underruns, result.lost_packets) == (0, 0), f"expected no loss, came {describe(result.status)}"
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
