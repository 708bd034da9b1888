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
    from vibrocast.host.harness.faulty_transport import FaultyTransport
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
    group.addoption(
        "--vibrocast-wait-s",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="wait so long for a controller that is absent, or that another process uses; default: 0",
    )
    group.addoption(
        "--vibrocast-skip-missing", action="store_true", help="skip tests whose controller is still absent then"
    )
    group.addoption(
        "--vibrocast-keep",
        metavar="FOLDER",
        help="keep the last frames on the wire of each failed test in this folder, as TEST.pcapng",
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


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Repeat a test that asks for `vibrocast_texture` for each texture of the bench file."""
    if "vibrocast_texture" in metafunc.fixturenames:
        bench = _read(metafunc.config)
        names = ("wood",) if bench is None else bench.texture_names
        metafunc.parametrize("vibrocast_texture", range(len(names)), ids=names, indirect=True)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Note for the fixtures whether a test has failed."""
    outcome: Any = yield
    if outcome.get_result().failed:
        vars(item)["vibrocast_failed"] = True


@pytest.fixture
def vibrocast_wire(request: pytest.FixtureRequest, vibrocast_bench: Bench) -> Iterator[FaultyTransport]:
    """The way to the controller under test; `damage` and `pull_cable` break it."""
    import time

    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.host import devices
    from vibrocast.host.harness.faulty_transport import FaultyTransport
    from vibrocast.host.tracing import tracer

    config, first = request.config, vibrocast_bench.first
    until_s = time.monotonic() + config.getoption("vibrocast_wait_s")
    tracer.take()
    while True:
        way = devices.reach(first.address, actuator=vibrocast_bench.actuator(first.name))
        try:
            transport = way.__enter__()
            break
        except TransportError as error:
            if time.monotonic() >= until_s:
                if config.getoption("vibrocast_skip_missing"):
                    pytest.skip(str(error))
                raise
            time.sleep(0.1)
    try:
        yield FaultyTransport(transport)
    finally:
        way.__exit__(None, None, None)
        folder = config.getoption("vibrocast_keep")
        if folder is not None and vars(request.node).get("vibrocast_failed"):
            Path(folder).mkdir(parents=True, exist_ok=True)
            name = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in request.node.name)
            tracer.save(Path(folder) / f"{name}.pcapng")


@pytest.fixture
def vibrocast_device(vibrocast_bench: Bench, vibrocast_wire: FaultyTransport) -> Iterator[Controller]:
    """A session with the controller under test. Its output is brought to rest after the test."""
    import contextlib

    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.host.bench_file import check_actuator
    from vibrocast.host.controller import Controller, ControllerError

    session = Controller(vibrocast_wire)
    check_actuator(vibrocast_bench, vibrocast_bench.first, session.description.actuator)
    yield session
    vibrocast_wire.damage()
    with contextlib.suppress(ControllerError, TransportError):  # a test may leave the cable out
        session.stop()


@pytest.fixture
def vibrocast_power_cycle(vibrocast_bench: Bench, vibrocast_device: Controller) -> Callable[..., None]:
    """A function that takes the device's power away and gives it back, by the program in the bench file.

    It waits until the device answers again, for `within_s` at most, 30 by default. Without a program, the test is
    skipped.
    """
    from vibrocast.host.bench_file import PoweredController

    first = vibrocast_bench.first
    program = first.power_cycle if isinstance(first, PoweredController) else None
    if program is None:
        pytest.skip(f"controller {first.name} has no power_cycle in the bench file")

    def power_cycle(within_s: float = 30.0) -> None:
        import subprocess

        subprocess.run(program, stdin=subprocess.DEVNULL, check=True, timeout=within_s)
        vibrocast_device.reconnect(within_s)

    return power_cycle


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
    Report. The test fails where the playback misses limits of the bench file.
    """
    from vibrocast.codec.encoding import encode_recording
    from vibrocast.host import end_to_end
    from vibrocast.host.bench_file import driven_actuator
    from vibrocast.host.bench_limits import missed

    first = vibrocast_bench.first
    driven = driven_actuator(vibrocast_bench, first, vibrocast_device.description.actuator)

    def play_texture(texture: Recording, **options: Any) -> Outcome:
        encoding = encode_recording(texture, live=True, **options)
        outcome = end_to_end.play(
            vibrocast_device,
            first.address,
            texture.name,
            encoding.stream,
            encoding,
            actuator=driven,
            skin_model=vibrocast_actuator,
        )
        if lines := missed(vibrocast_bench.limits, outcome.report.judged()):
            pytest.fail(f"limits missed: {'; '.join(lines)}")
        return outcome

    return play_texture


@pytest.fixture(scope="session")
def vibrocast_scene(vibrocast_bench: Bench) -> tuple[Recording, ...]:
    """The textures of the bench file; a generated one without a bench file."""
    return vibrocast_bench.scene()


@pytest.fixture
def vibrocast_texture(request: pytest.FixtureRequest, vibrocast_bench: Bench) -> Recording:
    """One texture of the bench file; the test runs once for each, and the texture's name is in its own."""
    loaders = vibrocast_bench.textures
    texture: Recording = loaders[request.param]() if loaders else vibrocast_bench.scene()[0]
    return texture
