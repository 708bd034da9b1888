"""Requirements on the real output find a port that puts out something else than it was told, or too late."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest

from vibrocast.harness.conformance import TappedLink
from vibrocast.harness.conformance.probe import Probe
from vibrocast.harness.conformance.test_real_output import (
    test_port_puts_out_what_is_captured as compare_codes,
)
from vibrocast.harness.conformance.test_real_output import (
    test_sensor_feels_the_dac_codes as compare_movement,
)
from vibrocast.harness.sensors import Recorder, TimedRecording
from vibrocast.output.actuator import PIEZO_STACK, Codes
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.memory_link import MemoryLink
from vibrocast.textures import Recording

DAC_HZ = PIEZO_STACK.dac_rate_hz
LATE_SAMPLES = DAC_HZ // 5


class Port:
    """Puts out other DAC codes than it gets: `alter`ed, and `late` samples after it got them."""

    def __init__(self, alter: Callable[[Codes], Codes], late: int) -> None:
        self._alter, self._late = alter, late
        self._waiting = np.zeros((0, 1), np.int16)

    def put_out(self, codes: Codes) -> Codes:
        self._waiting = np.concatenate([self._waiting, codes])
        ready = max(0, len(self._waiting) - self._late)
        out, self._waiting = self._waiting[:ready], self._waiting[ready:]
        return self._alter(out)


def probe_of(play: Callable[[Codes], None], recorder: Callable[[MemoryLink], Path | Recorder]) -> Probe:
    """Return an open session with a controller whose codes go to a port, and the recorder behind that."""
    link = MemoryLink(Controller(on_dac=play))
    probe = Probe(TappedLink(link, link.clock, link.sleep, recorder=recorder(link)))
    probe.open()
    return probe


@pytest.mark.parametrize(
    ("alter", "late", "reason"),
    [
        (lambda codes: codes, 0, ""),
        (lambda codes: -codes, 0, "samples differ"),
        (lambda codes: codes + np.int16(1), 0, "samples differ"),
        (lambda codes: codes, LATE_SAMPLES, "within 30 ms"),
    ],
    ids=["healthy", "inverted", "one LSB off", "200 ms late"],
)
def test_codes_in_a_file_are_compared(alter: Callable[[Codes], Codes], late: int, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "codes"
    path.touch()
    port = Port(alter, late)

    def play(codes: Codes) -> None:
        with path.open("ab") as file:
            file.write(port.put_out(codes).tobytes())

    probe = probe_of(play, lambda link: path)
    with pytest.raises(AssertionError, match=reason) if reason else nullcontext():
        compare_codes(probe)


@pytest.mark.parametrize(
    ("gain", "late_s", "reason"),
    [(0.8, 0.0, ""), (-1.0, 0.0, "the opposite"), (1.0, 0.2, "came 2.. ms"), (0.0, 0.0, "came another")],
)
def test_what_a_sensor_felt_is_compared(gain: float, late_s: float, reason: str) -> None:
    felt: list[tuple[float, Codes]] = []

    def recorder_on(link: MemoryLink) -> Recorder:
        links.append(link)

        @contextmanager
        def record(seconds: float) -> Iterator[Callable[[], Recording]]:
            began_s = link.clock()

            def finish() -> Recording:
                count = round(seconds * DAC_HZ)
                codes = np.zeros((count, 1), np.int16)
                for at_s, piece in felt:
                    first = round((at_s - began_s + late_s) * DAC_HZ)
                    codes[max(0, first) : first + len(piece)] = piece[: max(0, count - first)]
                moved = gain * PIEZO_STACK.displacement_um(codes)
                moved += 0.01 * np.random.default_rng(1).standard_normal(moved.shape)
                return TimedRecording(moved, float(DAC_HZ), "um", "laser", began_s=began_s)

            yield finish

        return record

    links: list[MemoryLink] = []
    probe = probe_of(lambda codes: felt.append((links[0].clock(), codes)), recorder_on)
    with pytest.raises(AssertionError, match=reason) if reason else nullcontext():
        compare_movement(probe, lambda name, value: None)
