"""Live streams of the harness: samples, codes and times of the controller against those of the host."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from studies.faulty_bench import Misreading, at_half_gain
from tests.conftest import session
from vibrocast import textures
from vibrocast.codec import SignalFormat
from vibrocast.device_protocol.messages import Message, SinglePacket
from vibrocast.harness.latency import measure_latency
from vibrocast.harness.live_run import LiveRun, run_live
from vibrocast.host.bench_limits import BenchLimits, missed
from vibrocast.host.live_watch import judged
from vibrocast.host.playback import Member, actuator_model, member
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink

FORMAT = SignalFormat(2800, "m/s^2", (1.0,), (1.0,))
ROUGH = textures.GENERATORS["rough"](seconds=1.0)


def played_by(device: Device) -> Member:
    """Return who plays, in simulated time."""
    return member(session(MemoryLink(device)), "sim", None)


def figures_of(run: LiveRun) -> dict[str, float | None]:
    """Return the figures that limits judge."""
    return {key: value for key, _, value in judged(run.result, run.quality, run.timing)}


def flipped(message: Message) -> Message:
    """Return a packet in which a bit has flipped; any other message as it is."""
    if not isinstance(message, SinglePacket) or len(message.packet) < 5:
        return message
    *before, second, last = message.packet  # the decoder notices most flips of the head, and plays a gap
    return replace(message, packet=bytes([*before, second ^ 1, last]))


def test_a_stream_is_read_back_and_judged() -> None:
    run = run_live(played_by(SimulatedController()), ROUGH, 2.0)
    assert run.quality.decoded_equals_offline is run.quality.dac_equals_offline is True
    found = figures_of(run)
    assert found["snr_db"] == pytest.approx(16, abs=3) and found["gain"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("misread", "as_decoded", "as_computed"), [(at_half_gain, True, False), (flipped, False, False)]
)
def test_a_controller_that_plays_something_else_has_no_known_quality(
    misread: Callable[[Message], Message], as_decoded: bool, as_computed: bool
) -> None:
    run = run_live(played_by(Misreading(SimulatedController, misread)), ROUGH, 1.0)
    assert (run.quality.decoded_equals_offline, run.quality.dac_equals_offline) == (as_decoded, as_computed)
    assert run.quality.differs
    assert figures_of(run)["snr_db"] is figures_of(run)["gain"] is None


def test_a_stream_with_losses_is_not_compared() -> None:
    run = run_live(
        played_by(FaultyWire(SimulatedController(), [Fault(lost=0.05, direction="to_controller")])), ROUGH, 1.0
    )
    assert run.result.lost_packets
    assert run.quality.decoded_equals_offline is run.quality.dac_equals_offline is None
    assert not run.quality.differs


def test_the_times_are_those_that_the_measurement_of_latency_finds() -> None:
    on = played_by(SimulatedController())
    timing = run_live(on, ROUGH, 2.0, playout_delay_s=0.02).timing
    actuator = actuator_model(on.controller.description.actuator)
    latency = measure_latency(on.controller, actuator, ROUGH, seconds=2.0, playout_delay_s=0.02)
    assert timing.latency_ms == pytest.approx(latency.total_ms, abs=1)
    assert timing.jitter_ms == pytest.approx(latency.jitter_ms, abs=1)
    assert timing.drift_ppm == pytest.approx(latency.clock.drift_ppm, abs=1)


def test_limits_judge_the_times_of_a_stream() -> None:
    run = run_live(played_by(SimulatedController(Settings(drift_ppm=1000))), ROUGH, 2.0)
    limits = BenchLimits(max_latency_ms=1, max_jitter_ms=1e-4, max_drift_ppm=500)
    assert [line.split(" = ")[0] for line in missed(limits, judged(run.result, run.quality, run.timing))] == [
        "live: latency_ms",
        "live: jitter_ms",
        "live: drift_ppm",
    ]
