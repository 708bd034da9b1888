"""Live playbacks: samples, codes and times of the controller against those of the host; what was lost is counted."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from studies.faulty_bench import Misreading, at_half_gain
from tests.conftest import session
from vibrocast import textures
from vibrocast.device_protocol.messages import Message, SinglePacket
from vibrocast.harness.latency import looped, measure_latency
from vibrocast.host.devices import Session, session_with
from vibrocast.host.figures import BenchLimits, missed
from vibrocast.host.live_playback import play_live
from vibrocast.host.report import Report
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink

ROUGH = textures.GENERATORS["rough"](seconds=1.0)


def on(device: Device) -> Session:
    """Return a session in simulated time."""
    return session_with(session(MemoryLink(device)), "sim")


def played(device: Device, seconds: float = 1.0) -> Report:
    """Play a live stream, and return its report."""
    return play_live(on(device), looped(ROUGH, seconds, 2800)).report


def figures_of(report: Report) -> dict[str, float | None]:
    """Return the figures that limits judge."""
    return {each.key: each.value for each in report.figures()}


def flipped(message: Message) -> Message:
    """Return a packet in which a bit has flipped; any other message as it is."""
    if not isinstance(message, SinglePacket) or len(message.packet) < 5:
        return message
    *before, second, last = message.packet  # the decoder notices most flips of the head, and plays a gap
    return replace(message, packet=bytes([*before, second ^ 1, last]))


def test_a_stream_is_read_back_and_judged() -> None:
    report = played(SimulatedController(), 2.0)
    assert report.decoded_equals_offline is report.dac_equals_offline is True
    found = figures_of(report)
    assert found["snr_db"] == pytest.approx(16, abs=3) and found["gain"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("misread", "as_decoded", "as_computed"), [(at_half_gain, True, False), (flipped, False, False)]
)
def test_a_controller_that_plays_something_else_has_no_known_quality(
    misread: Callable[[Message], Message], as_decoded: bool, as_computed: bool
) -> None:
    report = played(Misreading(SimulatedController, misread))
    assert (report.decoded_equals_offline, report.dac_equals_offline) == (as_decoded, as_computed)
    assert report.differs
    assert figures_of(report)["snr_db"] is figures_of(report)["gain"] is None


def test_a_stream_with_losses_is_not_compared() -> None:
    report = played(FaultyWire(SimulatedController(), [Fault(lost=0.05, direction="to_controller")]))
    assert report.lost_packets
    assert report.decoded_equals_offline is report.dac_equals_offline is None
    assert not report.differs


def test_a_stream_too_short_to_be_decoded_has_no_quality() -> None:
    report = play_live(on(SimulatedController()), textures.Recording(ROUGH.samples[:4], 2800, "um", "short")).report
    assert report.quality.snr_db is None and report.quality.skin is None and not report.differs


def test_the_times_are_those_that_the_measurement_of_latency_finds() -> None:
    session = on(SimulatedController())
    report = play_live(session, looped(ROUGH, 2.0, 2800), playout_delay_s=0.02).report
    latency = measure_latency(session, ROUGH, seconds=2.0, playout_delay_s=0.02)
    assert report.timing.end_to_end_ms == pytest.approx(latency.total_ms, abs=0.1)
    assert report.live is not None
    assert latency.report.live is not None
    assert report.timing.jitter_ms == pytest.approx(latency.report.timing.jitter_ms, abs=1)
    assert report.timing.drift_ppm == pytest.approx(latency.clock.drift_ppm, abs=1)


@pytest.mark.parametrize("cut_s", [0.5, 1.0])
def test_what_the_actuator_misses_while_the_cable_is_out_counts_as_lost(cut_s: float) -> None:
    wire = FaultyWire(SimulatedController(), [Fault(at_s=1.0, for_s=cut_s, cut=True)])
    report = play_live(on(wire), looped(ROUGH, 3.0, 2800)).report
    assert report.live is not None and report.live.streams > 1
    assert 100 * report.lost_packets / report.packets == pytest.approx(100 * cut_s / 3.0, abs=8)


def test_limits_judge_the_times_of_a_stream() -> None:
    report = played(SimulatedController(Settings(drift_ppm=1000)), 2.0)
    limits = BenchLimits(max_latency_ms=1, max_jitter_ms=1e-4, max_drift_ppm=500)
    assert [each.text.split(" = ")[0] for each in missed(limits, report.figures())] == [
        "live: latency_ms",
        "live: jitter_ms",
        "live: drift_ppm",
    ]
