"""The pytest plugin: a team's own tests run on the simulated controller at a desk and on the real one at the bench.

pytest loads it in every project of the environment, so it imports nothing but pytest until a test asks for a fixture.
Where you load it by its module's name as well, pass `-p no:vibrocast -p vibrocast.host.harness.plugin`.
"""

from __future__ import annotations  # no annotation is evaluated: an old pytest lacks some of the classes

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from vibrocast.host.bench_file import Bench
    from vibrocast.host.controller import Controller
    from vibrocast.host.end_to_end import Outcome
    from vibrocast.output.actuator import Actuator
    from vibrocast.textures import Recording


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that select the controller under test."""
    group = parser.getgroup("vibrocast", "haptic controllers")
    group.addoption(
        "--vibrocast-device",
        metavar="ADDRESS",
        help="controller to test: an address as `vibrocast devices` lists them, or a name in the bench file; "
        "default: the first one of the bench file, or the simulated one without a bench file",
    )
    group.addoption(
        "--vibrocast-bench", metavar="FILE.toml", help="bench file: controllers, actuators, sensors, textures"
    )
    group.addoption(
        "--vibrocast-allow-programs", action="store_true", help="let the bench file start programs as sensors"
    )
    group.addoption("--vibrocast-plan", metavar="PLAN.toml", help="plan of `vibrocast plan`, in place of a bench file")


def pytest_configure(config: pytest.Config) -> None:
    """Report a mistake in the bench file or the plan before any test runs."""
    _read(config)


def _read(config: pytest.Config) -> Bench | None:
    """Return the bench of the bench file or the plan; None without either. Raises pytest.UsageError."""
    path, plan_path = config.getoption("vibrocast_bench"), config.getoption("vibrocast_plan")
    if path is None and plan_path is None:
        return None
    if path is not None and plan_path is not None:
        raise pytest.UsageError("--vibrocast-bench and --vibrocast-plan both describe the bench; pass one of them")
    from vibrocast.files import InputFileError

    try:
        if path is not None:
            from vibrocast.host.bench_file import read_bench

            return read_bench(Path(path), config.getoption("vibrocast_allow_programs"))
        from vibrocast.host.planner import read_plan

        return read_plan(Path(plan_path)).bench()
    except (InputFileError, OSError) as error:
        raise pytest.UsageError(str(error).replace("--allow-programs", "--vibrocast-allow-programs")) from error


@pytest.fixture(scope="session")
def vibrocast_bench(pytestconfig: pytest.Config) -> Bench:
    """The bench of --vibrocast-bench or --vibrocast-plan; without them, the controller of --vibrocast-device."""
    from vibrocast.host.bench_file import BenchFileError, choose_controller

    try:
        return choose_controller(_read(pytestconfig), pytestconfig.getoption("vibrocast_device"))
    except BenchFileError as error:
        raise pytest.UsageError(str(error)) from error


@pytest.fixture
def vibrocast_device(vibrocast_bench: Bench) -> Iterator[Controller]:
    """A session with the controller under test. Its output is brought to rest after the test."""
    from vibrocast.host.bench_file import connect

    with connect(vibrocast_bench, vibrocast_bench.first) as session:
        yield session
        session.stop()


@pytest.fixture
def vibrocast_actuator(vibrocast_bench: Bench, vibrocast_device: Controller) -> Actuator:
    """The model of the actuator on the controller's first channel: from the bench file, or from the controller."""
    from vibrocast.host.bench_file import actuator_of

    return actuator_of(vibrocast_bench, vibrocast_bench.first, vibrocast_device.description.actuator)


@pytest.fixture
def vibrocast_play(
    vibrocast_bench: Bench, vibrocast_device: Controller, vibrocast_actuator: Actuator
) -> Callable[..., Outcome]:
    """A function that encodes a texture, plays it and compares: `vibrocast_play(texture, **options)`.

    The options are those of `vibrocast.codec.encoding.encode_recording`. It returns an Outcome, whose `report` is a
    Report.
    """
    from vibrocast.codec.encoding import encode_recording
    from vibrocast.host import end_to_end
    from vibrocast.host.bench_file import driven_actuator

    first = vibrocast_bench.first
    driven = driven_actuator(vibrocast_bench, first, vibrocast_device.description.actuator)

    def play_texture(texture: Recording, **options: Any) -> Outcome:
        encoding = encode_recording(texture, live=True, **options)
        return end_to_end.play(
            vibrocast_device,
            first.address,
            texture.name,
            encoding.stream,
            encoding,
            actuator=driven,
            skin_model=vibrocast_actuator,
        )

    return play_texture


@pytest.fixture(scope="session")
def vibrocast_scene(vibrocast_bench: Bench) -> tuple[Recording, ...]:
    """The textures of the bench file; a generated one without a bench file."""
    return vibrocast_bench.scene()
