"""Rate control of live streams: targets, policies that choose the quality of each packet, and how a target was met.

A policy is a codec.interface.RateControl. It chooses the quantiser offset of each packet from all of that packet's
input, and no later input. `encode_rate_controlled` codes a signal with one. The results are in
docs/benchmarks/further_results.md.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import (
    Choice,
    Codec,
    CodecError,
    Decoder,
    Encoder,
    Framing,
    Model,
    Setting,
    Signal,
    SignalFormat,
    TargetUnreachable,
    Trial,
)
from vibrocast.codec.source import MAX_PACKET_BYTES, REFRESH_S, Source
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.frames import MAX_PAYLOAD_BYTES, write_frame
from vibrocast.device_protocol.messages import SinglePacket, pack
from vibrocast.errors import InputError

RATE_BUFFER_S = 0.018
"""Size of the rate buffer, as time at the rate: 1 % of 2 s, less a tenth, because packets seldom add up to just 2 s."""
FRAMES_ADD = 0.101
"""Most bytes that frames may add, relative to the packets in them. With the beginning and end of a stream of 5 s at 4
kbit/s, the wire then adds at most 12 %."""
MAX_PACKET_S = 2.0
"""Longest packet: a rate is held over any 2 s."""
WINDOW_S = 2.0
"""A rate is held over any run of whole packets of this length."""

_PROBE_PACKETS = 4
# A sequence number takes one byte at first, and four from packet 2^20 on.
_SEQUENCE_GROWTH_BYTES = 3


_SHORT_BYTES, _SHORT_ADDED_BYTES = 250, 6  # one block of COBS holds such a packet, whatever its bytes

# Forward masking of vibration at the fingertip fades within some 0.25 s (Gescheider, Bolanowski and Verrillo,
# "Vibrotactile masking: effects of stimulus onset asynchrony and stimulus frequency", JASA 85, 1989).
_MASKING_S = 0.25
_QUIET_DB = 20.0
_MIN_BIT = 2.0**-15
_FIRST_STRIDE = 2


def added_bytes(packet: bytes) -> int:
    """Return the bytes that a frame of its own adds to a packet, as policies count them.

    Raises TargetUnreachable for a packet that no frame carries.
    """
    if len(packet) <= _SHORT_BYTES:
        return _SHORT_ADDED_BYTES
    try:
        return len(write_frame(pack(SinglePacket(0, packet)))) - len(packet)
    except InputError as error:
        raise TargetUnreachable(
            f"a packet of {len(packet)} bytes cannot be sent, because a frame carries {MAX_PAYLOAD_BYTES}; "
            "choose a lower rate or quality, or shorter packets"
        ) from error


class Attempts:
    """The packets of a trial at its quantiser offsets, each coded once."""

    def __init__(self, trial: Trial, sent_bytes: Callable[[bytes], int]) -> None:
        """`sent_bytes`: returns the bytes of a packet and its frame."""
        self.trial = trial
        self.quantiser_offsets = trial.quantiser_offsets
        self._sent_bytes = sent_bytes
        self._packets: dict[int, bytes | None] = {}

    def packet(self, quantiser_offset: int) -> bytes | None:
        """Return the packet at a quantiser offset; None if it would be too long."""
        if quantiser_offset not in self._packets:
            try:
                self._packets[quantiser_offset] = self.trial.packet(quantiser_offset)
            except CodecError:
                self._packets[quantiser_offset] = None
        return self._packets[quantiser_offset]

    def coded(self, quantiser_offset: int) -> bytes:
        """Return the packet at a quantiser offset. Raises CodecError if it would be too long."""
        packet = self.packet(quantiser_offset)
        return self.trial.packet(quantiser_offset) if packet is None else packet

    def size_bytes(self, quantiser_offset: int) -> float:
        """Return the bytes of the packet with its frame; infinity if it would be too long."""
        packet = self.packet(quantiser_offset)
        try:
            return math.inf if packet is None else self._sent_bytes(packet)
        except CodecError:
            return math.inf  # no frame carries it

    def finest(self, holds: Callable[[int], bool], start: int) -> int | None:
        """Return a quantiser offset at which `holds`, and not at the next finer one; None if it holds at none.

        `holds` is true, on the whole, for coarse offsets and false for fine ones. Steps away from `start` double until
        the change lies between two tested offsets. Then the distance between these is halved.
        """
        first, last = self.quantiser_offsets[0], self.quantiser_offsets[-1]
        fails, succeeds = first - 1, last + 1
        quantiser_offset, stride = within(self.quantiser_offsets, start), _FIRST_STRIDE
        while succeeds - fails > 1:
            if holds(quantiser_offset):
                succeeds = quantiser_offset
            else:
                fails = quantiser_offset
            if fails < first:
                quantiser_offset = max(first, succeeds - stride)
            elif succeeds > last:
                quantiser_offset = min(last, fails + stride)
            else:
                quantiser_offset = (fails + succeeds) // 2
            stride *= 2
        if succeeds <= last:
            return succeeds
        return next(filter(holds, reversed(self.quantiser_offsets)), None)


def within(quantiser_offsets: range, quantiser_offset: int) -> int:
    """Return the offset of the range that is nearest to a quantiser offset."""
    return min(max(quantiser_offset, quantiser_offsets[0]), quantiser_offsets[-1])


class SnrMeter:
    """The quality of packets as the far end decodes them: the signal-to-noise ratio in dB, the mean over channels.

    A quiet packet need not reach it: a strong vibration masks a weaker one shortly after. For each channel, the error
    is compared with the greatest of three powers: the packet's; 20 dB below that of the last 0.25 s (an exponential
    mean); that of one least significant bit. So a pause after a loud texture gets no bits for masked noise, and digital
    silence gets none at all. The loud texture is forgotten by 17 dB a second; then a quiet texture is coded in full.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._power: NDArray[np.float64] | None = None
        self._decoder: Decoder | None = None

    def quality_db(self, samples: Signal, decoded: Signal) -> float:
        """Return the ratio of a packet; both arrays: float64 (packet_samples, channels), full scale 1."""
        floor = np.maximum(self._recent_power(samples) * 10 ** (-_QUIET_DB / 10), _MIN_BIT**2)
        power = np.maximum(np.mean(np.square(samples), axis=0), floor)
        # The error of rounding to int16, uniform over one least significant bit, has this power.
        error = np.maximum(np.mean(np.square(samples - decoded), axis=0), _MIN_BIT**2 / 12)
        return float(np.mean(10 * np.log10(power / error)))

    def update(self, samples: Signal) -> None:
        """Remember the power of the packet that was chosen."""
        self._power = self._recent_power(samples)

    def _recent_power(self, samples: Signal) -> NDArray[np.float64]:
        power: NDArray[np.float64] = np.mean(np.square(samples), axis=0)
        if self._power is None:
            return power
        kept = math.exp(-len(samples) / self._rate_hz / _MASKING_S)
        return kept * self._power + (1 - kept) * power

    def begin(self, decoder: Decoder) -> None:
        """Begin a stream, with a decoder in the state of the far end."""
        self._decoder = decoder

    def quality_at_db(self, attempts: Attempts, quantiser_offset: int) -> float:
        """Return the quality of the packet; infinity if it is too long to be coded."""
        packet = attempts.packet(quantiser_offset)
        if packet is None:
            return math.inf
        assert self._decoder is not None, "it has begun"
        return self.quality_db(attempts.trial.samples, copy(self._decoder).decode(packet) / 32768)

    def coarsest_with(self, attempts: Attempts, quality_db: float) -> int:
        """Return the coarsest offset with the quality; the finest that can be coded if none has it."""
        worse = attempts.finest(lambda each: self.quality_at_db(attempts, each) < quality_db, attempts.trial.previous)
        quantiser_offset = (
            attempts.quantiser_offsets[-1] if worse is None else within(attempts.quantiser_offsets, worse - 1)
        )
        if attempts.packet(quantiser_offset) is not None:
            return quantiser_offset
        codable = attempts.finest(lambda each: attempts.packet(each) is not None, quantiser_offset)
        return attempts.quantiser_offsets[-1] if codable is None else codable

    def choose(self, attempts: Attempts, quantiser_offset: int) -> None:
        """Decode the packet that was chosen, and remember it."""
        assert self._decoder is not None, "it has begun"
        self._decoder.decode(attempts.coded(quantiser_offset))
        self.update(attempts.trial.samples)


