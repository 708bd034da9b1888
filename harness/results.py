"""The results of a run: kept as JSON, judged by limits, and compared with an earlier run."""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import msgspec

from vibrocast.errors import FAILED, REGRESSION, InputError
from vibrocast.files import atomic_write
from vibrocast.harness.fidelity import Fidelity
from vibrocast.harness.latency import Latency, MinLatency
from vibrocast.harness.load import Gap, Load, Throughput
from vibrocast.harness.measurements import Together, misfits
from vibrocast.harness.response import Response
from vibrocast.host.bench_file import Bench
from vibrocast.host.figures import FIGURES, WIRE_FIGURES, Finding, Noted, Value, findings, judged
from vibrocast.host.report import Provenance

PAGE, JSON, ACTUATOR = "measured.html", "measured.json", "actuator.toml"
FORMAT, SCHEMA = "vibrocast measurements", 3
LINK = "link"
"""What went wrong on the link in the whole run, beside the measurements."""
_MAX_BYTES = 1 << 26


@dataclass
class Measured:
    """What was measured, in the order of a run; None where it was not."""

    latency: Latency | None = None
    smallest: MinLatency | None = None
    throughput: Throughput | None = None
    load: tuple[Load, ...] | None = None
    gap: tuple[Gap, ...] | None = None
    fidelity: tuple[Fidelity, ...] | None = None
    response: Response | None = None
    together: tuple[Together, ...] | None = None


NAMES = tuple(each.name for each in fields(Measured))
"""The measurements, in the order of a run."""
STABLE = tuple(name for name in NAMES if name not in ("smallest", "load", "gap"))
"""Those that hardly differ from run to run; the others search for a limit of controller, link and computer together."""


@dataclass
class Results:
    """A run: the device, the host, and what was measured; `failed`: why others were not, by NAMES.

    `asked`: the names that were to be measured. `link`: counts of the frames that went wrong on the wire.
    `missed`: the limits of the bench file that were missed, in words. `doubts`: why this machine may have made the
    figures of a measurement worse, by its name; one that kept its time has none.
    """

    device: dict[str, Any]
    host: dict[str, str]
    measured: Measured = field(default_factory=Measured)
    failed: dict[str, str] = field(default_factory=dict)
    asked: tuple[str, ...] = NAMES
    link: dict[str, int] = field(default_factory=dict)
    missed: list[str] = field(default_factory=list)
    doubts: dict[str, str] = field(default_factory=dict)
    run: Provenance = field(default_factory=Provenance)

    def document(self) -> dict[str, Any]:
        """Return the run ready for JSON."""
        document = _plain(asdict(self))
        measured = {name: taken for name, taken in document.pop("measured").items() if taken is not None}
        return {"format": FORMAT, "schema": SCHEMA, "measured": measured, **document}

    def write(self, path: Path) -> None:
        """Write the run as JSON, whole or not at all. Raises OSError."""
        with atomic_write(path) as partial:
            partial.write_text(json.dumps(self.document(), indent=2, allow_nan=False) + "\n", encoding="utf-8")

    def figures(self) -> Iterator[Value]:
        """Yield all figures of the run."""
        for measurement in (*NAMES, LINK):
            yield from self.figures_of(measurement)

    def figures_of(self, measurement: str) -> Iterator[Value]:
        """Yield the figures of one measurement, or of LINK; None where the run took it and does not know the figure."""
        if measurement == LINK:
            there = self.link.get("bad_frames_at_controller")  # a controller that was lost has no count
            bad_frames = None if there is None else there + self.link.get("bad_frames_at_host", 0)
            yield Value("bad_frames", LINK, bad_frames)
            yield Value("repeated_frames", LINK, self.link.get("repeated_frames", 0))
            yield Value("reordered_frames", LINK, self.link.get("reordered_frames", 0))
            yield Value("device_restarts", LINK, self.link.get("device_restarts", 0))
        elif (taken := getattr(self.measured, measurement)) is not None:
            for value in _FIGURES_OF[measurement](taken):
                doubt = self.doubts.get(measurement, "") if FIGURES[value.key].is_timed else ""
                yield value._replace(doubt=value.doubt or doubt)


