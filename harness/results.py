"""The results of a run: kept as JSON, judged by limits, and compared with an earlier run."""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vibrocast.errors import InputError
from vibrocast.files import atomic_write
from vibrocast.host.bench_limits import Judged, lost_percent
from vibrocast.host.report import Provenance

NAMES = ("latency", "smallest", "throughput", "load", "gap", "fidelity", "response", "together")
"""The measurements, in the order of a run."""
PAGE, JSON, ACTUATOR = "measured.html", "measured.json", "actuator.toml"
FORMAT, SCHEMA = "vibrocast measurements", 2
DECODED, COMPUTED = "decoded as sent", "DAC as computed"
"""The figures that are 1 for yes and 0 for no."""
LINK = "link"
"""Counts of the whole run, beside the measurements."""
_MAX_BYTES = 1 << 26


@dataclass
class Results:
    """A run: the device, the host, and what was measured, by NAMES; `failed`: why others were not.

    `asked`: the names that were to be measured. `link`: `bad_frames_at_controller` and `bad_frames_at_host`.
    `missed`: the limits of the bench file that were missed, in words.
    """

    device: dict[str, Any]
    host: dict[str, str]
    measured: dict[str, Any] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    asked: tuple[str, ...] = NAMES
    link: dict[str, int] = field(default_factory=dict)
    missed: list[str] = field(default_factory=list)
    run: Provenance = field(default_factory=Provenance)

    def document(self) -> dict[str, Any]:
        """Return the run ready for JSON."""
        return {"format": FORMAT, "schema": SCHEMA, **_plain(asdict(self))}

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
    """A figure of two runs; None where a run has not measured it. `problem`: in words, None = within its tolerance."""

    name: str
    before: float | str | None
    now: float | str | None
    problem: str | None = None

    @property
    def regressed(self) -> bool:
        """Whether the figure has become worse, or can no longer be compared."""
        return self.problem is not None

    @property
    def counted(self) -> bool:
        """Whether the figure counts what was lost or differs, which another take does not undo."""
        return self.name.rpartition(": ")[2] in (DECODED, COMPUTED, "underruns", "lost packets", "damaged frames")


# A computer that does other work as well measures times again within these.
TOLERANCES = {
    "latency, ms": Tolerance(1, 2.0, 0.1),
    "latency to the sensor, ms": Tolerance(1, 5.0, 0.1),
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
    "underruns": Tolerance(1, 0.0),
    "lost packets": Tolerance(1, 0.0),
    "lag, ms": Tolerance(0, 50.0),
    "drift, ppm": Tolerance(0, 50.0),
    "damaged frames": Tolerance(1, 0.0),
}
_ALWAYS_KNOWN = ("smallest stable latency, ms",)
"""Figures that every working device has; others need a sensor, a capture or an unequal copy."""
_WHAT_A_DEVICE_IS = ("hardware", "serial_number", "actuator")


def read_results(path: Path) -> dict[str, Any]:
    """Read the JSON of an earlier run. Raises InputError for anything else, OSError where it cannot be read."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: no file; give the JSON of an earlier `vibrocast measure`")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: longer than any run's JSON; give that of an earlier `vibrocast measure`")
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_float=_finite, parse_constant=_finite)
        if (document["format"], document["schema"]) != (FORMAT, SCHEMA):
            raise ValueError(f"format {document['format']!r}, schema {document['schema']!r}")
        dict(figures(document))
        compare(document, document)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: not the JSON of an earlier `vibrocast measure`; give that ({error})") from error
    return dict(document)


def _finite(text: str) -> float:
    """Return a number of a document. Raises ValueError for NaN and infinity, which no run writes."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no figure")
    return value


