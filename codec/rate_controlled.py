"""Encodes recordings as live streams with rate control, and measures how evenly and exactly they meet the target."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec import Signal, SignalFormat
from vibrocast.codec.encoding import (
    DEFAULT_STREAM_RATE_HZ,
    FamilyChoice,
    chosen_codec,
    first_reachable,
    measure_encoding,
    unsearched_excess,
)
from vibrocast.codec.rate_control import DEFAULT_RATE_BUFFER_S
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.frames import MAX_PAYLOAD_BYTES, write_frame
from vibrocast.device_protocol.messages import SinglePacket, pack
from vibrocast.errors import InputError

WINDOW_S = 2.0
"""A rate is held over any run of whole packets of this length."""
_QUIET_DB = 20.0


def added_bytes(packet: bytes) -> int:
    """Return the bytes that a frame of its own adds to a packet: 6 for up to 250 bytes, as policies count them.

    Raises TargetUnreachable for a packet that no frame carries.
    """
    try:
        return len(write_frame(pack(SinglePacket(0, packet)))) - len(packet)
    except InputError as error:
        raise codec.TargetUnreachable(
            f"a packet of {len(packet)} bytes cannot be sent, because a frame carries {MAX_PAYLOAD_BYTES}; "
            "choose a lower rate or quality, or shorter packets"
        ) from error


@dataclass(frozen=True)
class RateTarget:
    """A target for rate control: a constant rate; or a quality of every packet, up to a capped rate.

    `constant_rate_bps`, `capped_rate_bps`: of all channels, frames included. `snr_db`, `error_db`: the quality; the
    latter is the error's level relative to the detection threshold. `rate_buffer_s`: size of the rate buffer. None =
    the size that holds a rate within 1 % over any 2 s; a larger one makes the SNR more even. `packet_s`: length of
    packets. None = the shortest to which the wire adds at most 12 % at the full rate. `equal_error`: an equal error in
    all channels, in place of an equal SNR.
    """

    constant_rate_bps: float | None = None
    capped_rate_bps: float | None = None
    snr_db: float | None = None
    error_db: float | None = None
    rate_buffer_s: float | None = None
    packet_s: float | None = None
    equal_error: bool = False

    @property
    def rate_bps(self) -> float:
        """The rate that a stream does not exceed. Raises CodecError without one."""
        rate_bps = self.capped_rate_bps if self.constant_rate_bps is None else self.constant_rate_bps
        if rate_bps is None:
            raise codec.CodecError("a rate is needed; give a constant rate, or a capped one")
        return rate_bps

    def policy(self, signal_format: SignalFormat) -> codec.RatePolicy:
        """Return the policy, for one stream. Raises CodecError for an impossible target."""
        rate_buffer_s = DEFAULT_RATE_BUFFER_S if self.rate_buffer_s is None else self.rate_buffer_s
        if self.constant_rate_bps is not None:
            # The default rate buffer leaves a meter nothing to choose.
            meter = None if self.rate_buffer_s is None else codec.SnrMeter(signal_format.rate_hz)
            return codec.ConstantRate(self.constant_rate_bps, added_bytes, rate_buffer_s, meter)
        quality_db, quality_meter = self._quality(signal_format)
        return codec.CappedRate(quality_db, quality_meter, self.rate_bps, added_bytes, rate_buffer_s)

    def framing(self, rate_hz: int) -> codec.Framing:
        """Return how a stream of this sample rate is cut into packets."""
        if self.packet_s is not None:
            return codec.timed_framing(self.packet_s, rate_hz)
        return codec.rate_controlled_framing(self.rate_bps, rate_hz, added_bytes)

    def _quality(self, signal_format: SignalFormat) -> tuple[float, codec.QualityMeter]:
        if self.error_db is not None:
            return -self.error_db, codec.ThresholdMeter(signal_format)
        if self.snr_db is None:
            raise codec.CodecError("a quality is needed; give an SNR, or the error's level")
        return self.snr_db, codec.SnrMeter(signal_format.rate_hz)


@dataclass(frozen=True)
class Outcome:
    """How a stream met its target.

    `sent_bps`: packets and their frames; `packets_bps`: packets alone. `furthest`: largest deviation from the rate over
    any run of packets of 2 s, relative to the rate; None if the stream is shorter. `peak_bps`:
    highest rate over such a run; None if the stream is shorter. `padding`: part of the bytes sent that is padding.
    `packet_snrs_db`: of all packets except those 20 dB below the recording. `packet_s`: duration of a packet.
    """

    sent_bps: float
    packets_bps: float
    furthest: float | None
    peak_bps: float | None
    padding: float
    packet_snrs_db: tuple[float, ...]
    packet_s: float

    @property
    def frames_add(self) -> float:
        """Bytes that the frames add, relative to the packets."""
        return self.sent_bps / self.packets_bps - 1

    @property
    def snr_db(self) -> float:
        """Mean SNR over the packets; NaN if all are silent."""
        return float(np.mean(self.packet_snrs_db)) if self.packet_snrs_db else math.nan

    @property
    def snr_range_db(self) -> tuple[float, float]:
        """The 5th and the 95th percentile of the packets' SNR; NaN if all are silent."""
        if not self.packet_snrs_db:
            return math.nan, math.nan
        low, high = np.percentile(self.packet_snrs_db, (5, 95))
        return float(low), float(high)

    @property
    def snr_deviation_db(self) -> float:
        """Standard deviation of the packets' SNR; NaN if all are silent."""
        return float(np.std(self.packet_snrs_db)) if self.packet_snrs_db else math.nan


