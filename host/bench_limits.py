"""The `[limits]` of a bench file: the figures that a run must keep, and those that it missed."""

from collections.abc import Iterable
from typing import Annotated, NamedTuple

from vibrocast.toml_tables import Table, within

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
    `max_latency_ms` ends at the DAC, `max_sensor_latency_ms` at a sensor's sample in this computer. `max_bad_frames`:
    damaged on the wire, in both directions. `min_load_samples_per_s`: the largest load that is held. `max_drift_ppm`:
    of the controller's clock, in either direction.
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
    min_load_samples_per_s: SamplesPerSecond | None = None
    max_drift_ppm: Drift | None = None

    def __post_init__(self) -> None:
        if self.min_gain is not None and self.max_gain is not None and self.min_gain > self.max_gain:
            raise ValueError("min_gain is above max_gain; swap them")


class Judged(NamedTuple):
    """A figure that a limit judges. `key`: of the limits, without min_ or max_. `place`: such as a texture's name.

    `value`: None where the run does not know it, which misses a limit.
    """

    key: str
    place: str
    value: float | None


def missed(limits: BenchLimits, figures: Iterable[Judged]) -> list[str]:
    """Return a line for each limit that a figure misses."""
    lines = []
    for key, place, value in figures:
        for bound, sign in (("min", 1), ("max", -1)):
            name = f"{bound}_{key}"
            limit = getattr(limits, name, None)
            if limit is None or (key == "lost_percent" and limit == 100):  # no share is above it
                continue
            size = abs(value) if value is not None and key == "drift_ppm" else value
            if size is None:
                lines.append(f"{place}: {key} is not known, {name} = {limit:g}")
            elif not sign * size >= sign * limit:
                lines.append(f"{place}: {key} = {size:.4g}, {name} = {limit:g}")
    return lines


def lost_percent(lost: int, packets: int) -> float:
    """Return the share of packets that were lost; 0 without packets."""
    return 100 * lost / packets if packets else 0.0
