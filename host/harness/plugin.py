"""The pytest plugin: a team's own tests run on the simulated controller at a desk and on the real one at the bench.

It is loaded with every pytest of the environment, so it imports what it needs only when a test asks for it. Where it is
loaded by its module's name as well, `-p no:vibrocast -p vibrocast.host.harness.plugin` keeps the two from colliding.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from vibrocast.host.controller import Controller
    from vibrocast.host.end_to_end import Outcome
    from vibrocast.host.harness.bench_file import Bench
    from vibrocast.simulated_device.actuator import Actuator
    from vibrocast.textures import Recording

_BENCH = pytest.StashKey["Bench"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that say what to test."""
    group = parser.getgroup("vibrocast", "tactor controllers")
    group.addoption(
        "--device",
        metavar="ADDRESS",
        help="controller to test: an address as `vibrocast devices` lists them, or a name in the bench file; "
        "the first one of the bench file if not given, and the simulated one without a bench file",
    )
    group.addoption("--bench", metavar="FILE.toml", help="bench file: controllers, actuators, sensors, textures")
    group.addoption("--plan", metavar="PLAN.toml", help="plan of `vibrocast plan`, in place of a bench file")


def pytest_configure(config: pytest.Config) -> None:
    """Read the bench file or the plan, so that a mistake in it is told before any test runs."""
    path, plan_path = config.getoption("bench"), config.getoption("plan")
    if path is None and plan_path is None:
        return
    if path is not None and plan_path is not None:
        raise pytest.UsageError("a plan and a bench file both say what is there: drop one of them")
    from vibrocast.host.input_files import InputFileError

    try:
        if path is not None:
            from vibrocast.host.harness.bench_file import read_bench

            config.stash[_BENCH] = read_bench(Path(path))
        else:
            from vibrocast.host.planner.plan_file import read_plan

            config.stash[_BENCH] = read_plan(Path(plan_path)).bench()
    except (InputFileError, OSError) as error:
        raise pytest.UsageError(str(error)) from error


@pytest.fixture(scope="session")
def bench(pytestconfig: pytest.Config) -> "Bench":
    """The bench: that of --bench, or one with the controller of --device alone."""
    from vibrocast.host.harness.bench_file import BenchFileError, chosen

    try:
        return chosen(pytestconfig.stash.get(_BENCH, None), pytestconfig.getoption("device"))
    except BenchFileError as error:
        raise pytest.UsageError(str(error)) from error


@pytest.fixture
def controller(bench: "Bench") -> "Iterator[Controller]":
    """A session with the controller under test; its output is brought to rest after the test."""
    from vibrocast.host.harness.bench_file import connect

    with connect(bench, bench.first) as session:
        yield session
        session.stop()


@pytest.fixture
def actuator(bench: "Bench", controller: "Controller") -> "Actuator":
    """The model of the actuator on the controller's first channel: of the bench file, or as the controller says."""
    from vibrocast.host.harness.bench_file import actuator_of

    return actuator_of(bench, bench.first, controller.description.actuator)


@pytest.fixture
def play(bench: "Bench", controller: "Controller", actuator: "Actuator") -> "Callable[..., Outcome]":
    """Codes a texture, with what options `host.coding.encode` takes, plays it, and compares: `host.end_to_end.play`."""
    from vibrocast.host import coding, end_to_end
    from vibrocast.host.harness.bench_file import driven_actuator

    driven = driven_actuator(bench, bench.first, controller.description.actuator)

    def play_texture(texture: "Recording", **options: Any) -> "Outcome":
        encoding = coding.encode(texture, live=True, **options)
        return end_to_end.play(
            controller,
            bench.first.address,
            texture.name,
            encoding.stream,
            encoding,
            actuator=driven,
            skin_model=actuator,
        )

    return play_texture


@pytest.fixture(scope="session")
def scene(bench: "Bench") -> "tuple[Recording, ...]":
    """The textures to play: those of the bench file, or a generated one."""
    return bench.scene()
