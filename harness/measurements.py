"""The measurements by name, in the order of a run: on the bench's first controller, with the parts of the bench."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.timing import cpu_name
from vibrocast.harness import fidelity, latency, load, response
from vibrocast.harness.sensors import Recorder, behind, recorder
from vibrocast.host import bench_file, devices, player
from vibrocast.host.bench_file import Bench, InputSensor
from vibrocast.host.controller import Controller
from vibrocast.host.devices import Session
from vibrocast.host.figures import Noted
from vibrocast.host.track_player import PlayedList, TrackOptions, play_list
from vibrocast.output.actuator import actuator_differences
from vibrocast.textures import Recording

Progress = Callable[[float], None]
# Longer than any watchdog: what ends a silence then is not this buffer.
_FULL_BUFFER_S = 3600.0


@dataclass(frozen=True)
class Subject:
    """The parts that a run measures: a session, the sensor on the first channel if any, and textures.

    `sensor_is_timed`: it is at an input of this computer, which knows when its samples came.
    """

    session: Session
    recorder: Recorder | None
    sensor_name: str
    sensor_is_timed: bool
    scene: tuple[Recording, ...]


@dataclass(frozen=True)
class Together:
    """One of several controllers that played at the same time: whether as computed, or why it failed."""

    name: str
    as_computed: bool | None
    underruns: int | None
    failure: str | None


def subject(bench: Bench, session: Session) -> Subject:
    """Return what a run measures on a session with the first controller of the bench. Raises InputError."""
    sensor = bench.sensor
    record = None if sensor is None else recorder(sensor)
    if record is not None and sensor is not None and sensor.kind == "loop-back":
        record = behind(record, session.skin)
    return Subject(
        session,
        record,
        "" if sensor is None else sensor.name,
        isinstance(sensor, InputSensor),
        bench.scene(),
    )


def machine() -> dict[str, str]:
    """Return what is known of the host, for the report."""
    return {
        "vibrocast": version("vibrocast"),
        "processor": cpu_name(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def _gap(on: Subject, progress: Progress) -> tuple[load.Gap, ...]:
    buffers_s = player.BUFFER_S, _FULL_BUFFER_S
    return tuple(
        load.max_gap(on.session.controller, on.scene[0], buffer_s, progress=_part(progress, number, len(buffers_s)))
        for number, buffer_s in enumerate(buffers_s)
    )


def _fidelity(on: Subject, progress: Progress) -> tuple[fidelity.Fidelity, ...]:
    return tuple(
        fidelity.measure_fidelity(
            on.session,
            texture,
            recorder=on.recorder,
            sensor_name=on.sensor_name,
            progress=_part(progress, number, len(on.scene)),
        )
        for number, texture in enumerate(on.scene)
    )


def _part(progress: Progress, number: int, count: int) -> Progress:
    """Return the progress of one of several measurements that take about as long."""
    return lambda part: progress((number + part) / count)


MEASUREMENTS: Mapping[str, Callable[[Subject, Progress], Any]] = {
    "latency": lambda on, progress: latency.measure_credible_latency(
        on.session,
        on.scene[0],
        recorder=on.recorder if on.sensor_is_timed else None,
        progress=progress,
    ),
    "smallest": lambda on, progress: latency.find_min_latency(on.session, on.scene[0], progress=progress),
    "throughput": lambda on, _: load.throughput(on.session.controller, on.scene[0]),
    "load": lambda on, progress: load.underruns(on.session.controller, on.scene[0], progress),
    "gap": _gap,
    "fidelity": _fidelity,
    "response": lambda on, progress: response.measure_response(
        on.session.controller,
        on.session.skin,
        recorder=on.recorder,
        sensor_name=on.sensor_name,
        progress=progress,
    ),
}


def together(bench: Bench) -> tuple[Together, ...]:
    """Play the bench's first texture on all its controllers at once, and compare each one's codes with those computed.

    A controller that fails does so alone. Raises InputError, CodecError.
    """
    stream = encode_recording(bench.scene()[0], live=True).stream
    sessions = {each.name: bench_file.connect(bench, each) for each in bench.controllers}
    with devices.open_all(sessions) as (opened, failures):
        played = play_list(opened, [stream], TrackOptions())
    measured = []
    for name in sessions:
        result = failures.get(name) or played[name]
        if isinstance(result, PlayedList) and result.playback is not None:
            report = result.playback.report
            measured.append(Together(name, report.dac_equals_offline, report.underruns, None))
        else:
            measured.append(Together(name, None, None, str(result)))
    return tuple(measured)


def misfits(bench: Bench, fitted: response.Response | None) -> list[Noted]:
    """Return how the actuator that a sensor measured differs from the bench's, in words.

    `fitted`: the measured response, None = not measured. Without a sensor, it is that of the model itself. Without a
    bench file, the actuator is what the fit begins with, and nothing to be held to.
    """
    expected = bench.actuator(bench.first.name)
    if fitted is None or expected is None or bench.sha256 is None:
        return []
    differences = actuator_differences(expected, fitted.actuator)
    return [Noted(f"response: {difference}; check the actuator and its cable") for difference in differences]


def device_facts(bench: Bench, controller: Controller) -> dict[str, Any]:
    """Return what the report says of the controller: `devices.facts` and its address."""
    return {"name": bench.first.name, "address": bench.first.address, **devices.facts(controller)}
