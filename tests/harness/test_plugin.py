"""A user's own test on the pytest plugin: unchanged on the simulated controllers and on those of a bench file."""

import tomllib
from pathlib import Path

import pytest

pytest_plugins = "pytester"

USERS_TEST = """
def test_what_is_played_is_what_was_sent(play, actuator, scene, request):
    report = play(scene[0]).report
    assert report.dac_equals_offline
    assert report.actuator.name == actuator.name == request.config.getoption("expected_actuator", "piezo-stack")
"""
USERS_CONFTEST = """
def pytest_addoption(parser):
    parser.addoption("--expected-actuator", default="piezo-stack")
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
LOADED = ("-p", "no:vibrocast", "-p", "vibrocast.host.harness.plugin", "-p", "no:cacheprovider")


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "piezo-stack"),
        pytest.param(["--device", "sim-usb"], "piezo-stack", marks=pytest.mark.slow),
        (["--bench", "bench.toml"], "stack 3"),
        pytest.param(["--bench", "bench.toml", "--device", "right"], "voice-coil", marks=pytest.mark.slow),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_the_same_test_runs_on_every_device(pytester: pytest.Pytester, arguments: list[str], name: str) -> None:
    pytester.makepyfile(USERS_TEST)
    pytester.makeconftest(USERS_CONFTEST)
    pytester.path.joinpath("bench.toml").write_text(BENCH)
    result = pytester.runpytest_subprocess(*LOADED, *arguments, "--expected-actuator", name)
    result.assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--device", "nowhere"], "*'nowhere' is no controller: give a name in the bench file, sim, *"),
        (["--bench", "missing.toml"], "*missing.toml*"),
        (["--bench", "bench.toml"], "*bench.toml: names no controller; add ??controllers?? with*"),
    ],
)
def test_what_names_no_device_is_told_in_a_line(pytester: pytest.Pytester, arguments: list[str], message: str) -> None:
    pytester.makepyfile(USERS_TEST)
    pytester.path.joinpath("bench.toml").write_text("")
    result = pytester.runpytest_subprocess(*LOADED, *arguments)
    assert result.ret != pytest.ExitCode.OK
    assert "Traceback" not in result.stdout.str() + result.stderr.str()
    (result.stdout if "nowhere" in arguments else result.stderr).fnmatch_lines([message])


def test_plugin_costs_nothing_where_it_is_not_used(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("import sys\ndef test_nothing_was_loaded():\n    assert 'numpy' not in sys.modules\n")
    result = pytester.runpytest_subprocess(*LOADED)
    result.assert_outcomes(passed=1)


def test_installing_vibrocast_installs_the_plugin() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"vibrocast": "vibrocast.host.harness.plugin"}