class RateBuffer:
    """The bytes sent and not yet drained at a constant rate, as in ITU-T H.264, C.1. Their number stays in 0 ... size.

    With fullness F, a packet of s bytes that lasts T seconds leaves F + s - R T / 8 at R bit/s. So over any run of
    packets, the bytes differ from R T / 8 by at most the size: R * RATE_BUFFER_S / 8, and at least one byte. On a link
    of R bit/s no packet waits longer than RATE_BUFFER_S.
    """

    def __init__(self, bits_per_second: float, full: float) -> None:
        """Make a rate buffer, at first filled to the part `full`. Raises CodecError for an invalid rate."""
        self.bits_per_second = bits_per_second
        self.fullness_bytes = full * self.size_bytes

    @property
    def bits_per_second(self) -> float:
        """The rate. You may set it at any time; the content of the rate buffer stays."""
        return self._bits_per_second

    @bits_per_second.setter
    def bits_per_second(self, bits_per_second: float) -> None:
        if not (math.isfinite(bits_per_second) and bits_per_second > 0):
            raise CodecError(f"a rate of {bits_per_second} bit/s cannot be held; ask for a positive number")
        self._bits_per_second = bits_per_second

    @property
    def size_bytes(self) -> float:
        """The capacity."""
        return max(1.0, self.bits_per_second * RATE_BUFFER_S / 8)

    @property
    def full(self) -> float:
        """The fullness relative to the size; above 1 only after the rate was lowered."""
        return self.fullness_bytes / self.size_bytes

    def min_bytes(self, seconds: float) -> int:
        """Return the fewest bytes with which a packet of this duration keeps the rate buffer from running dry."""
        return max(0, math.ceil(self._drained_bytes(seconds) - self.fullness_bytes))

    def max_bytes(self, seconds: float) -> int:
        """Return the most bytes with which a packet of this duration fits; negative if no packet does."""
        return math.floor(self._drained_bytes(seconds) - self.fullness_bytes + self.size_bytes)

    def fill(self, sent_bytes: int, seconds: float) -> None:
        """Add a packet."""
        self.fullness_bytes += sent_bytes - self._drained_bytes(seconds)

    def _drained_bytes(self, seconds: float) -> float:
        return self.bits_per_second * seconds / 8


