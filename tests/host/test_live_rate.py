"""Live streams at a rate, in simulated time: links that slow down and stall."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from tests.conftest import RATE_HZ, linked, noise
from vibrocast import codec
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.source import live_format
from vibrocast.host import live
from vibrocast.host.live import LiveCoding, LiveResult, LiveStream
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire


@dataclass
class Run:
    """A stream of noise at a rate over a wire; what was seen of it after each packet.

    `wire_bps`: what the wire carries to the controller, None = all at once.
    """

    rate_bps: float
    wire_bps: float | None = None
    channels: int = 1
    policy: codec.RatePolicy | None = None
    packet_samples: int | None = None
    times_s: list[float] = field(default_factory=list)
    rates_bps: list[float] = field(default_factory=list)
    early_s: list[float] = field(default_factory=list)
    waiting_bytes: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.link, controller = linked(faults=[self.capacity(self.wire_bps)])
        assert isinstance(self.link.controller, FaultyWire)
        self.wire = self.link.controller
        self.policy = self.policy or codec.ConstantRate(self.rate_bps)
        self.stream = LiveStream(
            controller,
            live_format(RATE_HZ, "um", [10.0] * self.channels),
            coding=LiveCoding(policy=self.policy, packet_samples=self.packet_samples),
        )

    @staticmethod
    def capacity(bits_per_second: float | None) -> Fault:
        """Return the fault of a wire that carries no more to the controller."""
        return Fault(bits_per_second=bits_per_second, direction="to_controller")

    def play(self, seconds: float, changes: dict[float, float] | None = None) -> LiveResult:
        """Stream; `changes`: to how many bits a second the wire changes, by the time."""
        began_s = self.link.clock()
        for _, block in live.paced(self.stream, noise(seconds, self.channels, rms=2.0, seed=7)):
            now_s = self.link.clock() - began_s
            for at_s in [at_s for at_s in changes or {} if at_s <= now_s]:
                self.wire.change(self.capacity((changes or {}).pop(at_s)))
            before = self.stream.packets_sent
            self.stream.send(block)
            if self.stream.packets_sent > before:
                self.times_s.append(now_s)
                assert self.policy is not None, "set when the stream was"
                self.rates_bps.append(self.policy.bits_per_second)
                self.waiting_bytes.append(self.wire.waiting_bytes)
            if self.stream.status.position:
                self.early_s.append(self.stream.status.buffered_samples / RATE_HZ)
        return self.stream.finish()

    def mean_bps(self, from_s: float, to_s: float) -> float:
        """Return the mean rate of the policy in a time."""
        return float(
            np.mean([rate for at, rate in zip(self.times_s, self.rates_bps, strict=True) if from_s <= at < to_s])
        )


@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_four_channels_at_1_kbit_per_second_each_cost_at_most_12_percent_on_the_wire(seconds: float) -> None:
    run = Run(4000, channels=4)
    result = run.play(seconds)
    # The beginning and end of the stream, and the last packet, which silence fills, come on top.
    assert 4000 < result.wire_bps < 4000 * 1.01 + 8 * (80 + 40) / seconds
    assert result.wire_adds <= 0.12
    assert result.lost_packets == 0


@pytest.mark.slow
@pytest.mark.parametrize(("rate_bps", "falls_s"), [(1000, 4.0), (1000, 4.24), (8000, 4.0)])
def test_a_link_that_falls_to_half_makes_no_packet_late_and_quality_comes_back(rate_bps: float, falls_s: float) -> None:
    run = Run(rate_bps, 1.25 * rate_bps)
    result = run.play(13.0, {falls_s: 0.625 * rate_bps, 8.0: 1.25 * rate_bps})
    assert (result.lost_packets, result.underruns, result.dropped_packets) == (0, 0, 0)
    assert run.mean_bps(2.0, 4.0) == rate_bps
    assert 0.4 * rate_bps < run.mean_bps(5.0, 8.0) < 0.8 * rate_bps
    assert run.mean_bps(11.0, 13.0) > 0.95 * rate_bps
    assert max(run.waiting_bytes) < 2.5 * rate_bps / 8 * run.stream.packet_s


def test_a_quality_falls_to_what_the_link_carries() -> None:
    target = RateTarget(capped_rate_bps=16_000, snr_db=30)  # of noise: 14 kbit/s
    signal_format = live_format(RATE_HZ, "um", [10.0])
    policy = target.policy(signal_format)
    assert isinstance(policy, codec.RatePolicy)
    run = Run(0, 7680, policy=policy, packet_samples=target.framing(RATE_HZ).packet_samples)
    result = run.play(6.0)
    assert (result.lost_packets, result.underruns, result.dropped_packets) == (0, 0, 0)
    assert 0.7 * 7680 < run.mean_bps(3.0, 6.0) < 1.2 * 7680


def test_what_a_link_that_stands_still_would_bring_too_late_is_not_sent() -> None:
    run = Run(4000, 5000)
    result = run.play(8.0, {3.0: 1.0, 4.5: 5000.0})
    assert result.dropped_packets > 5
    # Packets on the link when it stopped are late; later ones were never sent.
    assert result.lost_packets <= result.dropped_packets + 8
    assert result.streams == 1
    assert run.mean_bps(7.0, 8.0) > 3600
    assert run.early_s[-1] > 0.1


def test_a_reported_loss_is_followed_by_a_refresh() -> None:
    run = Run(4000)
    packets: list[bytes] = []
    send_packets = run.stream.send_packets

    def noted(made: list[bytes]) -> None:
        for packet in made:
            packets.append(packet)
            if len(packets) == 10:
                run.stream.packets_sent += 1  # it is lost on the way
            else:
                send_packets([packet])

    run.stream.send_packets = noted  # type: ignore[method-assign, assignment]
    result = run.play(3.0)
    assert result.lost_packets == 1
    refreshes = [number for number, packet in enumerate(packets) if packet[0] & 1]
    assert any(10 < number <= 14 for number in refreshes)
