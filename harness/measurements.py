"""The measurements by name, in the order of a run: on the bench's first controller, with the parts of the bench."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from vibrocast.codec.encoding import encode_recording
from vibrocast.harness import fidelity, latency, load, response
from vibrocast.harness.sensors import Recorder, recorder
from vibrocast.host import bench_file, devices, player
from vibrocast.host.bench_file import Bench
from vibrocast.host.controller import Controller
from vibrocast.host.event_loop import run_all
from vibrocast.output.actuator import Actuator
from vibrocast.output.rendering import render
from vibrocast.textures import Recording

Progress = Callable[[float], None]
# Longer than any watchdog: what ends a silence then is not this buffer.
_FULL_BUFFER_S = 3600.0


@dataclass(frozen=True)
class Subject:
    """The parts that a run measures: a session, the first channel's actuator, its sensor if any, and textures.

    `actuator`: the model that the controller works with; `skin_model`: the one that the bench has there.
    `sensor_is_timed`: it is at an input of this computer, which knows when its samples came.
    """

    bench: Bench
    controller: Controller
    actuator: Actuator
    skin_model: Actuator
    recorder: Recorder | None
    sensor_name: str
    sensor_is_timed: bool
    scene: tuple[Recording, ...]

    @property
    def address(self) -> str:
        """The controller's address."""
        return self.bench.first.address


@dataclass(frozen=True)
class Together:
    """One of several controllers that played at the same time: whether as computed, or why it failed."""

    name: str
    as_computed: bool | None
    underruns: int | None
    failure: str | None


def subject(bench: Bench, controller: Controller) -> Subject:
    """Return what a run measures on a session with the first controller of the bench. Raises InputError."""
    sensors = [each for each in bench.sensors if each.controller == bench.first.name and each.channel == 1]
    return Subject(
        bench,
        controller,
        bench_file.driven_actuator(bench, bench.first, controller.description.actuator),
        bench_file.actuator_of(bench, bench.first, controller.description.actuator),
        recorder(sensors[0]) if sensors else None,
        sensors[0].name if sensors else "",
        bool(sensors and sensors[0].input),
        bench.scene(),
    )


def machine() -> dict[str, str]:
    """Return what is known of the host, for the report."""
    return {
        "vibrocast": version("vibrocast"),
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def _processor() -> str:
    """Return the name of the processor as Linux gives it, or else as Python does."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


def _gap(on: Subject, progress: Progress) -> list[load.Gap]:
    buffers_s = player.BUFFER_S, _FULL_BUFFER_S
    return [
        load.max_gap(on.controller, on.scene[0], buffer_s, progress=_part(progress, number, len(buffers_s)))
        for number, buffer_s in enumerate(buffers_s)
    ]


def _fidelity(on: Subject, progress: Progress) -> list[fidelity.Fidelity]:
    return [
        fidelity.measure_fidelity(
            on.controller,
            on.address,
            texture,
            actuator=on.actuator,
            skin_model=on.skin_model,
            recorder=on.recorder,
            sensor_name=on.sensor_name,
            progress=_part(progress, number, len(on.scene)),
        )
        for number, texture in enumerate(on.scene)
    ]


def _part(progress: Progress, number: int, count: int) -> Progress:
    """Return the progress of one of several measurements that take about as long."""
    return lambda part: progress((number + part) / count)


MEASUREMENTS: Mapping[str, Callable[[Subject, Progress], Any]] = {
    "latency": lambda on, progress: latency.measure_credible_latency(
        on.controller,
        on.actuator,
        on.scene[0],
        recorder=on.recorder if on.sensor_is_timed else None,
        progress=progress,
    ),
    "smallest": lambda on, progress: latency.find_min_latency(
        on.controller, on.actuator, on.scene[0], progress=progress
    ),
    "throughput": lambda on, _: load.throughput(on.controller, on.scene[0]),
    "load": lambda on, progress: load.underruns(on.controller, on.scene[0], progress),
    "gap": _gap,
    "fidelity": _fidelity,
    "response": lambda on, progress: response.measure_response(
        on.controller, on.skin_model, recorder=on.recorder, sensor_name=on.sensor_name, progress=progress
    ),
}


def together(bench: Bench) -> list[Together]:
    """Play the bench's first texture on all its controllers at once, and compare each one's codes with those computed.

    A controller that fails does so alone. Raises InputError, CodecError.
    """
    stream = encode_recording(bench.scene()[0], live=True).stream
    offline, decoder = stream.decode_integers(), stream.decoder()
    sessions = {each.name: bench_file.connect(bench, each) for each in bench.controllers}
    settings = player.PlaybackSettings(capture=True)
    with devices.open_all(sessions) as (controllers, failures):
        works = {
            name: (each, player.play_steps(each, stream.header, stream.packets, decoder.packet_samples, settings))
            for name, each in controllers.items()
        }
        results = run_all(works)
    measured = []
    for each in bench.controllers:
        result = failures.get(each.name) or results[each.name]
        if isinstance(result, Exception):
            measured.append(Together(each.name, None, None, str(result)))
            continue
        actuator = bench_file.driven_actuator(bench, each, controllers[each.name].description.actuator)
        expected, _ = render(stream.header, offline, decoder.delay_samples, actuator)
        assert result.dac_codes is not None, "required"
        measured.append(Together(each.name, bool(np.array_equal(result.dac_codes, expected)), result.underruns, None))
    return measured


def misfits(bench: Bench, fitted: Any) -> list[str]:
    """Return how the actuator that a sensor measured differs from the bench's, in words.

    `fitted`: the measured response, None = not measured. Without a sensor, it is that of the model itself. Without a
    bench file, the actuator is what the fit begins with, and nothing to be held to.
    """
    expected = bench.actuator(bench.first.name)
    if fitted is None or expected is None or bench.sha256 is None:
        return []
    differences = bench_file.actuator_differences(expected, fitted.actuator)
    return [f"response: {difference}; check the actuator and its cable" for difference in differences]


def device_facts(bench: Bench, controller: Controller) -> dict[str, Any]:
    """Return what the report says of the controller: `devices.facts` and its address."""
    return {"name": bench.first.name, "address": bench.first.address, **devices.facts(controller)}