class RatePolicy(ABC):
    """A rate control that keeps its packets, frames included, within a rate buffer (leaky bucket).

    `begin` a stream, then call the policy for each packet. A later stream replaces it.
    """

    _meter: SnrMeter | None = None

    def __init__(self, rate_buffer: RateBuffer) -> None:
        self.rate_buffer = rate_buffer
        self._seconds = math.nan
        self.min_bytes = 0
        """Bytes of a packet at its coarsest, as given to `begin`."""
        self.min_bits_per_second = 0.0
        """The least rate that suffices for any signal; known once a stream has begun."""
        self.padding_bytes = 0
        """Bytes of padding so far."""

    @property
    def bits_per_second(self) -> float:
        """The rate. You may set it at any time. Raises TargetUnreachable if it is too low, CodecError if invalid."""
        return self.rate_buffer.bits_per_second

    @bits_per_second.setter
    def bits_per_second(self, bits_per_second: float) -> None:
        self._check_reach(bits_per_second)
        self.rate_buffer.bits_per_second = bits_per_second

    def begin(self, decoder: Decoder, min_bytes: int, seconds: float) -> None:
        """Begin a stream of packets of `seconds` each, which `decoder` decodes from the first one on.

        `min_bytes`: bytes that suffice for a packet at its coarsest, whatever the signal, with its frame. Raises
        TargetUnreachable if they do not fit the rate.
        """
        if self._meter is not None:
            self._meter.begin(decoder)
        self._seconds = seconds
        self.min_bytes = min_bytes
        self.min_bits_per_second = 8 * min_bytes / seconds
        self._check_reach(self.bits_per_second)

    def sent_bytes(self, packet: bytes) -> int:
        """Return the bytes of a packet and its frame. Raises TargetUnreachable for a packet that no frame carries."""
        return len(packet) + added_bytes(packet)

    @abstractmethod
    def __call__(self, trial: Trial) -> Choice:
        """Choose how to code the next packet. Raises TargetUnreachable if no choice fits."""

    def _check_reach(self, bits_per_second: float) -> None:
        if bits_per_second < self.min_bits_per_second:
            raise self._target_unreachable(bits_per_second, self.min_bits_per_second)

    def _target_unreachable(self, bits_per_second: float, least: float) -> TargetUnreachable:
        return TargetUnreachable(
            f"{bits_per_second:g} bit/s cannot be held: packets of {1000 * self._seconds:.1f} ms and their frames take "
            f"at least {math.ceil(least)} bit/s; choose that rate, or longer packets"
        )

    def _finest_that_fits(self, attempts: Attempts, start: int) -> int:
        """Return the finest offset that fits the rate buffer; the coarsest if a lowered rate has overfilled it."""
        max_bytes = self.rate_buffer.max_bytes(self._seconds)
        found = attempts.finest(lambda each: attempts.size_bytes(each) <= max_bytes, start)
        if found is not None:
            return found
        coarsest = attempts.quantiser_offsets[-1]
        if self.rate_buffer.full > 1:
            return coarsest
        min_bytes = self.sent_bytes(attempts.coded(coarsest))
        raise self._target_unreachable(self.bits_per_second, 8 * min_bytes / self._seconds)


