"""Records an actuator by a sensor of the bench: at an input of this computer, or by a program that writes a file."""

import contextlib
import math
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np

from vibrocast import textures
from vibrocast.errors import VibrocastError
from vibrocast.harness.recorder import Levels, pieces
from vibrocast.host.bench_file import InputSensor, ProgramSensor, Sensor
from vibrocast.host.controller import Controller
from vibrocast.host.sources import Source, open_source
from vibrocast.output.actuator import Actuator, analog_response
from vibrocast.textures import Recording
from vibrocast.textures.recording import Signal
from vibrocast.textures.sensitivity import parse


@dataclass(frozen=True)
class TimedRecording(Recording):
    """A recording at an input of this computer. `began_s`: when its first sample came here, by time.monotonic."""

    began_s: float = 0.0


Recorder: TypeAlias = Callable[[float], AbstractContextManager[Callable[[], Recording]]]
"""Records for so many seconds; what it yields waits for the end and gives the recording, m/s^2 or um."""

AROUND_S = 1.0
"""Recorded before and after what is played: how late the controller starts, and the ends that filters need."""
# A program may take so long to start, and to end after its time.
_STARTS_WITHIN_S = 1.0
_ENDS_WITHIN_S = 15.0
_MAX_COMPLAINT_BYTES = 500


class SensorError(VibrocastError):
    """A sensor's program that failed, or a recording that cannot be used; the message says what to do."""


def recorder(sensor: Sensor) -> Recorder:
    """Return what records by a sensor. Raises SensorError, when it starts and when it gives its recording.

    It begins so long before what is played that the beginning is in the recording, as the harness waits for it. The
    processes of a program have ended when the block is left, in any way.
    """
    if isinstance(sensor, InputSensor):
        return partial(_at_input, sensor)
    assert isinstance(sensor, ProgramSensor), "the only other kind"

    @contextlib.contextmanager
    def record(seconds: float) -> Iterator[Callable[[], Recording]]:
        with tempfile.TemporaryDirectory(prefix="vibrocast-", ignore_cleanup_errors=True) as folder:
            file, complaints = Path(folder) / f"recording{sensor.suffix}", Path(folder) / "complaints"
            values = {"{file}": str(file), "{seconds}": f"{seconds + _STARTS_WITHIN_S:g}"}
            command = [_filled(part, values) for part in sensor.command]
            with complaints.open("wb") as stderr:  # children of the program would hold a pipe open
                process = _start(sensor, command, stderr)
            try:
                yield partial(_finish, sensor, process, file, complaints, seconds + _STARTS_WITHIN_S + _ENDS_WITHIN_S)
            finally:
                # In a session of its own: the children of a shell end with it.
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    return record


def behind(record: Recorder, actuator: Actuator) -> Recorder:
    """Return a recorder of the displacement, um, that an actuator's model makes of a recorded drive signal."""

    @contextlib.contextmanager
    def recorded_behind(seconds: float) -> Iterator[Callable[[], Recording]]:
        with record(seconds) as finish:
            yield lambda: moved_by(finish(), actuator)

    return recorded_behind


def moved_by(drive: Recording, actuator: Actuator) -> Recording:
    """Return the displacement, um, that a drive signal in parts of full scale makes, at its rate."""
    count = len(drive.samples)
    frequencies_hz = np.asarray(np.fft.rfftfreq(count, 1 / drive.rate_hz), np.float64)
    response = actuator.excursion_um * analog_response(frequencies_hz, actuator.corner_hz, actuator.quality)
    moved_um = np.fft.irfft(np.fft.rfft(drive.samples, axis=0) * response[:, None], count, axis=0)
    return Recording(moved_um, drive.rate_hz, "um", drive.name)


@contextlib.contextmanager
def recorded(
    recorder: Recorder | None, controller: Controller, seconds: float
) -> Iterator[Callable[[], Recording] | None]:
    """Record what is played in the block, for so many seconds, with AROUND_S before and after it.

    Yields what waits for the recording; None without a recorder. Raises SensorError.
    """
    with contextlib.nullcontext() if recorder is None else recorder(seconds + 2 * AROUND_S) as finish:
        if finish is not None:
            controller.sleep(AROUND_S)
        yield finish


@contextlib.contextmanager
def _at_input(sensor: InputSensor, seconds: float) -> Iterator[Callable[[], Recording]]:
    """Record these seconds at a sensor's input, from now on. Raises SensorError."""
    with contextlib.ExitStack() as stack:
        try:
            source = stack.enter_context(
                open_source(
                    sensor.input,
                    None if sensor.sensitivity is None else parse(sensor.sensitivity),
                    sensor.volts_full_scale,
                    axes=(sensor.axis or "").lower(),
                    rate_hz=sensor.rate_hz,
                )
            )
        except VibrocastError as error:
            raise SensorError(f"sensor {sensor.name}: {error}") from error
        if source.channels != 1:
            raise SensorError(
                f"sensor {sensor.name}: {source.channels} channels; give axis, or the number of a channel"
            )
        _check_unit(sensor, source.unit)
        collector = _Collector(sensor, source, seconds)
        stack.callback(collector.stop)
        yield collector.finish