def _of(part: object, *keys: str) -> list[Value]:
    """Return figures that are attributes of the same name."""
    return [Value(key, "", getattr(part, key)) for key in keys]


_FIGURES_OF: dict[str, Callable[[Any], Iterable[Value]]] = {
    "latency": Latency.figures,
    "smallest": lambda taken: [Value("smallest_latency_ms", "", taken.found and taken.found.total_ms)],
    "throughput": lambda taken: _of(taken, "to_controller_bytes_per_s", "to_host_bytes_per_s"),
    "load": lambda taken: [Value("load_samples_per_s", "", max((each.samples_per_s for each in taken), default=0))],
    "gap": lambda taken: [Value("gap_ms", "", taken[0].survived_ms), Value("full_gap_ms", "", taken[-1].survived_ms)],
    "fidelity": lambda taken: (value for each in taken for value in each.figures()),
    "response": lambda taken: _of(taken.fit, "corner_hz", "stroke_um", "quality"),
    "together": lambda taken: [Value("all_as_computed", "", sum(each.as_computed is True for each in taken))],
}
_ALWAYS_KNOWN = ("smallest_latency_ms",)
"""Figures that every working device has; others need a sensor, a capture or an unequal copy."""
_COUNTED = ("as_decoded", "as_computed", "underruns", "lost_percent", *WIRE_FIGURES)
_AT_SKIN = {"snr_db", "playing_snr_db", "st_sim", "gain", "lag_ms", "corner_hz", "stroke_um", "quality"}
_ON_THE_WAY = {"latency", "latency_ms", "jitter_ms", "underruns", "lost_percent"}
_WHAT_A_DEVICE_IS = ("hardware", "serial_number", "actuator")


@dataclass(frozen=True)
class Change:
    """A figure of two runs; None where a run has not measured it. `problem`: in words, None = within its tolerance.

    `key`: of the figure, or what makes it another device.
    `counted`: the figure counts what was lost or differs, which another take does not undo. `doubt`: why this machine
    may have made it worse.
    """

    name: str
    before: float | str | None
    now: float | str | None
    problem: str | None = None
    counted: bool = False
    doubt: str = ""
    key: str = ""


def read_results(path: Path) -> Results:
    """Read the JSON of an earlier run. Raises InputError for anything else, OSError where it cannot be read."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: no file; give the JSON of an earlier `vibrocast measure`")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: longer than any run's JSON; give that of an earlier `vibrocast measure`")
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_float=_finite, parse_constant=_finite)
        if (document["format"], document["schema"]) != (FORMAT, SCHEMA):
            raise ValueError(f"format {document['format']!r}, schema {document['schema']!r}")
        return msgspec.convert(document, Results)
    except (ValueError, TypeError, KeyError, RecursionError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: not the JSON of an earlier `vibrocast measure`; give that ({error})") from error


def _finite(text: str) -> float:
    """Return a number of a document. Raises ValueError for NaN and infinity, which no run writes."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no figure")
    return value


def findings_in(run: Results, bench: Bench, changes: Iterable[Change] = (), earlier: object = "") -> list[Finding]:
    """Return all that is wrong with a run on a bench: measurements that failed, figures, and limits missed.

    `changes`: against the run in the file `earlier`, as of `compare`.
    """
    together = [
        Value("as_computed", f"{each.name}, together", False)
        for each in run.measured.together or ()
        if each.as_computed is False and not each.underruns
    ]
    failed = [Noted(f"{name}: {why}", run.doubts.get(name, "")) for name, why in run.failed.items()]
    restarts = [Noted(f"{count} of them", "") for count in [run.link.get("device_restarts")] if count]
    worse = [Noted(f"{each.name} ({each.problem})", each.doubt) for each in changes if each.problem]
    return [
        *findings(FAILED, "not all could be measured", failed, "--only repeats some"),
        *findings(FAILED, "the controller restarted on its own", restarts, "check its power and its firmware"),
        *findings(REGRESSION, f"not as in {earlier}", worse, "compare both reports, then measure again"),
        *judged([*run.figures(), *together], [*bench.missed(run.figures()), *misfits(bench, run.measured.response)]),
    ]


