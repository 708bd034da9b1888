"""Runs the suite on a controller, and says of each requirement whether it is met."""

import os
from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import pytest

from vibrocast.device_protocol.messages import PROTOCOL_MAJOR, HelloResponse, MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.conformance import fixtures
from vibrocast.host.conformance.line import Line
from vibrocast.host.conformance.probe import Gone, NotConforming, Probe
from vibrocast.host.controller import ControllerError
from vibrocast.host.plain import plain

_FOLDER = Path(__file__).parent
# Nothing of the user's or of the environment's pytest takes part.
_OPTIONS = (
    *("-c", os.devnull),
    *("--rootdir", str(_FOLDER)),
    *("--noconftest", "--assert=plain", "--capture=no", "--continue-on-collection-errors"),
    *(f"-pno:{plugin}" for plugin in ("terminal", "cacheprovider", "logging", "warnings", "faulthandler")),
)
_ENVIRONMENT = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": "", "PYTEST_PLUGINS": ""}


class Outcome(Enum):
    """What was found of a requirement."""

    PASSED = "pass"
    FAILED = "fail"
    NOT_OFFERED = "not offered"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class Requirement:
    """What the protocol asks of a controller. `section`: of docs/protocol.md. `test`: its name in the suite."""

    section: str
    text: str
    test: str


@dataclass(frozen=True)
class Finding:
    """What was found of a requirement. `reason`: of anything but a pass. `measured`: what else the test saw, if any."""

    requirement: Requirement
    outcome: Outcome
    reason: str = ""
    measured: str = ""


class NotJudged(Exception):
    """The controller does not answer Hello as one does: there is nothing else to say of it."""


def judge(
    line: Line, quick: bool = False, progress: Callable[[float, str], None] | None = None
) -> tuple[HelloResponse, list[Finding]]:
    """Run the suite; return what the controller said of itself, and the findings in the order of the suite.

    `quick`: leave out what takes more than a second. `progress` is called with the part that is done and the section
    that comes next. The output is brought to rest, whatever is raised. Raises NotJudged, KeyboardInterrupt.
    """
    probe = Probe(line)
    try:
        probe.open()
    except (Gone, NotConforming) as reason:
        raise NotJudged(
            f"no controller of protocol {PROTOCOL_MAJOR} can be tried here (check power and address): {reason}"
        ) from reason
    judging = _Judging(line, progress)
    _run(judging, "-m", "not long" if quick else "")
    return probe.description, judging.all_findings()


def requirements() -> list[Requirement]:
    """Return all requirements, in the order of the suite."""
    judging = _Judging(None, None)
    _run(judging, "--collect-only")
    return list(judging.requirements.values())


class _Judging:
    """A pytest plugin that lends the suite its line, and notes what comes out."""

    def __init__(self, line: Line | None, progress: Callable[[float, str], None] | None) -> None:
        self.requirements: dict[str, Requirement] = {}
        self.findings: dict[str, Finding] = {}
        self.interrupted = False
        self._line = line
        self._progress = progress
        self._not_tried = ""

    @pytest.fixture
    def line(self) -> Line:
        assert self._line is not None, "there is a controller to try"
        return self._line

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: item.get_closest_marker("vital") is None)

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        for item in session.items:
            assert isinstance(item, pytest.Function)
            self.requirements[item.nodeid] = _requirement(item)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self._progress is not None:
            self._progress(len(self.findings) / len(self.requirements), self.requirements[nodeid].section)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if call.excinfo is not None and isinstance(call.excinfo.value, Gone) and call.when == "setup":
            self._not_tried = f"the controller could not be reached any more ({call.excinfo.value})"
            item.session.shouldstop = self._not_tried
        elif call.excinfo is not None or call.when == "call":
            measured = dict(item.user_properties).get("measured", "")
            outcome, reason = _outcome(call.excinfo)
            self.findings[item.nodeid] = Finding(self.requirements[item.nodeid], outcome, reason, str(measured))
            if outcome == Outcome.FAILED and item.get_closest_marker("vital") is not None:
                self._not_tried = f"what must be right first is not: {self.requirements[item.nodeid].text}"
                item.session.shouldstop = self._not_tried
        return report

    def pytest_keyboard_interrupt(self, excinfo: pytest.ExceptionInfo[BaseException]) -> None:
        # Of this kind is what stops the session as well.
        self.interrupted = not excinfo.errisinstance(pytest.Session.Interrupted)

    def all_findings(self) -> list[Finding]:
        """Return a finding for each requirement."""
        return [
            self.findings.get(name, Finding(requirement, Outcome.NOT_TRIED, self._not_tried))
            for name, requirement in self.requirements.items()
        ]


def _run(judging: _Judging, *options: str) -> None:
    """Run the suite with a plugin, and nothing of the user's. Raises KeyboardInterrupt."""
    with pytest.MonkeyPatch.context() as environment:
        for name, value in _ENVIRONMENT.items():
            environment.setenv(name, value)
        code = pytest.main([*_OPTIONS, *options, str(_FOLDER)], plugins=[fixtures, judging])
    if judging.interrupted:
        raise KeyboardInterrupt
    if code in (pytest.ExitCode.INTERNAL_ERROR, pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise RuntimeError(f"the suite could not be run (pytest ended with {code!r})")


def _requirement(item: pytest.Function) -> Requirement:
    """Return what a test asks, its parameters filled in."""
    section = item.get_closest_marker("section")
    assert section is not None and item.function.__doc__, f"{item.name} says what it asks, and where that stands"
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    text = item.function.__doc__.format(**{name: _word(value) for name, value in parameters.items()})
    return Requirement(section.args[0], text.strip(), item.name)


def _word(value: object) -> str:
    """Return a parameter as a reader knows it."""
    if isinstance(value, Enum):
        return value.name
    return value.__name__ if isinstance(value, type) else str(value)


def _outcome(failure: pytest.ExceptionInfo[BaseException] | None) -> tuple[Outcome, str]:
    """Return what the end of a test says of the controller, and why."""
    if failure is None:
        return Outcome.PASSED, ""
    text = plain(" ".join(str(failure.value).split()))
    if failure.errisinstance(pytest.skip.Exception):
        return Outcome.NOT_OFFERED, text
    if failure.errisinstance((AssertionError, ControllerError, TransportError, MessageError, Gone)):
        return Outcome.FAILED, text
    return Outcome.FAILED, f"the suite met an unexpected {failure.typename} ({text}): please report it"
