"""Runs the suite on a controller: pytest runs the modules test_*.py of this folder, and a plugin keeps the findings."""

import os
from collections.abc import Callable, Generator
from enum import Enum
from pathlib import Path

import pytest

from vibrocast.device_protocol.messages import PROTOCOL_MAJOR, MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import BAD_INPUT, VibrocastError
from vibrocast.files import plain
from vibrocast.harness.conformance import fixtures
from vibrocast.harness.conformance.probe import NotConforming, Probe, Undecided, Unreachable
from vibrocast.harness.conformance.report import Finding, Outcome, Report, Requirement
from vibrocast.harness.conformance.tapped_link import TappedLink
from vibrocast.host.controller import LATE_S, ControllerError

_FOLDER = Path(__file__).parent
# The user's pytest configuration takes no part.
_OPTIONS = (
    *("-c", os.devnull),
    *("--rootdir", str(_FOLDER)),
    *("--noconftest", "--assert=plain", "--capture=no", "--continue-on-collection-errors"),
    *(f"-pno:{plugin}" for plugin in ("terminal", "cacheprovider", "logging", "warnings", "faulthandler")),
)
_ENVIRONMENT = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": "", "PYTEST_PLUGINS": ""}


class SuiteInterrupted(KeyboardInterrupt):
    """Somebody stopped the suite; `report` has the findings until then."""

    def __init__(self, report: Report) -> None:
        super().__init__()
        self.report = report


class NotTestable(VibrocastError):
    """The controller does not answer Hello correctly, so nothing else can be tested."""

    exit_code = BAD_INPUT


def run_suite(
    link: TappedLink,
    quick: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Report:
    """Run the suite on the controller behind a link; return its description, and the findings in suite order.

    `quick`: leave out tests longer than a second. `progress` is called with the part that is done and the next section.
    The output is at rest afterwards, also after an exception. Raises NotTestable, SuiteInterrupted.
    """
    probe = Probe(link)
    try:
        probe.open()
    except (Unreachable, NotConforming) as reason:
        raise NotTestable(
            f"no controller of protocol {PROTOCOL_MAJOR} answers ({reason}); check power and address"
        ) from reason
    suite_run = _SuiteRun(link, progress)
    interrupted = False
    try:
        _run(suite_run, "-m", "not long" if quick else "")
    except KeyboardInterrupt:
        interrupted = True
    left_out = ["tests longer than a second"] * quick
    left_out += ["tests that write model images"] * (not link.may_flash)
    report = Report(
        probe.description, tuple(suite_run.all_findings()), tuple(left_out), suite_run.lost_after, link.recorder is None
    )
    if interrupted:
        raise SuiteInterrupted(report)
    return report


def requirements() -> list[Requirement]:
    """Return all requirements, in the order of the suite."""
    return list(map(_requirement, collected()))


def collected() -> list[pytest.Function]:
    """Return the tests of the suite, one for each requirement, in their order."""
    suite_run = _SuiteRun(None, None)
    _run(suite_run, "--collect-only")
    return suite_run.tests


class _SuiteRun:
    """A pytest plugin that gives the suite its link, and collects the findings."""

    def __init__(self, link: TappedLink | None, progress: Callable[[float, str], None] | None) -> None:
        self.tests: list[pytest.Function] = []
        self.requirements: dict[str, Requirement] = {}
        self.findings: dict[str, Finding] = {}
        self.interrupted = False
        self._link = link
        self._progress = progress
        self.lost_after = ""
        self._not_tested = ""

    @pytest.fixture
    def link(self) -> TappedLink:
        assert self._link is not None, "there is a controller to test"
        return self._link

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: item.get_closest_marker("prerequisite") is None)

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        for item in session.items:
            assert isinstance(item, pytest.Function)
            self.tests.append(item)
            self.requirements[item.nodeid] = _requirement(item)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self._link is not None:
            self._link.forget_lateness()
        if self._progress is not None:
            self._progress(len(self.findings) / len(self.requirements), self.requirements[nodeid].section)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if call.excinfo is not None and isinstance(call.excinfo.value, Unreachable) and call.when == "setup":
            self.lost_after = list(self.findings.values())[-1].requirement.test
            self._not_tested = f"the controller was lost after {self.lost_after} ({call.excinfo.value})"
            item.session.shouldstop = self._not_tested
        elif call.excinfo is not None or call.when == "call":
            measured = dict(item.user_properties).get("measured", "")
            outcome, reason = _outcome(call.excinfo)
            late_s = 0.0 if self._link is None else self._link.late_s
            if outcome == Outcome.FAILED and late_s > LATE_S:
                outcome = Outcome.UNDECIDED
                reason = (
                    f"this machine or its emulator was {1000 * late_s:.0f} ms late, so it may be to blame: {reason}"
                )
            self.findings[item.nodeid] = Finding(self.requirements[item.nodeid], outcome, reason, str(measured))
            if outcome == Outcome.FAILED and item.get_closest_marker("prerequisite") is not None:
                self._not_tested = f"a prerequisite is not met: {self.requirements[item.nodeid].text}"
                item.session.shouldstop = self._not_tested
        return report

    def pytest_keyboard_interrupt(self, excinfo: pytest.ExceptionInfo[BaseException]) -> None:
        # Of this kind is what stops the session as well.
        self.interrupted = not excinfo.errisinstance(pytest.Session.Interrupted)
        if self.interrupted:
            self._not_tested = "the suite was interrupted"

    def all_findings(self) -> list[Finding]:
        """Return a finding for each requirement."""
        return [
            self.findings.get(name, Finding(requirement, Outcome.NOT_TESTED, self._not_tested))
            for name, requirement in self.requirements.items()
        ]