def likely_cause(run: Results, bench: Bench, changes: Iterable[Change] = ()) -> str:
    """Return what has most likely made a run miss limits or be worse: "wire", "host", "device", or what is behind it.

    Actuator and sensor cannot be told apart. Empty where nothing says so. `changes`: against an earlier run.
    """
    values = list(run.figures())
    doubts: dict[str, str] = {each.key: each.doubt for each in values if bench.missed([each])}
    doubts |= {each.key: each.doubt for each in changes if each.problem and each.now is not None}
    wrong = doubts.keys()
    late = {key: doubt for key, doubt in doubts.items() if key in FIGURES and FIGURES[key].is_timed}
    if "latency" in run.failed:
        late["latency"] = run.doubts.get("latency", "")
    at_skin = bool(wrong & _AT_SKIN) or bool({"fidelity", "response"} & run.failed.keys())
    if wrong & set(_WHAT_A_DEVICE_IS) or any(each.value is False for each in values):
        return "device"
    if run.link.get("device_restarts"):
        return "device"
    if any(each.value for each in values if each.place == LINK):
        return "wire"
    if late.get("drift_ppm") == "":
        return "device"
    if any(late.values()):
        return "host"
    # What is late or lost on the way is also late or wrong at the skin. A device that hangs looks like a wire.
    if late.keys() & _ON_THE_WAY:
        return "wire"
    if late and at_skin:  # it plays the right codes at wrong times
        return "device"
    if at_skin:
        return "actuator or sensor"
    return "wire" if late else ""


def warnings(run: Results) -> Iterator[str]:
    """Yield in words what makes a figure of a run uncertain."""
    if (latency := run.measured.latency) is not None and latency.report.lost_anything:
        yield (
            f"{latency.report.lost_packets} packets came too late while the latency was measured, with "
            f"{latency.report.underruns} underruns; use a less busy machine"
        )


def compare(before: Results, now: Results) -> list[Change]:
    """Return every figure of two runs with its problem, if any: worse beyond its tolerance, or not in both runs.

    Measurements that `now` left out are not compared. Another device is a problem, too.
    """
    changes = [
        Change(key, str(before.device.get(key)), str(now.device.get(key)), "another device", key=key)
        for key in _WHAT_A_DEVICE_IS
        if _as_described(before.device.get(key)) != _as_described(now.device.get(key))
    ]
    for measurement in (*(name for name in NAMES if name in now.asked), LINK):
        earlier, later = ({value.name: value for value in run.figures_of(measurement)} for run in (before, now))
        if not earlier and not later:
            changes.append(Change(measurement, None, None, "in neither run"))
        doubt = now.doubts.get(measurement, "")
        changes += [_change(earlier.get(name), later.get(name), doubt) for name in {**earlier, **later}]
    return changes


def _as_described(value: Any) -> Any:
    """Return a controller's description without the fitted parameters that a bench file may give it."""
    return value.get("name") if isinstance(value, dict) else value


def _change(earlier: Value | None, later: Value | None, doubt: str) -> Change:
    """Return how a figure has changed; None: a run has not taken its measurement, the later one with this doubt."""
    known = earlier or later
    assert known is not None, "a run has it"
    before, now = (None if each is None else each.value for each in (earlier, later))
    problem = None
    if earlier is None or later is None:
        problem = "not in the earlier run" if earlier is None else "not measured now"
    elif before is None and now is None:
        problem = "known in neither run" if known.key in _ALWAYS_KNOWN else None
    elif now is None:
        problem = "not known now"
    elif before is None:  # an exact copy cannot be worse than one that losses kept from being compared
        problem = None if now is True else "not known in the earlier run"
    elif FIGURES[known.key].is_worse(before, now):
        problem = "worse"
    return Change(known.name, before, now, problem, known.key in _COUNTED, later.doubt if later else doubt, known.key)


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold: an infinite SNR, as of an exact copy, becomes None."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return value