class _Collector:
    """Reads a source in a thread of its own until the recording is complete."""

    def __init__(self, sensor: Sensor, source: Source, seconds: float) -> None:
        self._sensor, self._source = sensor, source
        self._wanted = round(seconds * source.rate_hz)
        self._pieces: list[Signal] = []
        self._levels = Levels(source)
        self._began_s = math.inf
        self._failure: Exception | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._collect, name=sensor.name)
        self._within_s = seconds + _ENDS_WITHIN_S
        self._thread.start()

    def _collect(self) -> None:
        count = 0
        try:
            for piece in pieces(self._source):
                self._levels.watch(piece)
                self._pieces.append(piece)
                count += len(piece)
                # The one that came soonest after its samples were taken tells best when the first one came.
                self._began_s = min(self._began_s, time.monotonic() - count / self._source.rate_hz)
                if count >= self._wanted or self._ending.is_set():
                    break
        except Exception as failure:  # `finish` raises it
            self._failure = failure

    def stop(self) -> None:
        """End the thread; may be called again."""
        self._ending.set()
        self._thread.join()

    def finish(self) -> Recording:
        """Return the recording, when it is complete. Raises SensorError, also for a clipped one and one with gaps."""
        self._thread.join(self._within_s)
        complete = not self._thread.is_alive()
        self.stop()
        self._levels.finish()
        name = self._sensor.name
        if self._failure is not None:
            raise SensorError(f"sensor {name}: {self._failure}") from self._failure
        if not complete:
            raise SensorError(f"sensor {name}: fewer samples than its rate says; check its rate_hz and its cable")
        if self._levels.clipping.runs:
            raise SensorError(f"sensor {name}: its recording is clipped; lower the gain of its amplifier")
        if self._source.losses.gaps:
            raise SensorError(
                f"sensor {name}: samples were lost {self._source.losses.gaps} times; close other programs"
            )
        samples = np.concatenate(self._pieces)[: self._wanted]
        return TimedRecording(samples, float(self._source.rate_hz), self._source.unit, name, began_s=self._began_s)


def _start(sensor: Sensor, command: list[str], stderr: BinaryIO) -> "subprocess.Popen[bytes]":
    try:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True
        )
    except OSError as error:
        raise SensorError(
            f"sensor {sensor.name}: {command[0]} cannot be run ({error.strerror}); correct its command in the bench "
            "file"
        ) from error


def _finish(
    sensor: ProgramSensor, process: "subprocess.Popen[bytes]", file: Path, complaints: Path, within_s: float
) -> Recording:
    """Wait for a sensor's program and return what it has recorded. Raises SensorError."""
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired as error:
        raise SensorError(
            f"sensor {sensor.name}: {sensor.command[0]} does not end by itself; correct its command in the bench file"
        ) from error
    if process.returncode or not file.exists():
        with complaints.open("rb") as said:
            said.seek(max(0, complaints.stat().st_size - _MAX_COMPLAINT_BYTES))
            lines = said.read().decode(errors="replace").strip().splitlines() or [f"exit code {process.returncode}"]
        raise SensorError(
            f"sensor {sensor.name}: {sensor.command[0]} has recorded nothing ({lines[-1]}); check the sensor"
        )
    return read_recording(sensor, file)


def read_recording(sensor: ProgramSensor, file: Path) -> Recording:
    """Read what a sensor has recorded: one channel, m/s^2 of an accelerometer, um of a laser. Raises SensorError."""
    try:
        full_scale = None if sensor.sensitivity is None else 1 / sensor.sensitivity
        recording = textures.load(
            file,
            rate_hz=sensor.rate_hz,
            unit=sensor.unit,
            full_scale=full_scale,
            columns=sensor.axis,
            reduce=sensor.reduce,
        )
    except textures.TextureError as error:
        raise SensorError(f"sensor {sensor.name}: {error}") from error
    _check_unit(sensor, recording.unit)
    if recording.channels != 1:
        raise SensorError(
            f"sensor {sensor.name}: a recording of {recording.channels} channels; record one, or give axis or reduce"
        )
    return recording


def _check_unit(sensor: Sensor, unit: str) -> None:
    """Raise SensorError for a recording that is not in the unit of this kind of sensor."""
    required = {"accelerometer": "m/s^2", "laser": "um", "loop-back": "full scale"}[sensor.kind]
    if unit != required:
        raise SensorError(
            f"sensor {sensor.name}: a {sensor.kind} whose recording is in {unit}; give its unit and sensitivity in the "
            "bench file"
        )


def _filled(part: str, values: dict[str, str]) -> str:
    for placeholder, value in values.items():
        part = part.replace(placeholder, value)
    return part