class CappedRate(RatePolicy):
    """A constant quality while the rate buffer holds it; else the finest quality that fits."""

    _meter: SnrMeter

    def __init__(self, quality_db: float, meter: SnrMeter, bits_per_second: float) -> None:
        super().__init__(RateBuffer(bits_per_second, full=0.0))
        self.quality_db = quality_db
        self._meter = meter

    def __call__(self, trial: Trial) -> Choice:
        """Choose the coarsest packet with the quality, or a coarser one that fits. Raises TargetUnreachable."""
        attempts = Attempts(trial, self.sent_bytes)
        quantiser_offset = self._meter.coarsest_with(attempts, self.quality_db)
        if attempts.size_bytes(quantiser_offset) > self.rate_buffer.max_bytes(self._seconds):
            quantiser_offset = self._finest_that_fits(attempts, quantiser_offset)
        self._meter.choose(attempts, quantiser_offset)
        self.rate_buffer.fill(self.sent_bytes(attempts.coded(quantiser_offset)), self._seconds)
        self.rate_buffer.fullness_bytes = max(0.0, self.rate_buffer.fullness_bytes)
        return Choice(quantiser_offset)


class ConstantRate(RatePolicy):
    """A constant rate: no packet overfills the rate buffer, and padding keeps it from running dry.

    Between these limits, each packet aims at its share of the rate.
    """

    def __init__(self, bits_per_second: float) -> None:
        super().__init__(RateBuffer(bits_per_second, full=0.5))

    def __call__(self, trial: Trial) -> Choice:
        """Choose the packet's quantiser offset and padding. Raises TargetUnreachable if none fits."""
        attempts = Attempts(trial, self.sent_bytes)
        min_bytes, max_bytes = self.rate_buffer.min_bytes(self._seconds), self.rate_buffer.max_bytes(self._seconds)
        share_bytes = self.bits_per_second * self._seconds / 8
        aim = attempts.finest(lambda each: attempts.size_bytes(each) <= share_bytes, trial.previous)
        quantiser_offset = attempts.quantiser_offsets[-1] if aim is None else aim
        if attempts.size_bytes(quantiser_offset) > max_bytes:
            quantiser_offset = self._finest_that_fits(attempts, quantiser_offset)
        elif attempts.size_bytes(quantiser_offset) < min_bytes:
            quantiser_offset = self._coarsest_that_fills(attempts, quantiser_offset, min_bytes, max_bytes)
        packet = attempts.coded(quantiser_offset)
        padded = self._padded(packet, min_bytes, max_bytes)
        self.padding_bytes += len(padded) - len(packet)
        self.rate_buffer.fill(self.sent_bytes(padded), self._seconds)
        return Choice(quantiser_offset, len(padded))

    def _coarsest_that_fills(self, attempts: Attempts, start: int, min_bytes: int, max_bytes: int) -> int:
        """Return the coarsest offset without padding or, if that does not fit, the one with the least padding."""
        short = attempts.finest(lambda each: attempts.size_bytes(each) < min_bytes, start)
        assert short is not None, "the packets at the aim are too short"
        finer = within(attempts.quantiser_offsets, short - 1)
        return finer if attempts.size_bytes(finer) <= max_bytes else short

    def _padded(self, packet: bytes, min_bytes: int, max_bytes: int) -> bytes:
        """Return the packet, padded with zeros so that it has the fewest bytes allowed with its frame."""
        padded = packet.ljust(len(packet) + min_bytes - self.sent_bytes(packet), b"\0")
        # A longer packet may have a longer frame.
        while len(padded) > len(packet) and self.sent_bytes(padded) > max_bytes:
            padded = padded[:-1]
        return padded


