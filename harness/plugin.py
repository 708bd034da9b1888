"""The pytest plugin: a team's own tests run on the simulated controller at a desk and on the real one at the bench.

pytest loads it in every project of the environment, so it imports nothing but pytest until a test asks for a fixture.
Where you load it by its module's name as well, pass `-p no:vibrocast -p vibrocast.harness.plugin`.
"""

from __future__ import annotations  # no annotation is evaluated: an old pytest lacks some of the classes

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import pytest

if TYPE_CHECKING:
    from vibrocast.device_protocol.messages import ImageDescription
    from vibrocast.harness.latency import Latency
    from vibrocast.harness.timed_transport import TimedTransport
    from vibrocast.host.bench_file import Bench
    from vibrocast.host.controller import Controller
    from vibrocast.host.devices import Session
    from vibrocast.host.figures import Value
    from vibrocast.host.playback import Playback
    from vibrocast.textures import Profile, Recording


class _HasFigures(Protocol):
    def figures(self) -> Iterable[Value]: ...


_Measured = TypeVar("_Measured", bound=_HasFigures)


_SERIAL_NUMBER = "vibrocast_serial_number"


def _seconds(text: str) -> float:
    """Return the value of an option in seconds. Raises argparse.ArgumentTypeError."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise argparse.ArgumentTypeError(f"{text} cannot be used; give a finite number of seconds of at least 0")
    return seconds


def _count(text: str) -> int:
    """Return the value of an option that counts. Raises argparse.ArgumentTypeError."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} cannot be used; give a whole number of at least 0")
    return int(text)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that select the controller under test."""
    group = parser.getgroup("vibrocast", "haptic controllers")
    group.addoption(
        "--vibrocast-device",
        action="append",
        metavar="ADDRESS",
        help="controller to test: an address as `vibrocast devices` lists them, or a name in the bench file; given "
        "several times, or as `all` of the bench file, each test runs on each; default: the first one of the bench "
        "file, or the simulated one without a bench file",
    )
    group.addoption(
        "--vibrocast-bench", metavar="FILE.toml", help="bench file: controllers, actuators, sensors, textures"
    )
    group.addoption(
        "--vibrocast-allow-programs", action="store_true", help="let the bench file start programs as sensors"
    )
    group.addoption(
        "--vibrocast-wait-s",
        type=_seconds,
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
        help="keep files of each test in this folder: the last frames on the wire; of each playback, a report and a "
        "picture; JUnit XML names the files",
    )
    group.addoption(
        "--vibrocast-timeout-s",
        type=_seconds,
        metavar="SECONDS",
        help="fail a test that still talks to its controller after so long; default: never",
    )

    group.addoption(
        "--vibrocast-tries",
        type=_count,
        default=1,
        metavar="NUMBER",
        help="measure so many times at most what this machine was too busy to decide, then skip the test; default: 1",
    )
    group.addoption(
        "--vibrocast-min-tests",
        type=_count,
        default=0,
        metavar="NUMBER",
        help="fail the run if fewer tests reach a controller and are decided; default: 0",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Report a mistake in the bench file before any test runs; count tests."""
    bench = _read(config)
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Reached(config.getoption("vibrocast_min_tests"), bool(bench and bench.sensors)))


