"""The report on a controller that its maker can publish: a page, conformance.md, and conformance.json for machines."""

import html
import json
import re
from collections import Counter
from dataclasses import asdict, dataclass, field
from enum import Enum
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

from vibrocast import pages
from vibrocast.device_protocol.messages import PROTOCOL_MAJOR, PROTOCOL_MINOR, HelloResponse
from vibrocast.files import atomic_write, plain
from vibrocast.harness.conformance.fixtures import SECTIONS
from vibrocast.host import devices
from vibrocast.host.report import UP_TO_DAC_CALL, Provenance

PAGE = "conformance.md"
JSON = "conformance.json"
SCHEMA = 1


class Outcome(Enum):
    """The outcome of a requirement."""

    PASSED = "pass"
    FAILED = "fail"
    NOT_APPLICABLE = "not applicable"
    NOT_TESTED = "not tested"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Requirement:
    """A requirement of the protocol. `section`: of docs/reference/protocol.md. `test`: its name in the suite."""

    section: str
    text: str
    test: str


@dataclass(frozen=True)
class Finding:
    """The finding on a requirement. `reason`: why it did not pass. `measured`: a further measurement, if any."""

    requirement: Requirement
    outcome: Outcome
    reason: str = ""
    measured: str = ""


@dataclass(frozen=True)
class Report:
    """The findings on a controller. `left_out`: tests that the user left out. `run`: the origin.

    `lost_after`: the test after which the controller could not be reached any more; empty if it always could.
    `up_to_dac_call`: nothing recorded the real output.
    """

    hello: HelloResponse
    findings: tuple[Finding, ...]
    left_out: tuple[str, ...] = ()
    lost_after: str = ""
    up_to_dac_call: bool = True
    run: Provenance = field(default_factory=Provenance)

    @property
    def conforming(self) -> bool:
        """Whether every requirement that was tested is met, and all that apply were tested."""
        return not self._outcomes & {Outcome.FAILED, Outcome.NOT_TESTED, Outcome.UNDECIDED}

    @property
    def undecided(self) -> bool:
        """Whether nothing speaks against the controller but what this machine may have caused itself."""
        return Outcome.UNDECIDED in self._outcomes and not self._outcomes & {Outcome.FAILED, Outcome.NOT_TESTED}

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.undecided:
            return "undecided, because this machine was busy,"
        if not self.conforming:
            return "not conforming"
        return "conforming, as far as it was tested," if self.left_out else "conforming"

    @property
    def _outcomes(self) -> set[Outcome]:
        return {finding.outcome for finding in self.findings}

    @property
    def summary(self) -> str:
        """The verdict, and how many requirements had which outcome, in one line."""
        counts = Counter(finding.outcome for finding in self.findings)
        parts = [f"{counts[outcome]} {outcome.value}" for outcome in Outcome if counts[outcome]]
        lost = f"; the controller was lost after {self.lost_after}" if self.lost_after else ""
        left_out = f"; left out: {' and '.join(self.left_out)}" if self.left_out else ""
        checked = f"; {UP_TO_DAC_CALL}" if self.up_to_dac_call else ""
        return f"{self.verdict.rstrip(',')}: {', '.join(parts)}{lost}{left_out}{checked}"

    def sections(self) -> list[tuple[str, list[Finding]]]:
        """Return the findings by section, in the order of the protocol's page."""
        by_section = sorted(self.findings, key=lambda finding: SECTIONS.index(finding.requirement.section))
        return [(name, list(found)) for name, found in groupby(by_section, lambda each: each.requirement.section)]

    def facts(self) -> dict[str, Any]:
        """Return the report ready for JSON."""
        return {
            "schema": SCHEMA,
            "protocol": f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}",
            "suite": f"vibrocast {version('vibrocast')}",
            "run": asdict(self.run),
            "conforming": self.conforming,
            "left_out": list(self.left_out),
            "lost_after": self.lost_after,
            "up_to_dac_call": self.up_to_dac_call,
            "controller": devices.described(self.hello),
            "requirements": [
                {**asdict(finding.requirement), "outcome": finding.outcome.value}
                | {name: text for name, text in (("reason", finding.reason), ("measured", finding.measured)) if text}
                for finding in self.findings
            ],
        }

    def page(self) -> str:
        """Return the page."""
        facts = self.facts()
        controller = facts["controller"]
        described = {name: controller[name] for name in ("build", "hardware", "protocol")}
        described["codecs"] = ", ".join(controller["codecs"])
        described["actuator"] = controller["actuator"].pop("name")
        return pages.render(
            Path(__file__).with_name("conformance.md.jinja"),
            report=self,
            facts=facts,
            controller={**described, **controller["actuator"], **controller["limits"]},
            cell=_cell,
        )

    def write(self, folder: Path) -> None:
        """Write page and JSON into a folder, and make it if absent. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in ((PAGE, self.page()), (JSON, json.dumps(self.facts(), indent=2) + "\n")):
            with atomic_write(folder / name) as partial:
                partial.write_text(text, encoding="utf-8")


def _cell(text: object) -> str:
    """Return text, which may be a controller's, as a cell of a Markdown table in which it is nothing but text."""
    return re.sub(r"[\\`\[\]|]", r"\\\g<0>", html.escape(plain(" ".join(str(text).split())), quote=False))
