"""Throughput, load and gaps in simulated time, where what a controller bears is known."""

import pytest

from tests.conftest import linked, noise, texture
from vibrocast.harness import load
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault

NOISE = texture(noise())


def test_throughput_is_that_of_the_link() -> None:
    measured = load.throughput(linked(None, [Fault(bits_per_second=720_000)])[1], NOISE)
    assert measured.to_controller_bytes_per_s == pytest.approx(90_000, rel=0.05)
    assert measured.to_host_bytes_per_s == pytest.approx(90_000, rel=0.05)
    assert measured.bad_frames == 0


def test_load_beyond_the_link_is_seen_as_underruns() -> None:
    slow = Fault(bits_per_second=40_000, direction="to_controller")
    loads = load.underruns(linked(Settings(channels=2), [slow])[1], NOISE)
    assert [(each.channels, each.rate_hz) for each in loads] == [(1, 2800), (2, 2800), (1, 8000), (2, 8000)]
    assert loads[0].samples_per_s == loads[0].channels * loads[0].rate_hz
    assert loads[-1].samples_per_s == 0


@pytest.mark.parametrize(
    ("buffer_s", "watchdog_ms", "survived_ms", "ended_by"),
    [(0.3, 2000, 300.0, "buffer"), (3600.0, 500, 500.0, "watchdog")],
)
def test_the_max_gap_is_the_buffer_or_the_watchdog(
    buffer_s: float, watchdog_ms: int, survived_ms: float, ended_by: str
) -> None:
    _, controller = linked(Settings(watchdog_ms=watchdog_ms))
    gap = load.max_gap(controller, NOISE, buffer_s)
    assert gap.survived_ms == pytest.approx(survived_ms, rel=0.06)
    assert gap.ended_by == ended_by