def rate_controlled_encoder(
    codec: Codec,
    setting: Setting,
    signal_format: SignalFormat,
    framing: Framing,
    model: Model | None,
    policy: RatePolicy,
) -> Encoder:
    """Make an encoder as `codec.make_encoder` does, rate-controlled by a policy, and begin the policy's stream.

    It first codes full-scale noise, silence and a click, to find the most bytes that the coarsest packets take. Raises
    CodecError as `make_encoder`, also for a codec that cannot control its rate, and as `policy.begin`.
    """
    if not codec.controls_rate:
        raise CodecError(
            f"all packets of {codec.name} have one quality; choose mdct, or another with rate control in "
            "`vibrocast codecs`"
        )
    encoder = codec.make_encoder(setting, signal_format, framing, model, policy)
    probe = codec.make_encoder(
        setting, signal_format, framing, model, lambda trial: Choice(trial.quantiser_offsets[-1])
    )
    shape = (_PROBE_PACKETS * encoder.packet_samples, signal_format.channels)
    noise, silence, click = np.random.default_rng(0).uniform(-1, 1, shape), np.zeros(shape), np.zeros(shape)
    click[encoder.packet_samples // 2] = 1.0
    packets = probe.encode(np.concatenate([noise, silence, click])) + probe.finish()
    longest = max(packets, key=policy.sent_bytes)
    min_bytes = policy.sent_bytes(longest + bytes(_SEQUENCE_GROWTH_BYTES))
    decoder = codec.make_decoder(encoder.configuration, signal_format.channels, model.tables if model else None)
    policy.begin(decoder, min_bytes, encoder.packet_samples / signal_format.rate_hz)
    return encoder


def rate_controlled_framing(bits_per_second: float, rate_hz: float, max_s: float = math.inf) -> Framing:
    """Return the framing for a rate: the shortest packets to which the wire adds at most 12 % at the full rate.

    `bits_per_second`: of all channels, frames included. `max_s`: longest packet that the target delay allows. Encoders
    round up to whole blocks. A refresh comes every 2 s, so a lost packet silences the actuator for 1 s on average.
    Refreshes cost some 0.15 dB (0.7 dB at one every 0.25 s; docs/explanation/decisions/streams.md).

    Raises TargetUnreachable for a rate whose packets would last longer than 2 s.
    """
    packet = b"\xff"
    while added_bytes(packet) > FRAMES_ADD * len(packet):
        packet += b"\xff"
    sent_bits = 8 * (len(packet) + added_bytes(packet))
    seconds = min(sent_bits / bits_per_second, max_s)
    if seconds > MAX_PACKET_S:
        raise TargetUnreachable(
            f"{bits_per_second:g} bit/s cannot be held over {MAX_PACKET_S:g} s: one packet with its frame takes "
            f"{seconds:.1f} s; choose {math.ceil(sent_bits / MAX_PACKET_S)} bit/s or more, or shorter packets"
        )
    return Framing(max(1, math.ceil(seconds * rate_hz)), max(1, round(REFRESH_S / seconds)))


def encode_rate_controlled(source: Source, setting: Setting, policy: RatePolicy, framing: Framing) -> Stream:
    """Code a signal in one pass, like a live stream, with a policy that controls the rate.

    Raises CodecError as `encode`, and for packets longer than MAX_PACKET_BYTES; TargetUnreachable as
    `rate_controlled_encoder`.
    """
    setting = source.resolved(setting)
    encoder = rate_controlled_encoder(source.codec, setting, source.format, framing, source.model, policy)
    coded = source.coded(setting, encoder)
    if (longest := max(map(len, coded.packets))) > MAX_PACKET_BYTES:
        raise CodecError(
            f"a packet of {longest} bytes, and a controller need not take more than {MAX_PACKET_BYTES}; choose shorter "
            "packets, or a lower rate or quality"
        )
    return coded


@dataclass(frozen=True)
class RateTarget:
    """A target for rate control: a constant rate; or a quality of every packet, up to a capped rate.

    `constant_rate_bps`, `capped_rate_bps`: of all channels, frames included. `snr_db`: the quality.
    """

    constant_rate_bps: float | None = None
    capped_rate_bps: float | None = None
    snr_db: float | None = None

    @property
    def rate_bps(self) -> float:
        """The rate that a stream does not exceed. Raises CodecError without one."""
        rate_bps = self.capped_rate_bps if self.constant_rate_bps is None else self.constant_rate_bps
        if rate_bps is None:
            raise CodecError("a rate is needed; give a constant rate, or a capped one")
        return rate_bps

    def policy(self, signal_format: SignalFormat) -> RatePolicy:
        """Return the policy, for one stream. Raises CodecError for an impossible target."""
        if self.constant_rate_bps is not None:
            return ConstantRate(self.constant_rate_bps)
        if self.snr_db is None:
            raise CodecError("a quality is needed; give an SNR")
        return CappedRate(self.snr_db, SnrMeter(signal_format.rate_hz), self.rate_bps)

    def framing(self, rate_hz: int) -> Framing:
        """Return how a stream of this sample rate is cut into packets: the shortest that the rate allows."""
        return rate_controlled_framing(self.rate_bps, rate_hz)


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


def outcome(stream: Stream, samples: Signal, rate_bps: float, policy: RatePolicy) -> Outcome:
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
