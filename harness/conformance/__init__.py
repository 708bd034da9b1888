"""The conformance suite: tests a controller against docs/reference/protocol.md, through nothing but its port.

`run_suite` runs the modules test_*.py on a `TappedLink` and returns a `Report`.
"""

from vibrocast.harness.conformance.report import PAGE, Outcome, Report
from vibrocast.harness.conformance.runner import NotTestable, SuiteInterrupted, run_suite
from vibrocast.harness.conformance.tapped_link import TappedLink

__all__ = ["PAGE", "NotTestable", "Outcome", "Report", "SuiteInterrupted", "TappedLink", "run_suite"]
