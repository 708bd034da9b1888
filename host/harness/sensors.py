"""Records an actuator by a sensor of the bench: runs its program, and reads the file that it wrote."""

import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import BinaryIO, TypeAlias

from vibrocast import textures
from vibrocast.host.bench_file import Sensor
from vibrocast.textures import Recording

Recorder: TypeAlias = Callable[[float], AbstractContextManager[Callable[[], Recording]]]
"""Records for so many seconds; what it yields waits for the end and gives the recording, m/s^2 or um."""

# A program may take so long to start, and to end after its time.
_STARTS_WITHIN_S = 1.0
_ENDS_WITHIN_S = 15.0
_MAX_COMPLAINT_BYTES = 500


class SensorError(RuntimeError):
    """A sensor's program that failed, or a recording that cannot be used; the message says what to do."""


def recorder(sensor: Sensor) -> Recorder:
    """Return what records by a sensor's program. Raises SensorError, when it starts and when it gives its recording.

    It is started so long before what is played that the beginning is in the recording, as the harness waits for it.
    Its processes have ended when the block is left, in any way.
    """

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
    sensor: Sensor, process: "subprocess.Popen[bytes]", file: Path, complaints: Path, within_s: float
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


def read_recording(sensor: Sensor, file: Path) -> Recording:
    """Read what a sensor has recorded: one channel, m/s^2 of an accelerometer, um of a laser. Raises SensorError."""
    try:
        full_scale = None if sensor.sensitivity is None else 1 / sensor.sensitivity
        recording = textures.load(
            file,
            rate_hz=sensor.rate_hz,
            unit=sensor.unit,
            full_scale=full_scale,
            axis=sensor.axis,
            reduce=sensor.reduce,
        )
    except textures.TextureError as error:
        raise SensorError(f"sensor {sensor.name}: {error}") from error
    required = {"accelerometer": "m/s^2", "laser": "um"}[sensor.kind]
    if recording.unit != required:
        raise SensorError(
            f"sensor {sensor.name}: a {sensor.kind} whose recording is in {recording.unit}; give its unit and "
            "sensitivity in the bench file"
        )
    if recording.channels != 1:
        raise SensorError(
            f"sensor {sensor.name}: a recording of {recording.channels} channels; record one, or give axis or reduce"
        )
    return recording


def _filled(part: str, values: dict[str, str]) -> str:
    for placeholder, value in values.items():
        part = part.replace(placeholder, value)
    return part