def encode(
    recording: textures.Recording,
    target: RateTarget,
    *,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    codec_name: str | None = None,
    setting: codec.Setting | None = None,
    model: models.Model | None = None,
    progress: Callable[[float], None] | None = None,
    highpass_hz: float | None = textures.HIGHPASS_HZ,
    touch: float | None = None,
) -> tuple[Stream, Outcome]:
    """Resample a recording to the stream's rate and code it as a live stream to a rate target.

    `codec_name`: None = the model's codec, or DEFAULT_CODEC. `model`: None = the built-in tables. A codec without such
    takes the choice of `first_reachable` among the models that ship. `highpass_hz` and `touch` as in
    `codec.encoding.encode_recording`. Raises CodecError, also if the target is out of reach, and as `encode_recording`.
    """
    passed = textures.highpass(recording, highpass_hz)
    resampled = textures.resample(passed.recording, stream_rate_hz)
    samples = resampled.samples
    signal_format = codec.recording_format(resampled)
    chosen = chosen_codec(codec_name, model)
    given = {
        **codec.shape_setting(chosen, touch, stream_rate_hz, resampled.unit, setting),
        **(codec.equal_error(chosen, signal_format) if target.equal_error else {}),
        **(setting or {}),
    }

    def source(candidate: models.Model | None, tell: Callable[[float], None] | None = None) -> codec.Source:
        return codec.Source(samples, stream_rate_hz, chosen.name, resampled.unit, True, candidate, tell)

    def code(candidate: models.Model | None, tell: Callable[[float], None] | None) -> tuple[Stream, Outcome]:
        policy = target.policy(signal_format)
        made = source(candidate, tell).encode_rate_controlled(given, policy, target.framing(stream_rate_hz))
        stream = measure_encoding(resampled, made, passed=passed).stream
        return stream, outcome(stream, samples, target.rate_bps, policy)

    def excess(candidate: models.Model) -> float:
        return unsearched_excess(source(candidate), given, target.rate_bps, snr_db=None)

    return first_reachable(chosen, model, code, progress, FamilyChoice(excess, lambda made: -made[1].snr_db))


def outcome(stream: Stream, samples: Signal, rate_bps: float, policy: codec.RatePolicy) -> Outcome:
    """Return how a stream of samples (n, channels) met the target rate of its policy. Raises CodecError."""
    packet_s = stream.packet_samples / stream.header.rate_hz
    sizes = [len(packet) + added_bytes(packet) for packet in stream.packets]
    seconds = packet_s * len(sizes)
    window_bps = _window_bps(sizes, packet_s)
    return Outcome(
        sent_bps=8 * sum(sizes) / seconds,
        packets_bps=8 * sum(map(len, stream.packets)) / seconds,
        furthest=max((each / rate_bps - 1 for each in window_bps), key=abs, default=None),
        peak_bps=max(window_bps, default=None),
        padding=policy.padding_bytes / sum(sizes),
        packet_snrs_db=tuple(_packet_snrs_db(samples, stream)),
        packet_s=packet_s,
    )


def _window_bps(sizes: Sequence[int], packet_s: float) -> list[float]:
    """Return the rate of every run of packets that lasts 2 s; empty if all packets last less."""
    run = math.ceil(WINDOW_S / packet_s - 1e-9)
    if run > len(sizes):
        return []
    return [8 * float(each) / (run * packet_s) for each in np.convolve(sizes, np.ones(run), "valid")]


def _packet_snrs_db(samples: Signal, stream: Stream) -> list[float]:
    """Return the SNR of each packet over all channels, without quiet packets."""
    # Leave out the last packet: it is seldom full, so it has bits to spare.
    first_end = stream.packet_samples - stream.delay_samples % stream.packet_samples
    *cuts, end = [0, *range(first_end, len(samples) + 1, stream.packet_samples)]
    if not cuts:
        cuts, end = [0], len(samples)
    samples, decoded = samples[:end], stream.decode()[:end]
    scale = np.sqrt(np.mean(np.square(samples), axis=0))
    normalised = np.where(scale > 0, scale, 1.0)
    power = np.add.reduceat(np.sum(np.square(samples / normalised), axis=1), cuts)
    error = np.add.reduceat(np.sum(np.square((samples - decoded) / normalised), axis=1), cuts)
    lengths = np.diff([*cuts, len(samples)])
    loud = (power > lengths * np.sum(power) / len(samples) * 10 ** (-_QUIET_DB / 10)) & (error > 0)
    return [float(ratio) for ratio in 10 * np.log10(power[loud] / error[loud])]
