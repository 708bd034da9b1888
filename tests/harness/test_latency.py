"""Latency in simulated time: the figures are compared with the times at which the codes went to the DAC."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from tests.conftest import RATE_HZ, linked, noise, session, texture
from tests.harness.runs import LATENCY
from vibrocast.harness import latency
from vibrocast.harness.latency import FlawedError, Latency
from vibrocast.harness.results import Measured, Results, warnings
from vibrocast.harness.sensors import TimedRecording
from vibrocast.host import live
from vibrocast.host.controller import Controller
from vibrocast.host.devices import session_with
from vibrocast.host.live_playback import DeviceClock
from vibrocast.host.report import Timing
from vibrocast.output.actuator import PIEZO_STACK, Codes
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink, SimulatedTime
from vibrocast.textures import Recording


@dataclass
class Bench:
    """A controller in simulated time; `played`: when each run of codes went to the DAC, and the codes."""

    drift_ppm: int = 0
    played: list[tuple[float, Codes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.link, self.session = linked(Settings(drift_ppm=self.drift_ppm), on_dac=self._note)

    def _note(self, codes: Codes) -> None:
        self.played.append((self.link.clock(), codes))


def long_line(late_s: float) -> Controller:
    """Return a session over a line that carries everything so long each way, as a UART behind USB does."""
    line = FaultyWire(SimulatedController(), [Fault(delay_ms=1e3 * late_s)])
    return session(MemoryLink(line, time=SimulatedTime(step_us=100)))


NOISE = texture(noise(rms=3.0))


def test_a_sensor_ends_the_measurement_at_its_samples() -> None:
    bench, sensor_delay_s = Bench(), 0.007

    @contextlib.contextmanager
    def recorder(seconds: float) -> Iterator[Callable[[], Recording]]:
        began_s = bench.link.clock()

        def finish() -> Recording:
            rate_hz = PIEZO_STACK.dac_rate_hz
            codes = np.zeros((round(seconds * rate_hz), 1), np.int16)
            first = round((bench.played[0][0] - began_s) * rate_hz) - len(bench.played[0][1])
            played = np.concatenate([run for _, run in bench.played])[: len(codes) - first, :1]
            codes[first : first + len(played)] = played
            skin_um = PIEZO_STACK.displacement_um(codes)
            return TimedRecording(skin_um, rate_hz, "um", "laser", began_s=began_s + sensor_delay_s)

        yield finish

    measured = latency.measure_latency(session_with(bench.session, "sim"), NOISE, seconds=2.0, recorder=recorder)
    # The piezo's low-pass adds at most 1 / (2 pi corner_hz) = 0.6 ms.
    assert measured.to_sensor_ms == pytest.approx(measured.total_ms + 1e3 * sensor_delay_s, abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize(("playout_delay_s", "drift_ppm"), [(0.004, 0), (0.02, 200)])
def test_the_whole_is_the_sum_of_its_parts_and_the_playout_delay_is_kept(
    playout_delay_s: float, drift_ppm: int
) -> None:
    measured = latency.measure_latency(
        session_with(Bench(drift_ppm).session, "sim"), NOISE, seconds=2.0, playout_delay_s=playout_delay_s
    )
    assert not measured.report.lost_anything
    assert measured.report.decoded_equals_offline
    assert measured.total_ms == pytest.approx(sum(part.median_ms for part in measured.parts.values()), abs=0.5)
    # Time steps by 1 ms here, and nothing takes any in between.
    assert measured.parts["buffer"].median_ms == pytest.approx(1e3 * playout_delay_s, abs=1.5)
    assert measured.parts["wire"].median_ms == pytest.approx(0.0, abs=1.0)
    assert measured.clock.drift_ppm == pytest.approx(drift_ppm, abs=5.0)


def test_what_is_measured_is_when_the_dac_has_it() -> None:
    bench = Bench()
    silence, knock = np.zeros((RATE_HZ, 1)), np.zeros((RATE_HZ, 1))
    knock[RATE_HZ // 2] = 30.0
    knocking = texture(np.concatenate((silence, knock)))
    measured = latency.measure_latency(session_with(bench.session, "sim"), knocking, seconds=2.0)
    peak_s = max((np.max(np.abs(codes)), time_s) for time_s, codes in bench.played)[1]
    # The source begins when the stream does, which is set up without time passing.
    assert 1e3 * (peak_s - 1.5) == pytest.approx(measured.total_ms, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("late_ms", [1, 4])
def test_a_link_of_long_round_trips_is_measured_without_holding_the_stream_up(late_ms: int) -> None:
    measured = latency.measure_latency(session_with(long_line(late_ms / 1000), "sim"), NOISE, seconds=2.0)
    assert not measured.report.lost_anything
    assert measured.report.decoded_equals_offline
    assert measured.parts["wire"].median_ms == pytest.approx(late_ms, abs=0.2)
    assert measured.clock.round_trip_ms == pytest.approx(2 * late_ms, abs=0.3)


def test_default_buffers_stay_below_30_ms_with_a_usb_class_link() -> None:
    measured = latency.measure_latency(session_with(Bench().session, "sim"), NOISE, seconds=1.0)
    assert measured.report.live is not None
    assert measured.report.live.playout_delay_ms == 1e3 * live.PLAYOUT_DELAY_S
    assert measured.total_ms < 30.0


@pytest.mark.slow
def test_search_finds_the_least_that_is_stable() -> None:
    found = latency.find_min_latency(session_with(Bench().session, "sim"), NOISE, seconds=1.0)
    assert found.found is not None
    stable = [trial.total_ms for trial in found.trials if trial.total_ms is not None]
    assert found.found.total_ms == pytest.approx(min(stable), abs=1.0)


FLAWS = [
    ({"lost_packets": 30}, 0.0, "30 packets came too late"),
    ({"underruns": 11}, 0.0, "11 underruns moved the stream"),
    ({}, -3.0, "played before they arrive"),
]


def flawed(changes: dict[str, Any], buffer_ms: float) -> Latency:
    """Return a measurement whose packets waited so long in the buffer."""
    parts = dict.fromkeys(latency.PARTS, latency.Spread(1.0, 2.0)) | {"buffer": latency.Spread(buffer_ms, buffer_ms)}
    report = replace(LATENCY.report, timing=Timing(end_to_end_ms=buffer_ms), **changes)
    return replace(LATENCY, parts=parts, report=report)


@pytest.mark.parametrize(("changes", "buffer_ms", "flaw"), FLAWS)
def test_a_delay_that_no_stream_had_is_measured_again_and_then_an_error(
    changes: dict[str, int], buffer_ms: float, flaw: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, bad = flawed({"lost_packets": 1}, -0.5), flawed(changes | {"doubt": "it was late"}, buffer_ms)
    results = iter([bad, good, bad, bad])
    monkeypatch.setattr(latency, "measure_latency", lambda *_, **__: next(results))
    controller = session_with(Bench().session, "sim")
    assert latency.measure_credible_latency(controller, NOISE) is good
    with pytest.raises(FlawedError, match=flaw) as caught:
        latency.measure_credible_latency(controller, NOISE)
    assert caught.value.doubt == "it was late"


def test_the_search_does_not_take_a_delay_that_no_stream_had(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "measure_latency", lambda *_, **__: flawed({}, -3.0))
    found = latency.find_min_latency(session_with(Bench().session, "sim"), NOISE)
    assert found.found is None
    assert [trial.total_ms for trial in found.trials] == [None] * len(latency.HOPS)


def test_late_packets_make_a_warning_of_a_latency() -> None:
    for lost, told in ((0, []), (2, ["2 packets came too late"])):
        run = Results({}, {}, Measured(flawed({"lost_packets": lost}, 1.0)))
        assert [warning[:23] for warning in warnings(run)] == told


def test_a_clock_is_fitted_through_the_shortest_round_trips() -> None:
    bench = Bench(drift_ppm=-80)
    clock = DeviceClock(bench.session)
    for number in range(100):
        clock.ask(number)
        clock.sleep(0.02)
    assert len(clock.trips) == 100
    fit = clock.fit()
    assert fit.drift_ppm == pytest.approx(-80.0, abs=2.0)
    device_s = bench.session.request_status().device_time_us / 1e6
    assert fit.host_time_s(device_s) == pytest.approx(bench.session.clock(), abs=1e-4)
