"""The hardware-in-the-loop harness: measures a controller on its bench, reports, and compares with an earlier run.

pytest imports this package in every project, for the plugin: all else is loaded at its first use.
"""

# ruff: noqa: F403, F405 - type checkers find the names of __all__ in these modules

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vibrocast.harness.latency import *
    from vibrocast.harness.live_run import *
    from vibrocast.harness.measurements import *
    from vibrocast.harness.results import *
    from vibrocast.harness.run import *

__all__ = [
    "ACTUATOR",
    "JSON",
    "NAMES",
    "PAGE",
    "PARTS",
    "Latency",
    "LiveRun",
    "MinLatency",
    "Results",
    "compare",
    "described",
    "deviations",
    "figures",
    "find_min_latency",
    "machine",
    "measure_bench",
    "measure_latency",
    "read_results",
    "run_live",
    "subject",
    "warnings",
]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name in __all__:
        for module in ("results", "latency", "live_run", "measurements", "run"):
            names = vars(import_module(f"{__name__}.{module}"))
            if name in names:
                return names[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
