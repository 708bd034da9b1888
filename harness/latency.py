"""Measures the delay from a block's last sample at the host to the DAC, by part; searches the lowest that is stable."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vibrocast import codec, textures
from vibrocast.codec.source import recording_format
from vibrocast.device_protocol.messages import Status
from vibrocast.harness.sensors import Recorder, TimedRecording, recorded
from vibrocast.host import live
from vibrocast.host.controller import ControllerError
from vibrocast.host.devices import Session
from vibrocast.host.figures import Value
from vibrocast.host.live_playback import ClockFit, LivePlayback
from vibrocast.host.playback import align, displacement_above_20_hz, displacement_um, high_passed
from vibrocast.host.report import Report
from vibrocast.output.actuator import Actuator
from vibrocast.output.rendering import Drive
from vibrocast.textures import Recording

# In the order in which a sample goes through them.
PARTS = {
    "wake": "until the host's program runs",
    "encode": "the codec's encoder",
    "send": "until the operating system has taken the packet",
    "wire": "until the controller has the packet",
    "buffer": "the packet lies ready until it is needed",
    "codec": "the packet's length and the overlap of blocks, after its first sample is due",
    "drive": "resampling to the DAC's rate and the compensation's low-pass",
    "dac": "one DAC sample: half the hold, half the compensated response",
}
# A trial of the search is as long as some hundred packets; what it finds is measured once more, for longer.
TRIAL_S = 1.5
PLAYOUT_DELAYS_S = (0.064, 0.032, 0.016, 0.008, 0.004, 0.002, 0.001, 0.0005)
HOPS = ("16", "32")
_FIGURES = ("latency_ms", "jitter_ms", "drift_ppm", "as_decoded", "as_computed", "underruns", "lost_percent")
MOST_LATE = 0.1
"""Late packets and underruns, as a share of the measured packets, beyond which medians do not describe a stream."""


class FlawedError(ControllerError):
    """A latency that is not what it seems to be. `doubt`: why this machine may have caused that, as of `Report`."""

    def __init__(self, problem: str, doubt: str) -> None:
        super().__init__(problem)
        self.doubt = doubt


@dataclass(frozen=True)
class Spread:
    """Of many blocks, in ms: the median and the value that 95 % of them keep below."""

    median_ms: float
    high_ms: float


@dataclass(frozen=True)
class Latency:
    """The delay of a live stream, from a block's last sample at the host to the DAC.

    `report`: of the stream; it has latency, jitter, losses and the comparison. `parts`: `wake`,
    `encode`, `send`, `wire`, `buffer`, `codec`, `drive` and `dac`, as PARTS explains them.
    `blocks`: packets that were timed. `to_sensor_ms`: the same way on to a sensor's sample in this computer, with the
    actuator's and the sensor's own delay; None without such a sensor.
    """

    report: Report
    setting: dict[str, str]
    packet_samples: int
    blocks: int
    parts: dict[str, Spread]
    clock: ClockFit
    to_sensor_ms: float | None = None

    @property
    def total_ms(self) -> float:
        """From a block's last sample at the host to the DAC."""
        assert self.report.timing.end_to_end_ms is not None, "it was measured"
        return self.report.timing.end_to_end_ms

    @property
    def holds(self) -> bool:
        """Whether every packet came in time, and the delay is what it seems to be."""
        return not self.report.lost_anything and self.flaw is None

    @property
    def flaw(self) -> str | None:
        """Why the delay is not what it seems to be; None where almost every packet came before it was needed."""
        lost, underruns = self.report.lost_packets, self.report.underruns
        if lost + underruns > MOST_LATE * self.blocks:
            return f"{lost} packets came too late, and {underruns} underruns moved the stream"
        if self.parts["buffer"].median_ms < -self.clock.round_trip_ms / 2:  # the bound of the clock offset's error
            return "packets seem to be played before they arrive, so the controller's clock is not known"
        return None

    def figures(self) -> Iterator[Value]:
        """Yield the figures of the delay, the clock and the losses. Of the skin, a fidelity says more."""
        yield from (value for value in self.report.figures() if value.key in _FIGURES)
        yield Value("sensor_latency_ms", "live", self.to_sensor_ms)


@dataclass(frozen=True)
class Trial:
    """One setting that the search for the lowest delay has measured; `total_ms` is None where it was not stable."""

    hop: str
    playout_delay_ms: float
    total_ms: float | None


@dataclass(frozen=True)
class MinLatency:
    """The result of the search: the lowest stable delay, None if none was stable, and all trials."""

    found: Latency | None
    trials: tuple[Trial, ...]