class _Reached:
    """Counts tests that reach a controller; fails a run with too few of them, as at a bench that is switched off."""

    def __init__(self, least: int, sensed: bool) -> None:
        self._least, self._ran, self._sensed = least, 0, sensed

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test that had a session with a controller, and passed or failed."""
        kept = dict(report.user_properties)
        self._ran += report.when == "call" and _SERIAL_NUMBER in kept and not report.skipped
        self._sensed |= any(name.startswith("vibrocast_sensor_latency_ms") for name in kept)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the run."""
        if self._ran < self._least:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say why the run fails, and up to where it looked without a sensor or a recorder."""
        if self._ran < self._least:
            terminalreporter.write_line(
                f"vibrocast: {self._ran} tests reached a controller, --vibrocast-min-tests asks for {self._least}; "
                "check that the bench is switched on"
            )
        if self._ran and not self._sensed:
            from vibrocast.host.report import UP_TO_DAC_CALL

            terminalreporter.write_line(f"vibrocast: {UP_TO_DAC_CALL}")


def _read(config: pytest.Config) -> Bench | None:
    """Return the bench of the bench file; None without one. Raises pytest.UsageError."""
    path = config.getoption("vibrocast_bench")
    if path is None:
        return None
    from vibrocast.errors import InputError
    from vibrocast.host.bench_file import read_bench

    try:
        return read_bench(Path(path), config.getoption("vibrocast_allow_programs"))
    except (InputError, OSError) as error:
        raise pytest.UsageError(str(error).replace("--allow-programs", "--vibrocast-allow-programs")) from error


def _devices(config: pytest.Config) -> list[str]:
    """Return the names or addresses of the controllers under test; empty = the default."""
    names: list[str] = config.getoption("vibrocast_device") or []
    if names != ["all"]:
        return names
    bench = _read(config)
    if bench is None:
        raise pytest.UsageError("--vibrocast-device all means those of a bench file; add --vibrocast-bench")
    return [each.name for each in bench.controllers]


@pytest.fixture(scope="session")
def vibrocast_bench(request: pytest.FixtureRequest, pytestconfig: pytest.Config) -> Bench:
    """The bench of --vibrocast-bench; without it, the controller of --vibrocast-device."""
    from vibrocast.errors import InputError
    from vibrocast.host.bench_file import choose_controller

    names = _devices(pytestconfig)
    device = getattr(request, "param", names[0] if names else None)
    try:
        return choose_controller(_read(pytestconfig), device)
    except InputError as error:
        raise pytest.UsageError(str(error)) from error


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Repeat a test for each of several controllers, and for each texture if it asks for `vibrocast_texture`."""
    names = _devices(metafunc.config)
    if "vibrocast_bench" in metafunc.fixturenames and len(names) > 1:
        metafunc.parametrize("vibrocast_bench", names, indirect=True, scope="session")
    if "vibrocast_texture" in metafunc.fixturenames:
        bench = _read(metafunc.config)
        textures = ("wood",) if bench is None else bench.texture_names
        metafunc.parametrize("vibrocast_texture", range(len(textures)), ids=textures, indirect=True)


