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


@dataclass(frozen=True)
class Figure:
    """A figure of a measurement.

    Attributes:
        name: For people and comparisons: a place if any, the title, and the unit. Empty where only a limit needs it.
        key: Its place in the measurement, such as "clock.drift_ppm".
        tolerance: Of a comparison with an earlier run.
        limit: Key of the bench's limits that judge it, without min_ or max_; empty where none does.
    """

    name: str
    key: str
    tolerance: Tolerance
    limit: str = ""


_KEPT, _NO_MORE = Tolerance(-1, 0.0), Tolerance(1, 0.0)
# A computer that does other work as well measures times again within these tolerances.
FIGURES = {
    "latency": (
        Figure("latency, ms", "total_ms", Tolerance(1, 2.0, 0.1), "latency_ms"),
        Figure("latency to the sensor, ms", "to_sensor_ms", Tolerance(1, 5.0, 0.1), "sensor_latency_ms"),
        Figure("jitter, ms", "jitter_ms", Tolerance(1, 2.0, 0.5), "jitter_ms"),
        Figure("clock: drift, ppm", "clock.drift_ppm", Tolerance(0, 50.0), "drift_ppm"),
        Figure(f"live: {DECODED}", "as_sent", _KEPT),
        Figure("live: underruns", "underruns", _NO_MORE, "underruns"),
        Figure("live: lost packets", "lost_packets", _NO_MORE),
        Figure("", "lost_percent", _NO_MORE, "lost_percent"),
    ),
    "smallest": (Figure("smallest stable latency, ms", "found.total_ms", Tolerance(1, 4.0, 0.2)),),
    "throughput": (
        Figure("throughput to the controller, bytes/s", "to_controller_bytes_per_s", Tolerance(-1, 0.0, 0.3)),
        Figure("throughput to the host, bytes/s", "to_host_bytes_per_s", Tolerance(-1, 0.0, 0.3)),
    ),
    "load": (Figure("largest load, samples/s", "held", Tolerance(-1, 0.0, 0.5), "load_samples_per_s"),),
    "gap": (
        Figure("longest gap, ms", "usual.survived_ms", Tolerance(-1, 20.0, 0.1)),
        Figure("longest gap with a full buffer, ms", "full.survived_ms", Tolerance(-1, 20.0, 0.1)),
    ),
    "fidelity": (
        Figure(DECODED, "as_decoded", _KEPT),
        Figure(COMPUTED, "as_computed", _KEPT),
        Figure("underruns", "underruns", _NO_MORE, "underruns"),
        Figure("lost packets", "lost_packets", _NO_MORE),
        Figure("", "lost_percent", _NO_MORE, "lost_percent"),
        Figure("SNR, dB", "snr_db", Tolerance(-1, 1.0), "snr_db"),
        Figure("SNR without the codec, dB", "playing_snr_db", Tolerance(-1, 1.0)),
        Figure("ST-SIM", "st_sim", Tolerance(-1, 0.02), "st_sim"),
        Figure("gain", "gain", Tolerance(0, 0.0, 0.05), "gain"),
        Figure("lag, ms", "lag_ms", Tolerance(0, 50.0)),
    ),
    "response": (
        Figure("corner, Hz", "fit.corner_hz", Tolerance(0, 1.0, 0.03)),
        Figure("stroke, um", "fit.stroke_um", Tolerance(0, 0.5, 0.03)),
        Figure("quality", "fit.quality", Tolerance(0, 0.05, 0.1)),
    ),
    "together": (Figure("controllers that played as computed", "as_computed", _KEPT),),
    LINK: (
        Figure("to the controller: damaged frames", "bad_frames_at_controller", _NO_MORE),
        Figure("to the host: damaged frames", "bad_frames_at_host", _NO_MORE),
        Figure("", "bad_frames", _NO_MORE, "bad_frames"),
    ),
}
"""The figures of each measurement; those of fidelity stand behind the name of their texture, as in "oak: gain"."""
_TOLERANCES = {
    each.name.rpartition(": ")[2]: each.tolerance for group in FIGURES.values() for each in group if each.name
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
    """Yield the known figures of a run: name, as in FIGURES behind any texture's name, and value."""
    for measurement in (*NAMES, LINK):
        for name, value in figures_of(document, measurement):
            if value is not None:
                yield name, value


def figures_of(document: dict[str, Any], measurement: str) -> Iterator[tuple[str, float | None]]:
    """Yield the figures of one measurement, or of LINK; None where the run took it and does not know the figure."""
    measured = document[LINK] if measurement == LINK else document["measured"].get(measurement)
    for place, figure, value in _values(measurement, measured):
        if figure.name:
            name = f"{place}: {figure.name}" if measurement == "fidelity" else figure.name
            yield name, None if value is None else float(value)


def judged(document: dict[str, Any]) -> Iterator[Judged]:
    """Yield the figures of a run that limits of a bench file judge."""
    for measurement in NAMES:
        yield from _judged(measurement, document["measured"].get(measurement))
    yield from _judged(LINK, document[LINK])


def judged_latency(latency: dict[str, Any]) -> Iterator[Judged]:
    """Yield the figures of a measured latency that limits judge."""
    return _judged("latency", latency)


def _judged(measurement: str, measured: Any) -> Iterator[Judged]:
    for place, figure, value in _values(measurement, measured):
        if figure.limit:
            yield Judged(figure.limit, figure.name.rpartition(": ")[0] or place, value)


def _values(measurement: str, measured: Any) -> Iterator[tuple[str, Figure, Any]]:
    """Yield the place, the figure and the value of all figures of a measurement; none if it was not taken."""
    for place, part in _parts(measurement, measured) if measured else ():
        for figure in FIGURES[measurement]:
            value = part
            for key in figure.key.split("."):
                value = None if value is None else value[key]
            yield place, figure, value


def _parts(measurement: str, measured: Any) -> list[tuple[str, Any]]:
    """Return the parts of a measurement with their places; those of lists get the keys that FIGURES names."""
    match measurement:
        case "latency":
            return [("live", _with_share(measured))]
        case "load":
            held = [each["channels"] * each["rate_hz"] for each in measured if not _lost(each)]
            return [("load", {"held": max(held, default=0)})]
        case "gap":
            return [("gap", {"usual": measured[0], "full": measured[-1]})]
        case "fidelity":
            return [(each["texture"], _with_share(each)) for each in measured]
        case "together":
            return [("together", {"as_computed": sum(each["as_computed"] is True for each in measured)})]
        case "link":  # a controller that was lost has no counts
            return [(LINK, {"bad_frames_at_controller": None} | measured | {"bad_frames": sum(measured.values())})]
    return [(measurement, measured)]


def _with_share(measured: dict[str, Any]) -> dict[str, Any]:
    return measured | {"lost_percent": lost_percent(measured["lost_packets"], measured["packets"])}


def _lost(measured: dict[str, Any]) -> bool:
    """Return whether packets of a stream came too late, or its output ran empty."""
    return bool(measured["lost_packets"] or measured["underruns"])


def deviations(document: dict[str, Any]) -> Iterator[str]:
    """Yield in words where the controller played something else than was sent, though it lost nothing."""
    measured = document["measured"]
    latency = measured.get("latency")
    if latency and latency["as_sent"] is False and not _lost(latency):
        yield f"live: {DECODED}"
    for texture in measured.get("fidelity") or ():
        for name, key in ((DECODED, "as_decoded"), (COMPUTED, "as_computed")):
            if texture[key] is False and not _lost(texture):
                yield f"{texture['texture']}: {name}"
    for each in measured.get("together") or ():
        if each["as_computed"] is False and not each["underruns"]:
            yield f"{each['name']}, together: {COMPUTED}"


def warnings(document: dict[str, Any]) -> Iterator[str]:
    """Yield in words what makes a figure of `figures` uncertain."""
    latency = document["measured"].get("latency")
    if latency and _lost(latency):
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
        tolerance = _TOLERANCES[name.rpartition(": ")[2]]
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
