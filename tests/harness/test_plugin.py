"""A user's own test on the pytest plugin: unchanged on the simulated controllers and on those of a bench file."""

import json
import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from tests.command import OAK
from vibrocast.device_protocol.trace import read_trace

pytest_plugins = "pytester"

USERS_TEST = """
def test_what_is_played_is_what_was_sent(vibrocast_play, vibrocast_texture):
    report = vibrocast_play(vibrocast_texture).report
    assert report.dac_equals_offline
    print("on", report.actuator.name)
"""
BENCH = """
[[controllers]]
name = "left"
address = "sim"

[[controllers]]
name = "right"
address = "sim-usb"

[[actuators]]
controller = "left"
name = "stack 3"
model = "piezo-stack"
corner_hz = 241.5

[[actuators]]
controller = "right"
model = "voice-coil"

[[textures]]
generate = "rough"
seconds = 0.5
"""
# The plugin is loaded by its module's name, whether or not what is installed has its entry point.
LOADED = ("-p", "no:vibrocast", "-p", "vibrocast.harness.plugin", "-p", "no:cacheprovider")


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "piezo-stack"),
        pytest.param(["--vibrocast-bench", "bench.toml"], "stack 3", marks=pytest.mark.slow),
        pytest.param(
            ["--vibrocast-bench", "bench.toml", "--vibrocast-device", "right"], "voice-coil", marks=pytest.mark.slow
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_the_same_test_runs_on_every_device(pytester: pytest.Pytester, arguments: list[str], name: str) -> None:
    pytester.makepyfile(USERS_TEST)
    pytester.path.joinpath("bench.toml").write_text(BENCH)
    result = pytester.runpytest_subprocess(*LOADED, "-s", "--vibrocast-tries=5", *arguments)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines([f"*on {name}", "vibrocast: checked up to the call of the DAC function"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--vibrocast-device", "nowhere"], "*'nowhere' is no controller: give a name in the bench file, or sim, *"),
        (["--vibrocast-bench", "missing.toml"], "*missing.toml*"),
        (["--vibrocast-bench", "bench.toml"], "*bench.toml: controllers is missing*"),
        (["--vibrocast-wait-s=nan"], "*--vibrocast-wait-s: nan cannot be used; give a finite number of seconds of *"),
        (["--vibrocast-timeout-s=soon"], "*--vibrocast-timeout-s: soon cannot be used; give a finite number *"),
        (["--vibrocast-bench", "programs.toml"], "*sensor laser starts the program 'rm'; *--vibrocast-allow-programs*"),
    ],
)
def test_a_wrong_option_is_reported_in_one_line(pytester: pytest.Pytester, arguments: list[str], message: str) -> None:
    pytester.makepyfile(USERS_TEST)
    pytester.path.joinpath("bench.toml").write_text("")
    pytester.path.joinpath("programs.toml").write_text(
        '[[controllers]]\nname = "it"\naddress = "sim"\n'
        '[[sensors]]\nname = "laser"\nkind = "laser"\nsensitivity = 1.0\nunit = "um"\ncommand = ["rm", "{file}"]\n'
    )
    result = pytester.runpytest_subprocess(*LOADED, *arguments)
    assert result.ret != pytest.ExitCode.OK
    assert "Traceback" not in result.stdout.str() + result.stderr.str()
    (result.stdout if "nowhere" in arguments else result.stderr).fnmatch_lines([message])


# A project with an option and a fixture like those of the plugin.
PROJECTS_CONFTEST = """
import pytest

def pytest_addoption(parser):
    for name in ("--device", "--bench", "--plan"):
        parser.addoption(name, default="mine")

@pytest.fixture
def controller(request):
    return request.config.getoption("--device")
"""
PROJECTS_TEST = """
import sys

def test_all_is_mine(controller):
    assert controller == "mine"

def test_the_plugin_loads_no_library():
    plugin = sys.modules["vibrocast.harness.plugin"]
    assert {name for name in sys.modules if name.startswith("vibrocast")} == {
        "vibrocast", "vibrocast.harness", plugin.__name__
    }
    assert not {"click", "numpy", "scipy", "serial"} & set(sys.modules)
"""


@pytest.mark.slow
def test_a_project_that_does_not_use_the_plugin_is_left_alone(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(PROJECTS_TEST)
    pytester.makeconftest(PROJECTS_CONFTEST)
    pytester.runpytest_subprocess(*LOADED).assert_outcomes(passed=2)


def test_installing_vibrocast_installs_the_plugin() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"vibrocast": "vibrocast.harness.plugin"}


def users_run(pytester: pytest.Pytester, test: str, bench: str, *arguments: str) -> pytest.RunResult:
    """Run a user's test on a bench."""
    pytester.makepyfile(test)
    pytester.path.joinpath("bench.toml").write_text(bench)
    return pytester.runpytest_subprocess(*LOADED, "--vibrocast-bench=bench.toml", *arguments)


SIM = '[[controllers]]\nname = "it"\naddress = "sim"\n'
ONE = '[[textures]]\ngenerate = "rough"\nseconds = 0.5\n'
TWO = f'{ONE}[[textures]]\ngenerate = "taps"\nseconds = 0.5\n'


@pytest.mark.slow
def test_each_texture_is_a_test_of_its_own(pytester: pytest.Pytester) -> None:
    test = "def test_it(vibrocast_texture): assert vibrocast_texture.name.startswith(('rough', 'taps'))"
    result = users_run(pytester, test, SIM + TWO, "-v")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*test_it[[]rough] PASSED*", "*test_it[[]taps] PASSED*"])


@pytest.mark.slow
def test_a_missed_limit_fails_a_test_and_keeps_its_frames(pytester: pytest.Pytester) -> None:
    test = "def test_it(vibrocast_play, vibrocast_texture): vibrocast_play(vibrocast_texture)"
    bench = SIM + ONE + "[limits]\nmin_gain = 9\n"
    result = users_run(pytester, test, bench, "--vibrocast-keep", "kept", "--junit-xml=results.xml")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*limits missed: rough*: gain = *, min_gain = 9*"])
    (trace,) = (pytester.path / "kept").glob("*.pcapng")
    frames = list(read_trace(trace))
    assert any(frame.from_host for frame in frames) and any(frame.message() for frame in frames)
    assert json.loads(trace.with_suffix(".json").read_text())["underruns"] == 0
    assert trace.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    properties = re.findall(r'property name="([^"]+)" value="([^"]*)"', (pytester.path / "results.xml").read_text())
    names = {"report": "json", "picture": "png", "trace": "pcapng"}
    assert trace.stem.endswith(".py__test_it_rough_")
    kept = dict(properties)
    assert {kind: kept[f"vibrocast_{kind}"] for kind in names} == {
        kind: f"kept/{trace.stem}.{suffix}" for kind, suffix in names.items()
    }
    assert float(kept["vibrocast_gain[rough]"]) < 9 and "vibrocast_serial_number" in kept


@pytest.mark.slow
def test_a_test_breaks_the_wire(pytester: pytest.Pytester) -> None:
    test = """
def test_lost_frames_are_noticed(vibrocast_play, vibrocast_wire, vibrocast_texture):
    vibrocast_wire.damage(lost=0.2, direction="to_controller", seed=1)
    report = vibrocast_play(vibrocast_texture).report
    assert report.lost_packets and not report.decoded_equals_offline

def test_a_cable_pulled_meanwhile_is_survived(vibrocast_play, vibrocast_wire, vibrocast_texture):
    vibrocast_wire.pull_cable(0.2, after_s=0.3)
    assert vibrocast_play(vibrocast_texture).report.reconnects == 1

def test_a_live_stream_survives_it_too(vibrocast_live, vibrocast_wire, vibrocast_texture):
    vibrocast_wire.pull_cable(0.2, after_s=0.3)
    assert vibrocast_live(vibrocast_texture, seconds=1.0).report.reconnects == 1

def test_a_slow_wire_delays(vibrocast_wire, vibrocast_device):
    import time
    vibrocast_wire.damage(delay_ms=40, bits_per_second=1e5, direction="to_controller")
    began_s = time.monotonic()
    vibrocast_device.request_status()
    assert time.monotonic() - began_s > 0.04
"""
    users_run(pytester, test, SIM + ONE + "[limits]\nmax_lost_percent = 100\n").assert_outcomes(passed=4)


@pytest.mark.slow
def test_an_absent_controller_is_waited_for_and_then_skipped(pytester: pytest.Pytester) -> None:
    test = "def test_it(vibrocast_device): pass"
    bench = '[[controllers]]\nname = "it"\naddress = "serial:nowhere"\n'
    users_run(pytester, test, bench).assert_outcomes(errors=1)
    result = users_run(pytester, test, bench, "--vibrocast-wait-s", "0.3", "--vibrocast-skip-missing", "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["*cannot open serial port nowhere*"])


@pytest.mark.slow
def test_power_is_cycled_by_the_program_of_the_bench_file(pytester: pytest.Pytester) -> None:
    test = """
def test_it(vibrocast_power_cycle, vibrocast_device):
    vibrocast_power_cycle()
    assert open("cycled").read() == "yes"
    vibrocast_device.request_status()
"""
    users_run(pytester, test, SIM).assert_outcomes(skipped=1)
    relay = f'power_cycle = [{sys.executable!r}, \'-c\', \'open("cycled", "w").write("yes")\']\n'
    refused = users_run(pytester, test, SIM + relay)
    refused.stderr.fnmatch_lines(["*controller it starts the program *; *--vibrocast-allow-programs*"])
    users_run(pytester, test, SIM + relay, "--vibrocast-allow-programs").assert_outcomes(passed=1)


@pytest.mark.slow
def test_each_controller_is_a_test_of_its_own(pytester: pytest.Pytester) -> None:
    test = "def test_it(vibrocast_device, vibrocast_bench): assert vibrocast_bench.first.name in ('left', 'right')"
    result = users_run(pytester, test, BENCH, "-v", "--vibrocast-device", "all")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*test_it[[]left] PASSED*", "*test_it[[]right] PASSED*"])
    one = pytester.runpytest_subprocess(*LOADED, "-v", "--vibrocast-device", "sim", "--vibrocast-device", "sim-usb")
    one.stdout.fnmatch_lines(["*test_it[[]sim]*", "*test_it[[]sim-usb]*"])
    refused = pytester.runpytest_subprocess(*LOADED, "--vibrocast-device", "all")
    assert "add --vibrocast-bench" in refused.stdout.str() + refused.stderr.str()


@pytest.mark.slow
def test_the_fixtures_stream_measure_flash_and_stroke(pytester: pytest.Pytester) -> None:
    test = """
import pytest
from vibrocast import models, textures
from vibrocast.device_protocol.messages import SlotState

def test_live(vibrocast_live, vibrocast_texture):
    report = vibrocast_live(vibrocast_texture, seconds=1.0).report
    assert report.seconds == pytest.approx(1.0) and len(report.live.minutes) == 1

def test_latency(vibrocast_latency, vibrocast_texture):
    assert vibrocast_latency(vibrocast_texture, seconds=1.0).total_ms > 0

def test_images(vibrocast_flash, vibrocast_play, vibrocast_texture, vibrocast_device):
    vibrocast_flash("eva-16-1")
    assert vibrocast_play(vibrocast_texture, model="eva-16-1").report.model == "eva-16-1"
    with pytest.raises(TypeError, match="no option codek; the options are model, "):
        vibrocast_play(vibrocast_texture, codek="eva")
    with pytest.raises(textures.TextureError, match="a Recording"):
        vibrocast_play("rough")
    assert vibrocast_flash(models.find("eva-16-2").image).state == SlotState.CONFIRMED

def test_strokes(vibrocast_stroke):
    profile = textures.surface_profile("grating", seconds=0.5)
    assert vibrocast_stroke(profile, stroke_mm=5.0).report.differs is False

def test_all(vibrocast_devices):
    assert set(vibrocast_devices) == {"left", "right"}
    for session in vibrocast_devices.values():
        session.request_status()
"""
    limits = "[limits]\nmax_lost_percent = 100\n"
    users_run(pytester, test, BENCH + limits).assert_outcomes(passed=5)


@pytest.mark.slow
def test_a_run_that_sees_the_output_does_not_say_that_it_ends_before(pytester: pytest.Pytester) -> None:
    measured = 'record_property("vibrocast_sensor_latency_ms[live]", "9.0")'
    test = f"def test_it(vibrocast_device, record_property): {measured}"
    unseen = "*checked up to the call of the DAC function*"
    users_run(pytester, test, SIM).stdout.no_fnmatch_line(unseen)
    sensor = '[[sensors]]\nname = "s"\nkind = "accelerometer"\ninput = "serial:nowhere"\n'
    test = "def test_it(vibrocast_device): pass"
    with_sensor = users_run(pytester, test, SIM + sensor)
    with_sensor.assert_outcomes(passed=1)
    with_sensor.stdout.no_fnmatch_line(unseen)


@pytest.mark.slow
def test_a_test_that_takes_too_long_is_ended(pytester: pytest.Pytester) -> None:
    test = """
def test_it(vibrocast_device):
    while True:
        vibrocast_device.request_status()
"""
    result = users_run(pytester, test, SIM, "--vibrocast-timeout-s", "0.3")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*the test still talks to its controller after 0.3 s; see --vibrocast-timeout-s*"])


PAGES = Path(__file__).parents[2] / "docs/how-to"


def on_page(name: str, language: str) -> str:
    """Return the first block of a language on a page."""
    return re.findall(rf"```{language}[^\n]*\n(.*?)```", (PAGES / name).read_text(), re.DOTALL)[0]  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("device", ["sim", "host", "stm32f405"])
def test_the_example_of_the_page_passes_on_a_healthy_board(device: str, pytester: pytest.Pytester) -> None:
    shutil.copy(OAK, pytester.path / "oak.wav")
    test, bench = on_page("test_with_pytest.md", "python"), on_page("measure_a_bench.md", "toml")
    result = users_run(pytester, test, bench, "--vibrocast-device", device, "-rs")
    outcomes = result.parseoutcomes()
    undecided = len([line for line in result.outlines if "SKIPPED" in line and "undecided" in line])
    assert outcomes.get("passed", 0) + undecided == 6, outcomes


@pytest.mark.slow
def test_a_busy_machine_decides_nothing_and_a_run_without_its_bench_fails(pytester: pytest.Pytester) -> None:
    test = """
def test_it(vibrocast_play, vibrocast_wire, vibrocast_texture, monkeypatch):
    monkeypatch.setattr("vibrocast.host.controller.Controller.doubt", lambda *_: "this machine woke up late")
    vibrocast_wire.damage(lost=0.3, direction="to_controller", seed=1)
    vibrocast_play(vibrocast_texture)
    assert False, "never reached"
"""
    result = users_run(pytester, test, SIM + ONE, "-rs", "--vibrocast-tries=2", "--vibrocast-min-tests=1")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["*undecided, because this machine woke up late: limits missed: *"])
    result.stdout.fnmatch_lines(["*0 tests reached a controller, --vibrocast-min-tests asks for 1; *"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    absent = '[[controllers]]\nname = "it"\naddress = "serial:nowhere"\n'
    missing = users_run(pytester, test, absent, "--vibrocast-skip-missing", "--vibrocast-min-tests=1")
    assert missing.ret == pytest.ExitCode.TESTS_FAILED