def _run(suite_run: _SuiteRun, *options: str) -> None:
    """Run the suite with a plugin, and nothing of the user's. Raises KeyboardInterrupt."""
    with pytest.MonkeyPatch.context() as environment:
        for name, value in _ENVIRONMENT.items():
            environment.setenv(name, value)
        code = pytest.main([*_OPTIONS, *options, str(_FOLDER)], plugins=[fixtures, suite_run])
    if suite_run.interrupted:
        raise KeyboardInterrupt
    if code in (pytest.ExitCode.INTERNAL_ERROR, pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise RuntimeError(f"the suite could not be run (pytest ended with {code!r})")


def section_of(test: pytest.Function) -> str:
    """Return the section of docs/reference/protocol.md that a test belongs to."""
    section = test.get_closest_marker("section")
    assert section is not None, f"{test.name} names the section of its requirement"
    return str(section.args[0])


def text_of(test: pytest.Function) -> str:
    """Return a test's requirement, with its parameters in braces."""
    assert test.function.__doc__, f"{test.name} states its requirement"
    return str(test.function.__doc__).strip()


def cases_of(test: pytest.Function) -> dict[str, str]:
    """Return the parameters of a test as a reader knows them."""
    parameters = test.callspec.params if hasattr(test, "callspec") else {}
    return {name: _word(value) for name, value in parameters.items()}


def _requirement(test: pytest.Function) -> Requirement:
    return Requirement(section_of(test), text_of(test).format(**cases_of(test)), test.name)


def _word(value: object) -> str:
    """Return a parameter's value as text."""
    if isinstance(value, Enum):
        return value.name
    return value.__name__ if isinstance(value, type) else str(value)


def _outcome(failure: pytest.ExceptionInfo[BaseException] | None) -> tuple[Outcome, str]:
    """Return the outcome of a test, and the reason."""
    if failure is None:
        return Outcome.PASSED, ""
    text = plain(" ".join(str(failure.value).split()))
    if failure.errisinstance(pytest.skip.Exception):
        return Outcome.NOT_APPLICABLE, text
    if failure.errisinstance(Undecided):
        return Outcome.UNDECIDED, text
    if failure.errisinstance((AssertionError, ControllerError, TransportError, MessageError, Unreachable)):
        return Outcome.FAILED, text
    return Outcome.FAILED, f"the suite met an unexpected {failure.typename} ({text}): please report it"