def measure_latency(
    session: Session,
    texture: Recording,
    *,
    seconds: float = 4.0,
    rate_hz: int = 2800,
    setting: codec.Setting | None = None,
    playout_delay_s: float = live.PLAYOUT_DELAY_S,
    recorder: Recorder | None = None,
    progress: Callable[[float], None] | None = None,
) -> Latency:
    """Stream a texture live, as long as `seconds`, and measure where the time goes.

    `recorder`: of a sensor at an input of this computer; None = the measurement ends at the DAC. Everything else is by
    the session's clock and the device's, whose offset and drift come from Status round trips behind packets, one at a
    time; the answers also tell when those packets were there. Raises SensorError, AlignmentError, and as
    `live.LiveStream`.
    """
    source = looped(texture, seconds, rate_hz)
    coding = live.LiveCoding(setting=setting)
    stream = live.LiveStream(
        session.controller, recording_format(source), coding=coding, playout_delay_s=playout_delay_s
    )
    playing = LivePlayback(session, stream, texture.name, ask_s=0.0)

    def tell(_: Status) -> None:
        if progress is not None:
            progress(stream.seconds / source.seconds)

    with recorded(recorder, session.controller, seconds) as finish:
        report = playing.play(playing.paced(source.samples), tell).report
        recording = None if finish is None else finish()
    latency_s = playing.latency_s()
    if latency_s is None or report.live is None or report.timing.jitter_ms is None:
        raise FlawedError(
            "the stream never played: no packet came in time; check the link, and what else it carries", report.doubt
        )
    # The first packet is left out: it waited for the start of the stream.
    asked = np.array([bool(number) for number in playing.clock.trips])
    sent = np.array([playing.sent[number][:4] for number in playing.clock.trips])[asked]
    due_s, awake_s, coded_s, sent_s = sent.T
    arrived_s = playing.arrived_s()[asked]
    fixed_s = {
        "codec": (stream.packet_samples - 1 + stream.delay_samples) / rate_hz,
        "drive": Drive(stream.header, session.driven, compensation=True).delay_seconds,
        "dac": 1 / session.driven.dac_rate_hz,
    }
    parts_s = {
        "wake": awake_s - due_s,
        "encode": coded_s - awake_s,
        "send": sent_s - coded_s,
        "wire": np.maximum(0.0, arrived_s - (sent_s - due_s)),
        "buffer": latency_s - sum(fixed_s.values()) - arrived_s,
        **{name: np.full(len(sent), value_s) for name, value_s in fixed_s.items()},
    }
    return Latency(
        report=report,
        setting={name: str(value) for name, value in stream.setting.items()},
        packet_samples=stream.packet_samples,
        blocks=len(sent),
        parts={name: _spread(values_s) for name, values_s in parts_s.items()},
        clock=playing.clock.fit(),
        to_sensor_ms=(
            1e3 * _to_sensor_s(source, session.driven, recording, playing.sent[0].due_s - stream.packet_s)
            if isinstance(recording, TimedRecording)
            else None
        ),
    )


def _to_sensor_s(source: Recording, actuator: Actuator, recording: TimedRecording, began_s: float) -> float:
    """Return the time from when samples were taken, from `began_s` on, until a sensor's reached this computer.

    Raises AlignmentError where the recording does not contain them.
    """
    rate_hz = round(source.rate_hz)
    sent_um = high_passed(displacement_um(source.samples, source.unit, rate_hz, actuator)[:, 0], rate_hz)
    lag_s = align(sent_um, displacement_above_20_hz(recording, rate_hz), rate_hz, drifts=True).lag_s
    return float(recording.began_s + lag_s - began_s - 1 / rate_hz)


def measure_credible_latency(
    session: Session,
    texture: Recording,
    *,
    recorder: Recorder | None = None,
    progress: Callable[[float], None] | None = None,
) -> Latency:
    """Measure the latency, once more if it has a flaw. Raises FlawedError if it has one then too, and as before."""
    for _ in range(2):
        measured = measure_latency(session, texture, recorder=recorder, progress=progress)
        if measured.flaw is None:
            return measured
    raise FlawedError(f"{measured.flaw}; use a less busy machine or a faster link", measured.report.doubt)


def find_min_latency(
    session: Session,
    texture: Recording,
    *,
    seconds: float = 4.0,
    progress: Callable[[float], None] | None = None,
) -> MinLatency:
    """Search the lowest delay that is stable: for each length of a block, the margin down until it fails twice.

    The best is measured again for `seconds`, and given up for the next where it does not hold. Raises as
    `measure_latency`.
    """
    trials: list[Trial] = []
    stable: list[tuple[float, str, float]] = []

    def measured(hop: str, playout_delay_s: float, lasts_s: float) -> Latency:
        setting = {"hop": hop}
        return measure_latency(session, texture, seconds=lasts_s, setting=setting, playout_delay_s=playout_delay_s)

    for number, hop in enumerate(HOPS):
        for place, playout_delay_s in enumerate(PLAYOUT_DELAYS_S):
            once = measured(hop, playout_delay_s, TRIAL_S)
            if not once.holds:  # the computer may have been busy with something else
                once = measured(hop, playout_delay_s, TRIAL_S)
            trials.append(Trial(hop, 1e3 * playout_delay_s, once.total_ms if once.holds else None))
            if progress is not None:
                progress((number + place / len(PLAYOUT_DELAYS_S)) / len(HOPS))
            if not once.holds:
                break
            stable.append((once.total_ms, hop, playout_delay_s))
    for _, hop, playout_delay_s in sorted(stable):
        found = measured(hop, playout_delay_s, seconds)
        if found.holds:
            return MinLatency(found, tuple(trials))
    return MinLatency(None, tuple(trials))


def looped(texture: Recording, seconds: float, rate_hz: int) -> Recording:
    """Return the first channel of a texture at another rate, again and again until `seconds` are full."""
    samples = textures.resample(texture, rate_hz).samples[:, :1]
    return Recording(np.resize(samples, (round(seconds * rate_hz), 1)), rate_hz, texture.unit, texture.name)


def _spread(values_s: Sequence[float]) -> Spread:
    return Spread(1e3 * float(np.median(values_s)), 1e3 * float(np.quantile(values_s, 0.95)))
