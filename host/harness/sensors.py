"""Records an actuator by a sensor of the bench: runs its program, and reads the file that it wrote."""

import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import textures
from host.harness.bench_file import Sensor
from textures import Recording

Recorder: TypeAlias = Callable[[float], Callable[[], Recording]]
"""Starts to record for so many seconds; what it returns waits for the end and gives the recording, m/s^2 or um."""

# A program may take so long to start, and to end after its time.
_STARTS_WITHIN_S = 1.0
_ENDS_WITHIN_S = 15.0


class SensorError(RuntimeError):
    """A sensor's program that failed, or a recording that cannot be used; the message says what to do."""


def recorder(sensor: Sensor) -> Recorder:
    """Return what records by a sensor's program. Raises SensorError, when it starts and when it gives its recording.

    It is started so long before what is played that the beginning is in the recording, as the harness waits for it.
    """

    def start(seconds: float) -> Callable[[], Recording]:
        folder = tempfile.TemporaryDirectory(prefix="vibrocast-")
        file = Path(folder.name) / f"recording{sensor.suffix}"
        values = {"{file}": str(file), "{seconds}": f"{seconds + _STARTS_WITHIN_S:g}"}
        command = [_filled(part, values) for part in sensor.command]
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
        except OSError as error:
            folder.cleanup()
            raise SensorError(
                f"sensor {sensor.name}: {command[0]} cannot be run ({error.strerror}); correct its command in the "
                "bench file"
            ) from error

        def finish() -> Recording:
            with folder:
                try:
                    _, complaint = process.communicate(timeout=seconds + _STARTS_WITHIN_S + _ENDS_WITHIN_S)
                except BaseException as error:
                    process.kill()
                    process.communicate()
                    if isinstance(error, subprocess.TimeoutExpired):
                        raise SensorError(f"sensor {sensor.name}: {command[0]} does not end by itself") from error
                    raise
                if process.returncode or not file.exists():
                    lines = complaint.strip().splitlines() or [f"exit code {process.returncode}"]
                    raise SensorError(f"sensor {sensor.name}: {command[0]} has recorded nothing: {lines[-1]}")
                return read_recording(sensor, file)

        return finish

    return start


def read_recording(sensor: Sensor, file: Path) -> Recording:
    """Read what a sensor has recorded: one channel, m/s^2 of an accelerometer, um of a laser. Raises SensorError."""
    try:
        full_scale = None if sensor.sensitivity is None else 1 / sensor.sensitivity
        recording = textures.load(
            file, rate_hz=sensor.rate_hz, unit=sensor.unit, full_scale=full_scale, axis=sensor.axis
        )
    except textures.TextureError as error:
        raise SensorError(f"sensor {sensor.name}: {error}") from error
    wanted = {"accelerometer": "m/s^2", "laser": "um"}[sensor.kind]
    if recording.unit != wanted:
        raise SensorError(
            f"sensor {sensor.name}: a {sensor.kind} whose recording is in {recording.unit}; give its unit and "
            "sensitivity in the bench file"
        )
    if recording.channels != 1:
        raise SensorError(
            f"sensor {sensor.name}: a recording of {recording.channels} channels; record one, or give axis"
        )
    return recording


def _filled(part: str, values: dict[str, str]) -> str:
    for placeholder, value in values.items():
        part = part.replace(placeholder, value)
    return part
