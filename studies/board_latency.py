"""Writes the delay to a board's pin, part by part: `python -m studies.board_latency --out docs/benchmarks`."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from studies import latency, page
from vibrocast import textures
from vibrocast.harness.boards.stm32f405 import Stm32F405
from vibrocast.harness.latency import Latency, measure_latency
from vibrocast.harness.sensors import TimedRecording
from vibrocast.host import live
from vibrocast.host.controller import Controller as Host
from vibrocast.host.devices import session_with
from vibrocast.output.actuator import PIEZO_STACK, VOICE_COIL, Actuator, Codes
from vibrocast.output.actuator_constants import board_source
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.memory_link import MemoryLink, SimulatedTime
from vibrocast.textures import Recording

ACTUATORS = (
    VOICE_COIL,
    PIEZO_STACK,
    replace(PIEZO_STACK, name=f"{PIEZO_STACK.name} at {VOICE_COIL.dac_rate_hz} Hz", dac_rate_hz=VOICE_COIL.dac_rate_hz),
)
"""With a DAC of 8000 Hz, of 3000 Hz, and of 8000 Hz again."""
TARGET_MS = 10.0
RATE_HZ = live.LOW_DELAY_RATE_HZ
SECONDS = 1.0
PARTS = {
    **{name: meaning for name, meaning in latency.PARTS.items() if name not in ("wake", "encode", "send")},
    "port": "the board's port: samples wait while the next block is decoded",
}
"""In the order in which a sample goes through them; the host's own work takes no simulated time."""
_DAC_BITS_LESS = 4
_STEP_US = 100


@dataclass
class Pin:
    """A recorder of the codes at a controller's output in simulated time; `bits_less` than the actuator's."""

    actuator: Actuator
    bits_less: int = 0
    runs: list[tuple[float, Codes]] = field(default_factory=list)

    def measure(self, device: Callable[[Callable[[Codes], None]], Device]) -> Latency:
        """Stream a texture live with little delay to a controller, and measure the way to its output."""
        self.link = MemoryLink(device(self._note), time=SimulatedTime(step_us=_STEP_US))
        session = session_with(Host(self.link, self.link.clock, self.link.sleep), "sim")
        return measure_latency(
            session,
            textures.GENERATORS["rough"](3, SECONDS),
            seconds=SECONDS,
            rate_hz=RATE_HZ,
            setting={"hop": "16"},
            playout_delay_s=live.LOW_DELAY_PLAYOUT_S,
            recorder=self._record,
        )

    def _note(self, codes: Codes) -> None:
        self.runs.append((self.link.clock(), codes))

    @contextlib.contextmanager
    def _record(self, seconds: float) -> Iterator[Callable[[], Recording]]:
        self.runs.clear()

        def finish() -> Recording:
            (ended_s, first), rate_hz = self.runs[0], self.actuator.dac_rate_hz
            codes = np.concatenate([run for _, run in self.runs])[:, :1] * (1 << self.bits_less)
            skin_um = self.actuator.displacement_um(codes)
            return TimedRecording(skin_um, rate_hz, "um", "pin", began_s=ended_s - len(first) / rate_hz)

        yield finish


@dataclass(frozen=True)
class Row:
    """A part of the delay to a board's pin; the part "total" is the whole."""

    actuator: str
    part: str
    delay_ms: float


def delays_ms(actuator: Actuator, folder: Path) -> dict[str, float]:
    """Return the parts of the delay to the pin of a board that is built for an actuator, with its source in `folder`.

    The port's is what comes on top of a simulated controller with the same actuator, which has no port.
    """
    source = folder / f"{actuator.name}.c"
    source.write_text(board_source(actuator), encoding="utf-8")
    board = Pin(actuator, _DAC_BITS_LESS).measure(lambda on_dac: Stm32F405(on_dac=on_dac, actuator=source))
    without = Pin(actuator).measure(lambda on_dac: Controller(Settings(actuator=actuator), on_dac=on_dac))
    assert board.to_sensor_ms is not None and without.to_sensor_ms is not None, "their output was recorded"
    parts = {name: delay for name, delay in latency.live_parts(board).items() if name in PARTS}
    parts["port"] = board.to_sensor_ms - board.total_ms - (without.to_sensor_ms - without.total_ms)
    return parts


@page.study
def main(out: Path) -> None:
    """Measure the delay to the pin of emulated boards, and write that part of the page latency.md."""
    with tempfile.TemporaryDirectory() as folder:
        found = {actuator.name: delays_ms(actuator, Path(folder)) for actuator in ACTUATORS}
    totals = {name: sum(parts.values()) for name, parts in found.items()}
    rows = [
        Row(name, part, round(delay_ms, 2))
        for name, parts in found.items()
        for part, delay_ms in [*parts.items(), ("total", totals[name])]
    ]
    text = page.render("board_latency", globals(), found=found, totals=totals)
    page.publish(out, "latency", text, [("board_latency.csv", rows, Row)])


if __name__ == "__main__":
    main()