class _Kept:
    """The files of a test in the folder of --vibrocast-keep, if any; JUnit XML gets their names as properties."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        folder = request.config.getoption("vibrocast_keep")
        self._folder = None if folder is None else Path(folder)
        self._properties = request.node.user_properties
        # With its module: tests of several may have one name.
        self._name = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in request.node.nodeid)
        self._count = 0

    def path(self, kind: str, suffix: str) -> Path | None:
        """Return where to write a file of this kind; None = nowhere."""
        if self._folder is None:
            return None
        self._folder.mkdir(parents=True, exist_ok=True)
        number = f"-{self._count}" if self._count > 1 and kind != "trace" else ""
        path = self._folder / f"{self._name}{number}{suffix}"
        self._properties.append((f"vibrocast_{kind}", str(path)))
        return path

    def figures(self, values: Iterable[Value]) -> None:
        """Keep the figures that are known, in JUnit XML."""
        for key, place, value, _ in values:
            if value is not None:
                self._properties.append((f"vibrocast_{key}[{place}]", str(value)))

    def serial_number(self, controller: Controller) -> None:
        """Keep the serial number of a controller, in JUnit XML."""
        self._properties.append((_SERIAL_NUMBER, controller.description.serial_number))

    def playback(self, played: Playback) -> None:
        """Keep the report of a playback, and its picture where matplotlib is there."""
        from vibrocast import extras
        from vibrocast.host import picture

        self._count += 1
        if path := self.path("report", ".json"):
            played.report.write(path)
            if extras.advice("plot") is None and (drawn := self.path("picture", ".png")):
                picture.draw(drawn, played.report.file, played.caption, played.traces)


@pytest.fixture
def _vibrocast_kept(request: pytest.FixtureRequest) -> _Kept:
    return _Kept(request)


@pytest.fixture
def vibrocast_wire(
    pytestconfig: pytest.Config, vibrocast_bench: Bench, _vibrocast_kept: _Kept
) -> Iterator[TimedTransport]:
    """The way to the controller under test, a `TimedTransport`; `damage` and `pull_cable` break it.

    `damage(lost=0.02, delay_ms=30, seed=1)` takes the keys of a table of faults: `lost`, `flipped`, `doubled`,
    `swapped`, `delay_ms`, `jitter_ms`, `bits_per_second`, `direction`. `damage()` repairs it.
    `pull_cable(0.5, after_s=1.5)` pulls the cable for 0.5 s, 1.5 s after the next byte that the test sends.
    """
    import contextlib
    import time

    from vibrocast.device_protocol.trace import tracer
    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.harness.timed_transport import TimedTransport
    from vibrocast.host import devices

    first = vibrocast_bench.first
    until_s = time.monotonic() + pytestconfig.getoption("vibrocast_wait_s")
    tracer.take()
    with contextlib.ExitStack() as stack:
        while True:
            try:
                way = devices.reach(first.address, actuator=vibrocast_bench.actuator(first.name))
                transport = TimedTransport(stack.enter_context(way))
                break
            except TransportError as error:
                if time.monotonic() >= until_s:
                    if pytestconfig.getoption("vibrocast_skip_missing"):
                        pytest.skip(str(error))
                    raise
                time.sleep(0.1)
        transport.expire_after(pytestconfig.getoption("vibrocast_timeout_s"))
        yield transport
    if path := _vibrocast_kept.path("trace", ".pcapng"):
        tracer.save(path)


@pytest.fixture
def _vibrocast_session(
    vibrocast_bench: Bench, vibrocast_wire: TimedTransport, _vibrocast_kept: _Kept
) -> Iterator[Session]:
    """The session with the controller under test, with the models of its actuator, which fit the bench file."""
    import contextlib

    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.host.bench_file import check_actuator
    from vibrocast.host.controller import Controller, ControllerError
    from vibrocast.host.devices import session_with

    first = vibrocast_bench.first
    opened = session_with(Controller(vibrocast_wire), first.address, vibrocast_bench.actuator(first.name))
    check_actuator(vibrocast_bench, first, opened)
    _vibrocast_kept.serial_number(opened.controller)
    yield opened
    vibrocast_wire.damage()
    vibrocast_wire.expire_after(None)
    with contextlib.suppress(ControllerError, TransportError):  # a test may leave the cable out
        opened.controller.stop()


@pytest.fixture
def vibrocast_device(_vibrocast_session: Session) -> Controller:
    """A session with the controller under test; `description` is what it said of itself.

    Its output is brought to rest after the test.
    """
    return _vibrocast_session.controller


@pytest.fixture
def vibrocast_devices(vibrocast_bench: Bench) -> Iterator[dict[str, Controller]]:
    """Sessions with all controllers of the bench, by name; their outputs are brought to rest after the test."""
    import contextlib

    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.host.bench_file import connect
    from vibrocast.host.controller import ControllerError

    with contextlib.ExitStack() as stack:
        sessions = {}
        for each in vibrocast_bench.controllers:
            sessions[each.name] = stack.enter_context(connect(vibrocast_bench, each)).controller
        yield sessions
        for session in sessions.values():
            with contextlib.suppress(ControllerError, TransportError):
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


class _Judge:
    """Judges what a test measures by the limits of the bench file, and fails or skips the test by the verdict."""

    def __init__(self, bench: Bench, kept: _Kept, wire: TimedTransport, tries: int) -> None:
        self._bench, self._kept, self._wire, self._tries = bench, kept, wire, tries

    def __call__(
        self, take: Callable[[], _Measured], texture: str, limits: Mapping[str, float | None] | None = None
    ) -> _Measured:
        """Return what `take` measures of a texture. `limits`: hold in place of those of the bench file, by their names.

        What this machine was too busy to decide is measured again, as often as the run allows, and then skipped. It is
        not measured again where the test has pulled the cable, which would stay in the next time.
        """
        from vibrocast.host.figures import Verdict, judged, verdict_on

        for _ in range(max(1, self._tries)):
            measured = take()
            values = list(measured.figures())
            found = judged(values, self._bench.missed(values, texture, limits))
            if (verdict := verdict_on(found)) != Verdict.UNDECIDED or self._wire.was_pulled:
                break
        self._kept.figures(values)
        if verdict != Verdict.PASSED:
            (pytest.fail if verdict == Verdict.FAILED else pytest.skip)("; ".join(map(str, found)))
        return measured


@pytest.fixture
def _vibrocast_judge(
    pytestconfig: pytest.Config, vibrocast_bench: Bench, vibrocast_wire: TimedTransport, _vibrocast_kept: _Kept
) -> _Judge:
    return _Judge(vibrocast_bench, _vibrocast_kept, vibrocast_wire, pytestconfig.getoption("vibrocast_tries"))


@pytest.fixture
def vibrocast_play(
    _vibrocast_judge: _Judge, _vibrocast_session: Session, _vibrocast_kept: _Kept
) -> Callable[..., Playback]:
    """A function that encodes a texture, plays it and compares.

    `vibrocast_play(texture, limits=None, codec=None, model=None, **options)`: `codec` and `model` are names as in
    `vibrocast.encode`, such as the one that `vibrocast_flash` uploaded. The options are those of
    `vibrocast.codec.encoding.EncodingOptions`. It returns a Playback, whose `report` is a Report. The test fails where
    the playback misses limits of the bench file, or the controller plays something else than was sent though nothing
    was lost. `limits={"max_lost_percent": 10}` hold in place of those of the file, also of those for this texture.
    """
    from vibrocast import models
    from vibrocast.codec.encoding import encode_recording
    from vibrocast.host import playback
    from vibrocast.textures import Recording, arguments

    def play_texture(
        texture: Recording,
        limits: Mapping[str, float | None] | None = None,
        codec: str | None = None,
        model: str | None = None,
        **options: Any,
    ) -> Playback:
        arguments.of_type("texture", texture, Recording, "a Recording, as vibrocast_texture is")
        taken = None if model is None else models.find(model)
        encoding = encode_recording(texture, codec_name=codec, model=taken, live=True, **options)

        def take() -> Playback:
            played = playback.play(_vibrocast_session, texture.name, encoding.stream, encoding)
            _vibrocast_kept.playback(played)
            return played

        return _vibrocast_judge(take, texture.name, limits)

    return play_texture


@pytest.fixture
def vibrocast_live(
    _vibrocast_judge: _Judge, _vibrocast_session: Session, _vibrocast_kept: _Kept
) -> Callable[..., Playback]:
    """A function that streams a texture live.

    `vibrocast_live(texture, seconds=10.0, rate_hz=2800, limits=None, coding=None, playout_delay_s=None)`; the last two
    are those of `vibrocast.host.live.LiveStream`. It returns a Playback. The `live` part of its report has the counts
    of each minute: with many seconds, a soak. It judges as `vibrocast_play` does.
    """
    from vibrocast.harness.latency import looped
    from vibrocast.host.live_playback import play_live

    def stream(
        texture: Recording,
        seconds: float = 10.0,
        rate_hz: int = 2800,
        limits: Mapping[str, float | None] | None = None,
        **options: Any,
    ) -> Playback:
        source = looped(texture, seconds, rate_hz)

        def take() -> Playback:
            played = play_live(_vibrocast_session, source, **options)
            _vibrocast_kept.playback(played)
            return played

        return _vibrocast_judge(take, texture.name, limits)

    return stream


@pytest.fixture
def vibrocast_latency(_vibrocast_judge: _Judge, _vibrocast_session: Session) -> Callable[..., Latency]:
    """A function that measures the latency of a live texture.

    `vibrocast_latency(texture, limits=None, seconds=4.0, rate_hz=2800, playout_delay_s=0.01)`; it returns a
    `vibrocast.harness.latency.Latency`, whose `total_ms` is the delay. It judges as `vibrocast_play` does.
    """
    from vibrocast.harness.latency import measure_latency

    def measure(texture: Recording, limits: Mapping[str, float | None] | None = None, **options: Any) -> Latency:
        return _vibrocast_judge(lambda: measure_latency(_vibrocast_session, texture, **options), texture.name, limits)

    return measure


@pytest.fixture
def vibrocast_flash(vibrocast_device: Controller) -> Iterator[Callable[[bytes | str], ImageDescription]]:
    """A function that uploads a model image, starts and confirms it: `vibrocast_flash("eva-16-5")`.

    It takes the name of a model that ships, or the bytes of a packed image. It returns the
    `vibrocast.device_protocol.messages.ImageDescription` of the slot. After the test, the controller runs the image
    again that it ran before, if any.
    """
    from vibrocast import models
    from vibrocast.host import uploader

    def flash(image: bytes | str) -> ImageDescription:
        return uploader.flash(vibrocast_device, models.find(image).image if isinstance(image, str) else image)

    before = uploader.running(vibrocast_device)
    yield flash
    if before is not None:
        uploader.run_again(vibrocast_device, before)


@pytest.fixture
def vibrocast_stroke(
    vibrocast_bench: Bench, _vibrocast_judge: _Judge, _vibrocast_session: Session, _vibrocast_kept: _Kept
) -> Callable[..., Playback]:
    """A function that plays a height profile under a hand that strokes there and back.

    `vibrocast_stroke(profile, stroke_mm=10.0, hand_speed_mm_s=50.0, strokes=1, limits=None, **options)`; the profile is
    a `vibrocast.Profile`, and the options are those of `vibrocast.codec.encoding.encode_profile`. It returns a
    Playback, and judges as `vibrocast_play` does.
    """
    from vibrocast.codec.encoding import encode_profile
    from vibrocast.host import hand_playback
    from vibrocast.host.report import Provenance

    def stroke(
        profile: Profile,
        stroke_mm: float = 10.0,
        hand_speed_mm_s: float = 50.0,
        strokes: int = 1,
        limits: Mapping[str, float | None] | None = None,
        **options: Any,
    ) -> Playback:
        # A hand at 1 m/s passes as many samples in a second as there are in a metre.
        encoding = encode_profile(profile.recording(1000.0), **options)
        movement = hand_playback.back_and_forth(stroke_mm, hand_speed_mm_s, strokes)

        def take() -> Playback:
            played = hand_playback.play_and_compare(
                _vibrocast_session,
                profile.name,
                encoding.stream,
                movement,
                encoding.recording,
                provenance=Provenance(vibrocast_bench.sha256),
            )
            _vibrocast_kept.playback(played)
            return played

        return _vibrocast_judge(take, profile.name, limits)

    return stroke


@pytest.fixture
def vibrocast_texture(request: pytest.FixtureRequest, vibrocast_bench: Bench) -> Recording:
    """One texture of the bench file; the test runs once for each, and the texture's name is in its own."""
    loaders = vibrocast_bench.textures
    texture: Recording = loaders[request.param]() if loaders else vibrocast_bench.scene()[0]
    return texture
