"""Where a report comes from: its run, date, versions and bench file, so that you can trace each figure."""

import datetime
import platform
import uuid
from dataclasses import dataclass, field
from importlib.metadata import version


def _versions() -> dict[str, str]:
    return {
        "vibrocast": version("vibrocast"),
        "numpy": version("numpy"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class Provenance:
    """The origin of a report. `date`: ISO 8601, UTC. `bench_sha256`: of the bench file, hexadecimal; None = no file."""

    bench_sha256: str | None = None
    run_id: str = field(default_factory=lambda: str(uuid.uuid4()))
    date: str = field(default_factory=_now)
    versions: dict[str, str] = field(default_factory=_versions)
