"""The figures of all reports: one table of labels, units and tolerances; limits that judge them; and the verdict."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, NamedTuple

from vibrocast.errors import FAILED, HOST_BUSY, LIMIT_MISSED, REGRESSION
from vibrocast.toml_tables import Table, within


@dataclass(frozen=True)
class Figure:
    """A figure that reports state.

    Attributes:
        key: Its name in values, in tables of CSV, and behind min_ or max_ in limits.
        label: Its name for people.
        unit: Its unit; empty where it has none.
        worse: 1 where a higher one is worse, -1 where a lower one is, 0 where any other is.
        absolute: By how much another run may be worse.
        relative: The same in parts of the earlier value; the larger of the two counts.
        is_timed: Whether a busy machine makes it worse.
    """

    key: str
    label: str
    unit: str = ""
    worse: int = 1
    absolute: float = 0.0
    relative: float = 0.0
    is_timed: bool = False

    @property
    def title(self) -> str:
        """The label with the unit, as above a column."""
        return f"{self.label}, {self.unit}" if self.unit else self.label

    def text(self, value: float | bool) -> str:
        """Return a value with its unit, or yes or no."""
        if isinstance(value, bool):
            return "yes" if value else "no"
        return f"{value:{'.0f' if abs(value) >= 1000 else '.4g'}} {self.unit}".rstrip()

    def is_worse(self, before: float, now: float) -> bool:
        """Return whether a value is worse than an earlier one beyond the tolerance."""
        return self.worse * (now - before) >= 0 and self.differs(before, now)

    def differs(self, before: float, now: float) -> bool:
        """Return whether a value differs from an earlier or an expected one beyond the tolerance."""
        return abs(now - before) > max(self.absolute, self.relative * abs(before))


# A computer that does other work as well measures times again within these tolerances. A delay that was forecast
# depends on the computer and the link.
FIGURES = {
    figure.key: figure
    for figure in (
        Figure("latency_ms", "latency", "ms", 1, 2.0, 0.1, is_timed=True),
        Figure("sensor_latency_ms", "latency to the sensor", "ms", 1, 5.0, 0.1, is_timed=True),
        Figure("smallest_latency_ms", "smallest stable latency", "ms", 1, 4.0, 0.2, is_timed=True),
        Figure("delay_ms", "delay", "ms", 1, math.inf, 0.0),
        Figure("jitter_ms", "jitter", "ms", 1, 2.0, 0.5, is_timed=True),
        Figure("drift_ppm", "drift", "ppm", 0, 50.0, is_timed=True),
        Figure("lag_ms", "lag", "ms", 0, 50.0),
        Figure("as_decoded", "decoded as sent", worse=-1),
        Figure("as_computed", "DAC as computed", worse=-1),
        Figure("all_as_computed", "controllers that played as computed", worse=-1),
        Figure("underruns", "underruns", is_timed=True),
        Figure("lost_packets", "lost packets"),
        Figure("lost_percent", "lost packets", "%", is_timed=True),
        Figure("bad_frames", "damaged frames"),
        Figure("repeated_frames", "repeated frames"),
        Figure("reordered_frames", "reordered frames"),
        Figure("device_restarts", "restarts of the controller"),
        Figure("to_controller_bytes_per_s", "throughput to the controller", "bytes/s", -1, 0.0, 0.3, is_timed=True),
        Figure("to_host_bytes_per_s", "throughput to the host", "bytes/s", -1, 0.0, 0.3, is_timed=True),
        Figure("load_samples_per_s", "largest load", "samples/s", -1, 0.0, 0.5, is_timed=True),
        Figure("gap_ms", "longest gap", "ms", -1, 20.0, 0.1, is_timed=True),
        Figure("full_gap_ms", "longest gap with a full buffer", "ms", -1, 20.0, 0.1, is_timed=True),
        Figure("payload_bps", "payload", "bit/s", 1, 0.0, 0.1),
        Figure("wire_bps", "on the wire", "bit/s", 1, 0.0, 0.1),
        Figure("instructions_per_second", "instructions", "1/s", 1, 0.0, 0.1),
        Figure("load_percent", "load", "%", 1, 0.0, 0.1),
        Figure("flash_bytes", "flash", "bytes"),
        Figure("ram_bytes", "RAM", "bytes"),
        Figure("snr_db", "SNR", "dB", -1, 1.0, 0.0),
        Figure("coding_snr_db", "SNR of the codec", "dB", -1, 1.0, 0.0),
        Figure("decoded_snr_db", "SNR of the codec at the skin", "dB", -1, 1.0, 0.0),
        Figure("weighted_snr_db", "SNR weighted by the threshold", "dB", -1, 1.0, 0.0),
        Figure("playing_snr_db", "SNR without the codec", "dB", -1, 1.0, 0.0),
        Figure("st_sim", "ST-SIM", "", -1, 0.02, 0.0),
        Figure("spqi", "SPQI", "", -1, 0.0, 0.1),
        Figure("third_octave_distance_db", "third-octave distance", "dB", 1, 1.0, 0.0),
        Figure("error_over_threshold_db", "error re threshold", "dB", 1, 1.0, 0.0),
        Figure("gain", "gain", "", 0, 0.0, 0.05),
        Figure("corner_hz", "corner", "Hz", 0, 1.0, 0.03),
        Figure("stroke_um", "stroke", "um", 0, 0.5, 0.03),
        Figure("quality", "quality of the resonance", "", 0, 0.05, 0.1),
    )
}
"""All figures by their keys. SNR without another word is that at the skin, or of a plan that of the decoded signal."""
WIRE_FIGURES = ("bad_frames", "repeated_frames", "reordered_frames")
"""Figures of the frames that went wrong on the wire."""


class Value(NamedTuple):
    """A figure's value in a run. `key`: in FIGURES. `place`: such as a texture's name, empty where there is one only.

    `value`: None where the run does not know it, which misses a limit. `doubt`: why this machine may have made it
    worse; empty: it has not.
    """

    key: str
    place: str
    value: float | bool | None
    doubt: str = ""

    @property
    def name(self) -> str:
        """The place and the title, for people."""
        return f"{self.place}: {FIGURES[self.key].title}" if self.place else FIGURES[self.key].title

    def line(self) -> str:
        """Return the value with its place, label and unit. It is known."""
        assert self.value is not None, "it is known"
        label = FIGURES[self.key].label
        where = f"{self.place}: " if self.place else ""
        return f"{where}{label}: {FIGURES[self.key].text(self.value)}"


class Noted(NamedTuple):
    """Something wrong in words. `doubt`: as of Value."""

    text: str
    doubt: str = ""


Decibels = Annotated[float, within(-100, 200, "SNR in dB")]
Gain = Annotated[float, within(-10, 10, "gain, 1 = as sent")]
Similarity = Annotated[float, within(0, 1, "ST-SIM")]
Milliseconds = Annotated[float, within(0, 1e5, "time in ms")]
Count = Annotated[int, within(0, 10**9)]
Percent = Annotated[float, within(0, 100, "share in %")]
SamplesPerSecond = Annotated[float, within(0, 1e9, "samples per second of all channels")]
Drift = Annotated[float, within(0, 1e5, "drift in ppm")]

DEFAULT_MAX_LOST_PERCENT = 1.0


class BenchLimits(Table, frozen=True, kw_only=True):
    """Figures that a run must keep; None = not judged.

    SNR, gain and ST-SIM: at the skin. `max_lost_percent`: of the packets of a live stream or a playback.
    `max_latency_ms`: of a live stream, up to the DAC; `max_sensor_latency_ms`: up to a sensor's sample in this
    computer. `max_bad_frames`, `max_repeated_frames`, `max_reordered_frames`: damaged on the wire, come twice, or out
    of order, in both directions. `min_load_samples_per_s`: the largest load that is held. `max_drift_ppm`: of the
    controller's clock, in either direction.
    """

    min_snr_db: Decibels | None = None
    min_gain: Gain | None = None
    max_gain: Gain | None = None
    min_st_sim: Similarity | None = None
    max_latency_ms: Milliseconds | None = None
    max_sensor_latency_ms: Milliseconds | None = None
    max_jitter_ms: Milliseconds | None = None
    max_underruns: Count | None = None
    max_lost_percent: Percent | None = DEFAULT_MAX_LOST_PERCENT
    max_bad_frames: Count | None = None
    max_repeated_frames: Count | None = None
    max_reordered_frames: Count | None = None
    min_load_samples_per_s: SamplesPerSecond | None = None
    max_drift_ppm: Drift | None = None

    def __post_init__(self) -> None:
        if self.min_gain is not None and self.max_gain is not None and self.min_gain > self.max_gain:
            raise ValueError("min_gain is above max_gain; swap them")


def missed(limits: BenchLimits, values: Iterable[Value]) -> list[Noted]:
    """Return each limit that a value misses, in words."""
    lines = []
    for key, place, value, doubt in values:
        for bound, sign in (("min", 1), ("max", -1)):
            name = f"{bound}_{key}"
            limit = getattr(limits, name, None)
            if limit is None or (key == "lost_percent" and limit == 100):  # no share is above it
                continue
            size = abs(value) if value is not None and key == "drift_ppm" else value
            if size is None:
                lines.append(Noted(f"{place}: {key} is not known, {name} = {limit:g}", doubt))
            elif not sign * size >= sign * limit:
                lines.append(Noted(f"{place}: {key} = {size:.4g}, {name} = {limit:g}", doubt))
    return lines


def lost_percent(lost: int, packets: int) -> float:
    """Return the share of packets that were lost; 0 without packets."""
    return 100 * lost / packets if packets else 0.0


_WORST_FIRST = (FAILED, REGRESSION, LIMIT_MISSED, HOST_BUSY)
_MAX_SHOWN = 6


class Verdict(Enum):
    """The verdict on a run. UNDECIDED: this machine may have caused all that is wrong."""

    PASSED = "passed"
    FAILED = "failed"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """What a run has failed for, with the exit code of its kind (vibrocast.errors) and a doubt as of Noted."""

    text: str
    exit_code: int
    doubt: str = ""

    def __str__(self) -> str:
        return f"undecided, because {self.doubt}: {self.text}" if self.doubt else self.text


def findings(exit_code: int, problem: str, noted: Iterable[Noted], action: str) -> list[Finding]:
    """Return one finding of a kind for all that has the same doubt; none where nothing is noted."""
    texts: dict[str, list[str]] = {}
    for text, doubt in noted:
        texts.setdefault(doubt, []).append(text)
    return [
        Finding(f"{problem}: {_shown(each)}; {'repeat on a less busy machine' if doubt else action}", exit_code, doubt)
        for doubt, each in texts.items()
    ]


def judged(
    values: Iterable[Value], misses: Iterable[Noted], where: str = "see [limits] in the bench file"
) -> list[Finding]:
    """Return what is wrong with figures: bits that differ though nothing was lost, and limits missed.

    `misses`: as `missed` returns them. `where`: what to do about them.
    """
    differing = [Noted(f"not {value.name}") for value in values if value.value is False]
    return [
        *findings(
            FAILED,
            "the controller played something else than was sent, though nothing was lost",
            differing,
            "its memory, its firmware or its actuator differs: flash the firmware again, and check the actuators given",
        ),
        *findings(LIMIT_MISSED, "limits missed", misses, where),
    ]


def _shown(texts: Sequence[str]) -> str:
    more = f"; and {len(texts) - _MAX_SHOWN} more" if len(texts) > _MAX_SHOWN else ""
    return "; ".join(texts[:_MAX_SHOWN]) + more


def exit_code_of(found: Iterable[Finding]) -> int:
    """Return the exit code of the worst finding; 0 without any."""
    codes = {HOST_BUSY if each.doubt else each.exit_code for each in found}
    return next((code for code in _WORST_FIRST if code in codes), 0)


def verdict_on(found: Iterable[Finding]) -> Verdict:
    """Return the verdict on a run of which all this was found."""
    code = exit_code_of(found)
    return {0: Verdict.PASSED, HOST_BUSY: Verdict.UNDECIDED}.get(code, Verdict.FAILED)
