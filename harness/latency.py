"""Measures the delay from a block's last sample at the host to the DAC, by part; searches the lowest that is stable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vibrocast import codec, textures
from vibrocast.codec.live_format import recording_format
from vibrocast.device_protocol.messages import State, Tap
from vibrocast.harness.sensors import Recorder, TimedRecording, recorded
from vibrocast.host import live
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.device_clock import ClockFit, DeviceClock
from vibrocast.host.playback import displacement_um
from vibrocast.host.skin_quality import align, displacement_above_20_hz, high_passed
from vibrocast.host.stream_session import read_capture, stopped_on_error
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
MOST_LATE = 0.1
"""Late packets and underruns, as a share of the measured packets, beyond which medians do not describe a stream."""


@dataclass(frozen=True)
class Spread:
    """Of many blocks, in ms: the median and the value that 95 % of them keep below."""

    median_ms: float
    high_ms: float


@dataclass(frozen=True)
class Latency:
    """The delay of a live stream, from a block's last sample at the host to the DAC.

    `parts`: by the names of PARTS. `total_ms`: the median wait of a sample in all parts; every sample of a stream has
    the same. `jitter_ms`: between the 5 % and the 95 % of the times at which packets arrive, relative to when their
    samples were taken. `playout_delay_ms`: the time that packets should lie ready. `stable`: no underrun and no
    lost packet. `packets`: that were sent; `blocks`: those of them that were timed. `as_sent`: what the controller
    decoded, as far as it keeps that, is bit for bit what the packets hold. `to_sensor_ms`: the same way on to a
    sensor's sample in this computer, with the actuator's and the sensor's own delay; None without such a sensor.
    """

    codec: str
    setting: dict[str, str]
    rate_hz: int
    packet_samples: int
    playout_delay_ms: float
    blocks: int
    packets: int
    parts: dict[str, Spread]
    total_ms: float
    jitter_ms: float
    underruns: int
    lost_packets: int
    as_sent: bool
    clock: ClockFit
    to_sensor_ms: float | None = None

    @property
    def stable(self) -> bool:
        """Whether every packet came in time."""
        return not self.underruns and not self.lost_packets

    @property
    def holds(self) -> bool:
        """Whether every packet came in time, and the delay is what it seems to be."""
        return self.stable and self.flaw is None

    @property
    def flaw(self) -> str | None:
        """Why the delay is not what it seems to be; None where almost every packet came before it was needed."""
        if self.lost_packets + self.underruns > MOST_LATE * self.blocks:
            return f"{self.lost_packets} packets came too late, and {self.underruns} underruns moved the stream"
        if self.parts["buffer"].median_ms < -self.clock.round_trip_ms / 2:  # the bound of the clock offset's error
            return "packets seem to be played before they arrive, so the controller's clock is not known"
        return None


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
    controller: Controller,
    actuator: Actuator,
    texture: Recording,
    *,
    seconds: float = 4.0,
    rate_hz: int = 2800,
    setting: codec.Setting | None = None,
    playout_delay_s: float = live.PLAYOUT_DELAY_S,
    recorder: Recorder | None = None,
    progress: Callable[[float], None] | None = None,
) -> Latency:
    """Stream a texture live, as long as `seconds`, and measure where the time goes; `actuator`: the controller's.

    `recorder`: of a sensor at an input of this computer; None = the measurement ends at the DAC. Everything else is by
    the session's clock and the device's, whose offset and drift come from Status round trips behind packets, one at a
    time; the answers also tell when those packets were there. Raises SensorError, AlignmentError, and as
    `live.LiveStream`.
    """
    source = looped(texture, seconds, rate_hz)
    samples = source.samples
    stream = live.LiveStream(
        controller, recording_format(source), coding=live.LiveCoding(setting=setting), playout_delay_s=playout_delay_s
    )
    clock = DeviceClock(controller)
    packets: list[bytes] = []
    times_s: list[tuple[float, float, float, float]] = []  # due, awake, coded, sent
    recording: Recording | None = None
    with recorded(recorder, controller, seconds) as finish, stopped_on_error(controller):
        for due_s, block in live.paced(stream, samples, stream.packet_samples, clock.sleep):
            awake_s = controller.clock()
            coded = stream.code(block)
            coded_s = controller.clock()
            stream.send_packets(coded)
            sent_s = controller.clock()
            clock.ask(len(times_s))
            packets += coded
            times_s.append((due_s, awake_s, coded_s, sent_s))
            if progress is not None:
                progress(len(times_s) * stream.packet_samples / len(samples))
        result = stream.finish()
        if finish is not None:
            recording = finish()
    fit = clock.fit()
    decoder = codec.decoder(stream.header.codec_identifier, stream.header.configuration, stream.header.channels)
    first, decoded = read_capture(controller, Tap.DECODED, stream.header.channels)
    expected = np.concatenate([decoder.decode(packet) for packet in packets])
    # The first packet is left out: it waited for the start of the stream.
    numbers = np.array([number for number in clock.trips if number], np.int64)
    due_s_, awake_s_, coded_s_, sent_s_ = np.array(times_s)[numbers].T
    statuses = [clock.trips[number][2] for number in numbers]
    arrived_s = np.array([fit.host_time_s(status.device_time_us / 1e6) for status in statuses])
    # Positions are whole samples that have been played: the earliest estimate is the best.
    playing = [at for at, status in enumerate(statuses) if status.state == State.PLAYING and status.position]
    if not playing:
        raise ControllerError(
            "the stream never played: no packet came in time; check the link, and what else it carries"
        )
    began_s = min(arrived_s[at] - statuses[at].position / rate_hz for at in playing)
    needed_s = began_s + numbers * stream.packet_samples / rate_hz
    drive_s = Drive(stream.header, actuator, compensation=True).delay_seconds
    codec_s = (stream.packet_samples - 1 + decoder.delay_samples) / rate_hz
    parts_s = {
        "wake": awake_s_ - due_s_,
        "encode": coded_s_ - awake_s_,
        "send": sent_s_ - coded_s_,
        "wire": np.maximum(0.0, arrived_s - sent_s_),
        "buffer": needed_s - arrived_s,
        "codec": np.full(len(numbers), codec_s),
        "drive": np.full(len(numbers), drive_s),
        "dac": np.full(len(numbers), 1 / actuator.dac_rate_hz),
    }
    early_s, late_s = np.quantile(arrived_s - due_s_, (0.05, 0.95))
    return Latency(
        codec=codec.codec_by_identifier(stream.header.codec_identifier, stream.header.configuration).name,
        setting={name: str(value) for name, value in stream.setting.items()},
        rate_hz=rate_hz,
        packet_samples=stream.packet_samples,
        playout_delay_ms=1e3 * playout_delay_s,
        blocks=len(numbers),
        packets=len(packets),
        parts={name: _spread(values_s) for name, values_s in parts_s.items()},
        total_ms=1e3 * float(np.median(sum(parts_s.values()))),
        jitter_ms=1e3 * float(late_s - early_s),
        underruns=result.underruns,
        lost_packets=result.lost_packets,
        as_sent=bool(np.array_equal(decoded[: len(expected) - first], expected[first:])),
        clock=fit,
        to_sensor_ms=(
            1e3 * _to_sensor_s(source, actuator, recording, times_s[0][0] - stream.packet_s)
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
    controller: Controller,
    actuator: Actuator,
    texture: Recording,
    *,
    recorder: Recorder | None = None,
    progress: Callable[[float], None] | None = None,
) -> Latency:
    """Measure the latency, once more if it has a flaw. Raises ControllerError if it has one then too, and as before."""
    for _ in range(2):
        measured = measure_latency(controller, actuator, texture, recorder=recorder, progress=progress)
        if measured.flaw is None:
            return measured
    raise ControllerError(f"{measured.flaw}; use a less busy machine or a faster link")


def find_min_latency(
    controller: Controller,
    actuator: Actuator,
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
        return measure_latency(
            controller, actuator, texture, seconds=lasts_s, setting=setting, playout_delay_s=playout_delay_s
        )

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
