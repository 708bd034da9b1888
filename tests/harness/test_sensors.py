"""A sensor's program ends with the measurement, whatever happens; a sensor at an input calibrates an actuator."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Self

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import linked
from vibrocast.harness import response, sensors
from vibrocast.harness.sensors import SensorError, recorder
from vibrocast.host.bench_file import InputSensor, ProgramSensor
from vibrocast.output import sound_card
from vibrocast.output.actuator import PIEZO_STACK, VOICE_COIL, Actuator, Codes
from vibrocast.simulated_device.controller import Settings
from vibrocast.textures import Recording

OVERSAMPLING = 8
REAL = replace(VOICE_COIL, corner_hz=74.0, quality=4.1, stroke_um=1.3 * VOICE_COIL.stroke_um)


def shell(command: str) -> ProgramSensor:
    arguments = ("sh", "-c", command, "{file}")
    return ProgramSensor(name="it", kind="laser", controller="left", command=arguments)


def has_ended(pid_file: Path) -> bool:
    while not pid_file.exists() or not pid_file.read_text().strip():
        time.sleep(0.01)
    pid = int(pid_file.read_text())
    for _ in range(500):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        state = Path(f"/proc/{pid}/stat")
        if state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z":
            return True  # ended; whoever adopted it has not asked yet
        time.sleep(0.01)
    return False


def test_a_program_that_does_not_end_is_ended_with_what_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "_ENDS_WITHIN_S", 0.0)
    pid_file = tmp_path / "pid"
    with (
        pytest.raises(SensorError, match="does not end by itself"),
        recorder(shell(f"sleep 1000 & echo $! > {pid_file}; wait"))(0.0) as finish,
    ):
        finish()
    assert has_ended(pid_file)


def test_a_program_ends_where_playing_fails(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    with (
        pytest.raises(KeyboardInterrupt),
        recorder(shell(f"echo $$ > {pid_file}; exec sleep 1000"))(1000.0),
    ):
        while not pid_file.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert has_ended(pid_file)


class FakeCapture:
    """A sound card whose channel measures the acceleration of an actuator, once the harness wants its recording."""

    def __init__(self, codes: list[Codes], real: Actuator, full_scale: float) -> None:
        self.rate_hz, self.overruns = OVERSAMPLING * real.dac_rate_hz, 0
        self.wanted = threading.Event()
        self._codes, self._real, self._full_scale = codes, real, full_scale
        self._given = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def wait_for_begin(self) -> None:
        pass

    def read(self, timeout_s: float) -> NDArray[np.float32]:
        if not self.wanted.wait(0.01):
            return np.zeros((0, 1), np.float32)
        if self._given:
            return np.zeros((self.rate_hz, 1), np.float32)
        self._given = True
        before = np.zeros((self._real.dac_rate_hz // 3, 1), np.int16)
        skin_um = self._real.displacement_um(np.concatenate((before, *self._codes, before)), OVERSAMPLING)[:, 0]
        acceleration = 1e-6 * np.gradient(np.gradient(skin_um)) * self.rate_hz**2
        return (acceleration / self._full_scale).astype(np.float32)[:, None]


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], response.Fit]:
    """A function that fits a voice coil from an accelerometer on a sound card of this full scale, in m/s^2."""

    def fit(full_scale: float) -> response.Fit:
        codes: list[Codes] = []
        _, controller = linked(Settings(actuator=VOICE_COIL), on_dac=codes.append)
        capture = FakeCapture(codes, REAL, full_scale)
        monkeypatch.setattr(sound_card, "find", lambda name, recording: SimpleNamespace(name=name))
        monkeypatch.setattr(sound_card, "Capture", lambda card, channels, rate_hz: capture)
        sensor = InputSensor(
            name="it",
            kind="accelerometer",
            controller="left",
            input="audio:card:2",
            sensitivity="10mV/(m/s^2)",
            volts_full_scale=0.01 * full_scale,
        )

        @contextmanager
        def record(seconds: float) -> Iterator[Callable[[], Recording]]:
            codes.clear()
            with recorder(sensor)(seconds) as finish:

                def finished() -> Recording:
                    capture.wanted.set()
                    return finish()

                yield finished

        return response.measure_response(controller, VOICE_COIL, recorder=record, seconds=2.0).fit

    return fit


def test_an_accelerometer_on_a_sound_card_finds_corner_quality_and_stroke(
    measured: Callable[[float], response.Fit],
) -> None:
    fit = measured(100.0)
    assert fit.corner_hz == pytest.approx(REAL.corner_hz, rel=0.02)
    assert fit.quality == pytest.approx(REAL.quality, rel=0.03)
    assert fit.stroke_um == pytest.approx(REAL.stroke_um, rel=0.03)


def test_a_clipped_recording_is_no_measurement(measured: Callable[[float], response.Fit]) -> None:
    with pytest.raises(SensorError, match="its recording is clipped; lower the gain"):
        measured(1e-3)


@pytest.mark.parametrize("actuator", [VOICE_COIL, PIEZO_STACK], ids=["resonance", "low-pass"])
def test_a_recorded_drive_signal_moves_the_model_as_the_codes_do(actuator: Actuator) -> None:
    oversampling, rng = 16, np.random.default_rng(5)
    codes = np.zeros((8000, 1), np.int16)
    codes[1000:3000, 0] = np.round(0.1 * actuator.full_scale * rng.standard_normal(2000))
    drive = np.repeat(codes / actuator.full_scale, oversampling, axis=0)
    moved = sensors.moved_by(Recording(drive, oversampling * actuator.dac_rate_hz, "full scale", "adc"), actuator)
    expected_um = actuator.displacement_um(codes, oversampling)
    assert moved.unit == "um"
    assert np.max(np.abs(moved.samples - expected_um)) < 0.05 * np.max(np.abs(expected_um))  # half a DAC sample of hold