def figures(document: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the known figures of a run: name, as in TOLERANCES behind any "place: ", and value."""
    for measurement in (*NAMES, LINK):
        for name, value in figures_of(document, measurement):
            if value is not None:
                yield name, value


def figures_of(document: dict[str, Any], measurement: str) -> Iterator[tuple[str, float | None]]:
    """Yield the figures of one measurement, or of LINK; None where the run took it and does not know the figure."""
    measured = document[LINK] if measurement == LINK else document["measured"].get(measurement)
    if measured:
        for name, value in _FIGURES[measurement](measured):
            yield name, None if value is None else float(value)


def _of_latency(latency: Any) -> Iterator[tuple[str, Any]]:
    yield "latency, ms", latency["total_ms"]
    yield "latency to the sensor, ms", latency.get("to_sensor_ms")
    yield "jitter, ms", latency["jitter_ms"]
    yield f"live: {DECODED}", latency["as_sent"]
    yield "live: underruns", latency["underruns"]
    yield "live: lost packets", latency["lost_packets"]
    yield "clock: drift, ppm", latency["clock"]["drift_ppm"]


def _of_smallest(smallest: Any) -> Iterator[tuple[str, Any]]:
    yield "smallest stable latency, ms", (smallest["found"] or {}).get("total_ms")


def _of_throughput(throughput: Any) -> Iterator[tuple[str, Any]]:
    yield "throughput to the controller, bytes/s", throughput["to_controller_bytes_per_s"]
    yield "throughput to the host, bytes/s", throughput["to_host_bytes_per_s"]


def _of_load(loads: Any) -> Iterator[tuple[str, Any]]:
    held = [load["channels"] * load["rate_hz"] for load in loads if not load["underruns"] + load["lost_packets"]]
    yield "largest load, samples/s", max(held, default=0)


def _of_gap(gaps: Any) -> Iterator[tuple[str, Any]]:
    yield "longest gap, ms", gaps[0]["survived_ms"]
    yield "longest gap with a full buffer, ms", gaps[-1]["survived_ms"]


def _of_fidelity(textures: Any) -> Iterator[tuple[str, Any]]:
    keys = {
        DECODED: "as_decoded",
        COMPUTED: "as_computed",
        "underruns": "underruns",
        "lost packets": "lost_packets",
        "SNR, dB": "snr_db",
        "SNR without the codec, dB": "playing_snr_db",
        "ST-SIM": "st_sim",
        "gain": "gain",
        "lag, ms": "lag_ms",
    }
    for texture in textures:
        for name, key in keys.items():
            yield f"{texture['texture']}: {name}", texture[key]


def _of_response(response: Any) -> Iterator[tuple[str, Any]]:
    fit = response["fit"]
    yield "corner, Hz", fit["corner_hz"]
    yield "stroke, um", fit["stroke_um"]
    yield "quality", fit["quality"]


def _of_together(together: Any) -> Iterator[tuple[str, Any]]:
    yield "controllers that played as computed", sum(each["as_computed"] is True for each in together)


def _of_link(link: Any) -> Iterator[tuple[str, Any]]:
    yield "to the controller: damaged frames", link.get("bad_frames_at_controller")
    yield "to the host: damaged frames", link.get("bad_frames_at_host")


_FIGURES = {
    "latency": _of_latency,
    "smallest": _of_smallest,
    "throughput": _of_throughput,
    "load": _of_load,
    "gap": _of_gap,
    "fidelity": _of_fidelity,
    "response": _of_response,
    "together": _of_together,
    LINK: _of_link,
}


def judged(document: dict[str, Any]) -> Iterator[Judged]:
    """Yield the figures of a run that limits of a bench file judge."""
    measured, link = document["measured"], document[LINK]
    if latency := measured.get("latency"):
        yield from judged_latency(latency)
    for texture in measured.get("fidelity") or ():
        place = texture["texture"]
        for key in ("snr_db", "gain", "st_sim", "underruns"):
            yield Judged(key, place, texture[key])
        yield Judged("lost_percent", place, lost_percent(texture["lost_packets"], texture["packets"]))
    if measured.get("load"):
        ((_, load),) = _of_load(measured["load"])
        yield Judged("load_samples_per_s", "load", load)
    if link:
        yield Judged("bad_frames", "link", sum(link.values()))


def judged_latency(latency: dict[str, Any]) -> Iterator[Judged]:
    """Yield the figures of a measured latency that limits judge."""
    yield Judged("latency_ms", "live", latency["total_ms"])
    yield Judged("sensor_latency_ms", "live", latency["to_sensor_ms"])
    yield Judged("jitter_ms", "live", latency["jitter_ms"])
    yield Judged("drift_ppm", "clock", latency["clock"]["drift_ppm"])
    yield Judged("underruns", "live", latency["underruns"])
    yield Judged("lost_percent", "live", lost_percent(latency["lost_packets"], latency["packets"]))


def deviations(document: dict[str, Any]) -> Iterator[str]:
    """Yield in words where the controller played something else than was sent, though it lost nothing."""
    measured = document["measured"]
    latency = measured.get("latency")
    if latency and latency["as_sent"] is False and not (latency["lost_packets"] or latency["underruns"]):
        yield f"live: {DECODED}"
    for texture in measured.get("fidelity") or ():
        if texture["lost_packets"] or texture["underruns"]:
            continue
        for name, key in ((DECODED, "as_decoded"), (COMPUTED, "as_computed")):
            if texture[key] is False:
                yield f"{texture['texture']}: {name}"
    for each in measured.get("together") or ():
        if each["as_computed"] is False and not each["underruns"]:
            yield f"{each['name']}, together: {COMPUTED}"


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
    """Return every figure of two runs with its problem, if any: worse beyond its tolerance, or not in both runs.

    Measurements that `now` left out are not compared. Another device is a problem, too.
    """
    changes = [
        Change(key, str(before["device"].get(key)), str(now["device"].get(key)), "another device")
        for key in _WHAT_A_DEVICE_IS
        if _as_described(before["device"].get(key)) != _as_described(now["device"].get(key))
    ]
    for measurement in (*(name for name in NAMES if name in now["asked"]), LINK):
        earlier, later = dict(figures_of(before, measurement)), dict(figures_of(now, measurement))
        if not earlier and not later and measurement != LINK:
            changes.append(Change(measurement, None, None, "in neither run"))
        for name in {**earlier, **later}:
            changes.append(_change(name, earlier.get(name), later.get(name), name in earlier, name in later))
    return changes


def _as_described(value: Any) -> Any:
    """Return a controller's description without the fitted parameters that a bench file may give it."""
    return value.get("name") if isinstance(value, dict) else value


def _change(name: str, before: float | None, now: float | None, was_taken: bool, is_taken: bool) -> Change:
    problem = None
    if not (was_taken and is_taken):
        problem = "not in the earlier run" if is_taken else "not measured now"
    elif (before is None) != (now is None):
        problem = "not known in the earlier run" if before is None else "not known now"
    elif before is None and name in _ALWAYS_KNOWN:
        problem = "known in neither run"
    elif before is not None and now is not None:
        tolerance = TOLERANCES[name.rpartition(": ")[2]]
        problem = None if tolerance.allows(before, now) else "worse"
    return Change(name, before, now, problem)


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold: an infinite SNR, as of an exact copy, becomes None."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return value
