"""The results of a run: kept as JSON, and compared with an earlier run."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vibrocast.files import InputFileError, atomic_write

NAMES = ("latency", "smallest", "throughput", "load", "gap", "fidelity", "response", "together")
"""The measurements, in the order of a run."""
PAGE, JSON, ACTUATOR = "measured.html", "measured.json", "actuator.toml"
FORMAT = "vibrocast measurements 1"
DECODED, COMPUTED = "decoded as sent", "DAC as computed"
"""The figures that are 1 for yes and 0 for no."""
_MAX_BYTES = 1 << 26


@dataclass
class Results:
    """A run: the device, the host, and what was measured, by NAMES; `failed`: why others were not."""

    device: dict[str, Any]
    host: dict[str, str]
    measured: dict[str, Any] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the run ready for JSON."""
        return {"format": FORMAT, **_plain(asdict(self))}

    def write(self, path: Path) -> None:
        """Write the run as JSON, whole or not at all. Raises OSError."""
        with atomic_write(path) as partial:
            partial.write_text(json.dumps(self.document(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Tolerance:
    """By how much a figure may change for the worse: the larger of the two, `relative` to the earlier value.

    `worse`: 1 where a higher figure is worse, -1 where a lower one is, 0 where any other is.
    """

    worse: int
    absolute: float
    relative: float = 0.0

    def allows(self, before: float, now: float) -> bool:
        """Return whether a figure is within the tolerance of its earlier value."""
        change = abs(now - before) if self.worse == 0 else self.worse * (now - before)
        return change <= max(self.absolute, self.relative * abs(before))


@dataclass(frozen=True)
class Change:
    """A figure of two runs; None where a run has not measured it."""

    name: str
    before: float | None
    now: float | None
    regressed: bool


# A computer that does other work as well measures times again within these.
TOLERANCES = {
    "latency, ms": Tolerance(1, 2.0, 0.1),
    "jitter, ms": Tolerance(1, 2.0, 0.5),
    "smallest stable latency, ms": Tolerance(1, 4.0, 0.2),
    "throughput to the controller, bytes/s": Tolerance(-1, 0.0, 0.3),
    "throughput to the host, bytes/s": Tolerance(-1, 0.0, 0.3),
    "largest load, samples/s": Tolerance(-1, 0.0, 0.5),
    "longest gap, ms": Tolerance(-1, 20.0, 0.1),
    "longest gap with a full buffer, ms": Tolerance(-1, 20.0, 0.1),
    DECODED: Tolerance(-1, 0.0),
    COMPUTED: Tolerance(-1, 0.0),
    "SNR, dB": Tolerance(-1, 1.0),
    "SNR without the codec, dB": Tolerance(-1, 1.0),
    "ST-SIM": Tolerance(-1, 0.02),
    "gain": Tolerance(0, 0.0, 0.05),
    "corner, Hz": Tolerance(0, 1.0, 0.03),
    "quality": Tolerance(0, 0.05, 0.1),
    "stroke, um": Tolerance(0, 0.5, 0.03),
    "controllers that played as computed": Tolerance(-1, 0.0),
}


def read_results(path: Path) -> dict[str, Any]:
    """Read the JSON of an earlier run. Raises InputFileError for anything else, OSError where it cannot be read."""
    if path.exists() and not path.is_file():
        raise InputFileError(f"{path}: no file; give the JSON of an earlier `vibrocast measure`")
    if path.stat().st_size > _MAX_BYTES:
        raise InputFileError(f"{path}: longer than any run's JSON; give that of an earlier `vibrocast measure`")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != FORMAT:
            raise ValueError(f"format {document['format']!r}")
        dict(figures(document))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputFileError(f"{path}: not the JSON of an earlier `vibrocast measure`; give that ({error})") from error
    return dict(document)


def figures(document: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the figures that runs are compared by: name, as in TOLERANCES behind any "texture: ", and value."""
    measured = document["measured"]
    if latency := measured.get("latency"):
        yield "latency, ms", float(latency["total_ms"])
        yield "jitter, ms", float(latency["jitter_ms"])
    if found := (measured.get("smallest") or {}).get("found"):
        yield "smallest stable latency, ms", float(found["total_ms"])
    if throughput := measured.get("throughput"):
        yield "throughput to the controller, bytes/s", float(throughput["to_controller_bytes_per_s"])
        yield "throughput to the host, bytes/s", float(throughput["to_host_bytes_per_s"])
    if loads := measured.get("load"):
        held = [load["channels"] * load["rate_hz"] for load in loads if not load["underruns"] + load["lost_packets"]]
        yield "largest load, samples/s", float(max(held, default=0))
    if gaps := measured.get("gap"):
        yield "longest gap, ms", float(gaps[0]["survived_ms"])
        yield "longest gap with a full buffer, ms", float(gaps[-1]["survived_ms"])
    for texture in measured.get("fidelity") or ():
        keys = {
            DECODED: "as_decoded",
            COMPUTED: "as_computed",
            "SNR, dB": "snr_db",
            "SNR without the codec, dB": "playing_snr_db",
            "ST-SIM": "st_sim",
            "gain": "gain",
        }
        for name, key in keys.items():
            if texture[key] is not None:
                yield f"{texture['texture']}: {name}", float(texture[key])
    if response := measured.get("response"):
        fit = response["fit"]
        yield "corner, Hz", float(fit["corner_hz"])
        yield "stroke, um", float(fit["stroke_um"])
        if fit["quality"] is not None:
            yield "quality", float(fit["quality"])
    if together := measured.get("together"):
        yield "controllers that played as computed", float(sum(each["as_computed"] is True for each in together))


def warnings(document: dict[str, Any]) -> Iterator[str]:
    """Yield in words what makes a figure of `figures` uncertain."""
    latency = document["measured"].get("latency")
    if latency and (latency["lost_packets"] or latency["underruns"]):
        yield (
            f"{latency['lost_packets']} packets came too late while the latency was measured, with "
            f"{latency['underruns']} underruns; use a less busy machine"
        )


def described(name: str, value: float) -> str:
    """Return a figure of `figures` as a line for a person: its unit behind the value, yes or no in words."""
    title, _, unit = name.partition(", ")
    if title.endswith((DECODED, COMPUTED)):
        return f"{title}: {'yes' if value else 'no'}"
    return f"{title}: {value:{'.0f' if abs(value) >= 1000 else '.4g'}} {unit}".rstrip()


def compare(before: dict[str, Any], now: dict[str, Any]) -> list[Change]:
    """Return every figure of two runs, and whether it has become worse beyond its tolerance."""
    earlier, later = dict(figures(before)), dict(figures(now))
    changes = []
    for name in {**earlier, **later}:
        old, new = earlier.get(name), later.get(name)
        tolerance = TOLERANCES[name.rpartition(": ")[2]]
        regressed = old is not None and new is not None and not tolerance.allows(old, new)
        changes.append(Change(name, old, new, regressed))
    return changes


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold: an infinite SNR, as of an exact copy, becomes None."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return value
