"""Policies of rate control: a constant rate (leaky bucket), or a quality up to a rate.

A policy is a codec.interface.RateControl. It chooses the quantiser offset of each packet from all of that packet's
input, and no later input. `rate_controlled_encoder` joins a codec with a policy. docs/benchmarks/rate_control.md shows
the results.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from vibrocast.codec.interface import (
    Choice,
    Codec,
    CodecError,
    Decoder,
    Encoder,
    Framing,
    Model,
    Setting,
    SignalFormat,
    TargetUnreachable,
    Trial,
)
from vibrocast.codec.quality_meters import QualityMeter
from vibrocast.codec.trial import Attempts, DecoderProbe, within

DEFAULT_RATE_BUFFER_S = 0.018
"""Size of the rate buffer, as time at the rate: 1 % of 2 s, less a tenth, because packets seldom add up to just 2 s."""
FRAMES_ADD = 0.101
"""Most bytes that frames may add, relative to the packets in them. With the beginning and end of a stream of 5 s at 4
kbit/s, the wire then adds at most 12 %."""
MAX_PACKET_S = 2.0
"""Longest packet: a rate is held over any 2 s."""
REFRESH_S = 2.0
"""Time from one refresh to the next in a rate-controlled stream."""

FrameBytes: TypeAlias = Callable[[bytes], int]
"""Counts the bytes that a packet's frame adds to it. Raises CodecError for a packet that no frame carries."""

# A constant rate aims at the mean quality of the last _MEMORY_RATE_BUFFERS times of the rate buffer. It aims up to half
# of _SWING_DB higher as the rate buffer empties, and as much lower as it fills. If the rate buffer holds few packets,
# the swing is smaller, because it would overshoot.
_MEMORY_RATE_BUFFERS = 4.0
_SWING_DB = 4.0
_PACKETS_FOR_FULL_SWING = 4.0
_PROBE_PACKETS = 4
# A sequence number takes one byte at first, and four from packet 2^20 on.
_SEQUENCE_GROWTH_BYTES = 3


class RateBuffer:
    """The bytes sent and not yet drained at a constant rate, as in ITU-T H.264, C.1. Their number stays in 0 ... size.

    With fullness F, a packet of s bytes that lasts T seconds leaves F + s - R T / 8 at R bit/s. So over any run of
    packets, the bytes differ from R T / 8 by at most the size: R * rate_buffer_s / 8, and at least one byte. On a link
    of R bit/s no packet waits longer than rate_buffer_s.
    """

    def __init__(self, bits_per_second: float, rate_buffer_s: float, full: float) -> None:
        """Make a rate buffer, at first filled to the part `full`. Raises CodecError for an invalid rate or size."""
        if not (math.isfinite(rate_buffer_s) and rate_buffer_s > 0):
            raise CodecError(f"a rate buffer of {rate_buffer_s} s; give a positive time")
        self.bits_per_second = bits_per_second
        self.rate_buffer_s = rate_buffer_s
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
        return max(1.0, self.bits_per_second * self.rate_buffer_s / 8)

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

    _probe: DecoderProbe | None = None

    def __init__(self, rate_buffer: RateBuffer, frame_bytes: FrameBytes | int) -> None:
        """`frame_bytes`: bytes that the frame of a packet adds to it, or a function that counts them."""
        self.rate_buffer = rate_buffer
        self._frame_bytes = (lambda packet: frame_bytes) if isinstance(frame_bytes, int) else frame_bytes
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
        CodecError if the codec's packets cannot be measured, TargetUnreachable if they do not fit the rate.
        """
        if self._probe is not None:
            self._probe.begin(decoder)
        self._seconds = seconds
        self.min_bytes = min_bytes
        self.min_bits_per_second = 8 * min_bytes / seconds
        self._check_reach(self.bits_per_second)

    def sent_bytes(self, packet: bytes) -> int:
        """Return the bytes of a packet and its frame."""
        return len(packet) + self._frame_bytes(packet)

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

    _probe: DecoderProbe

    def __init__(
        self,
        quality_db: float,
        meter: QualityMeter,
        bits_per_second: float,
        frame_bytes: FrameBytes | int = 0,
        rate_buffer_s: float = DEFAULT_RATE_BUFFER_S,
    ) -> None:
        super().__init__(RateBuffer(bits_per_second, rate_buffer_s, full=0.0), frame_bytes)
        self.quality_db = quality_db
        self._probe = DecoderProbe(meter)

    def __call__(self, trial: Trial) -> Choice:
        """Choose the coarsest packet with the quality, or a coarser one that fits. Raises TargetUnreachable."""
        attempts = Attempts(trial, self.sent_bytes)
        quantiser_offset = self._probe.coarsest_with(attempts, self.quality_db)
        if attempts.size_bytes(quantiser_offset) > self.rate_buffer.max_bytes(self._seconds):
            quantiser_offset = self._finest_that_fits(attempts, quantiser_offset)
        self._probe.update(attempts, quantiser_offset)
        self.rate_buffer.fill(self.sent_bytes(attempts.coded(quantiser_offset)), self._seconds)
        self.rate_buffer.fullness_bytes = max(0.0, self.rate_buffer.fullness_bytes)
        return Choice(quantiser_offset)


class ConstantRate(RatePolicy):
    """A constant rate: no packet overfills the rate buffer, and padding keeps it from running dry.

    Between these limits, a meter makes the quality as even as the rate buffer allows. Each packet aims at the mean
    quality of those before it, and up to 2 dB higher or lower, as the rate buffer is emptier or fuller than half.
    Without a meter each packet aims at its share of the rate; the default rate buffer leaves no other choice.
    """

    def __init__(
        self,
        bits_per_second: float,
        frame_bytes: FrameBytes | int = 0,
        rate_buffer_s: float = DEFAULT_RATE_BUFFER_S,
        meter: QualityMeter | None = None,
    ) -> None:
        super().__init__(RateBuffer(bits_per_second, rate_buffer_s, full=0.5), frame_bytes)
        self._probe = None if meter is None else DecoderProbe(meter)
        self._mean_db, self._measured = 0.0, 0  # the mean quality, and the number of packets in it

    def __call__(self, trial: Trial) -> Choice:
        """Choose the packet's quantiser offset and padding. Raises TargetUnreachable if none fits."""
        attempts = Attempts(trial, self.sent_bytes)
        min_bytes, max_bytes = self.rate_buffer.min_bytes(self._seconds), self.rate_buffer.max_bytes(self._seconds)
        quantiser_offset = self._aim(attempts)
        if attempts.size_bytes(quantiser_offset) > max_bytes:
            quantiser_offset = self._finest_that_fits(attempts, quantiser_offset)
        elif attempts.size_bytes(quantiser_offset) < min_bytes:
            quantiser_offset = self._coarsest_that_fills(attempts, quantiser_offset, min_bytes, max_bytes)
        # A packet that needs padding does not show which quality the rate allows.
        if self._probe is not None:
            if attempts.size_bytes(quantiser_offset) >= min_bytes:
                self._remember(self._probe.quality_db(attempts, quantiser_offset))
            self._probe.update(attempts, quantiser_offset)
        packet = attempts.coded(quantiser_offset)
        padded = self._padded(packet, min_bytes, max_bytes)
        self.padding_bytes += len(padded) - len(packet)
        self.rate_buffer.fill(self.sent_bytes(padded), self._seconds)
        return Choice(quantiser_offset, len(padded))

    def _aim(self, attempts: Attempts) -> int:
        """Return the offset for the target quality or, if none is known, for the packet's share of the rate."""
        if self._probe is None or self._measured == 0:
            share_bytes = self.bits_per_second * self._seconds / 8
            aim = attempts.finest(lambda each: attempts.size_bytes(each) <= share_bytes, attempts.trial.previous)
            return attempts.quantiser_offsets[-1] if aim is None else aim
        swing_db = _SWING_DB * min(1.0, self.rate_buffer.rate_buffer_s / self._seconds / _PACKETS_FOR_FULL_SWING)
        return self._probe.coarsest_with(attempts, self._mean_db + swing_db * (0.5 - self.rate_buffer.full))

    def _coarsest_that_fills(self, attempts: Attempts, start: int, min_bytes: int, max_bytes: int) -> int:
        """Return the coarsest offset without padding or, if that does not fit, the one with the least padding."""
        short = attempts.finest(lambda each: attempts.size_bytes(each) < min_bytes, start)
        assert short is not None, "the packets at the aim are too short"
        finer = within(attempts.quantiser_offsets, short - 1)
        return finer if attempts.size_bytes(finer) <= max_bytes else short

    def _remember(self, quality_db: float) -> None:
        """Add a quality to the mean."""
        self._measured += 1
        kept = math.exp(-self._seconds / (_MEMORY_RATE_BUFFERS * self.rate_buffer.rate_buffer_s))
        self._mean_db += max(1 / self._measured, 1 - kept) * (quality_db - self._mean_db)

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


def equal_error(codec: Codec, signal_format: SignalFormat) -> Setting:
    """Return the part of a setting that gives all channels equal steps in their physical unit, and so an equal error.

    At one quantiser offset, bits then go to the channels that need them, and a channel below the error gets none:
    reverse water-filling (Cover and Thomas, Elements of Information Theory, 2nd ed., 10.3.3). The total error is the
    least for the rate. By default all channels have the same SNR. Raises CodecError for a codec whose steps do not
    differ by channel.
    """
    name = codec.step_parameter
    if name is None:
        raise CodecError(f"the steps of {codec.name} do not differ by channel; choose another codec for an equal error")
    physical = np.array(signal_format.rms) * np.array(signal_format.gains)
    steps = float(codec.parameters[name].default) * math.sqrt(np.mean(np.square(physical))) / physical
    return {name: tuple(map(float, steps))}


def timed_framing(packet_s: float, rate_hz: float) -> Framing:
    """Return the framing for packets of this duration in s, with a refresh every 2 s (REFRESH_S)."""
    return Framing(max(1, round(packet_s * rate_hz)), max(1, round(REFRESH_S / packet_s)))


def rate_controlled_framing(
    bits_per_second: float, rate_hz: float, frame_bytes: FrameBytes, max_s: float = math.inf
) -> Framing:
    """Return the framing for a rate: the shortest packets to which the wire adds at most 12 % at the full rate.

    `bits_per_second`: of all channels, frames included. `max_s`: longest packet that the target delay allows. Encoders
    round up to whole blocks. A refresh comes every 2 s, so a lost packet silences the actuator for 1 s on average.
    Refreshes cost some 0.15 dB (0.7 dB at one every 0.25 s; docs/benchmarks/rate_control.md). Raises TargetUnreachable
    for a rate whose packets would last longer than 2 s.
    """
    packet = b"\xff"
    while frame_bytes(packet) > FRAMES_ADD * len(packet):
        packet += b"\xff"
    sent_bits = 8 * (len(packet) + frame_bytes(packet))
    seconds = min(sent_bits / bits_per_second, max_s)
    if seconds > MAX_PACKET_S:
        raise TargetUnreachable(
            f"{bits_per_second:g} bit/s cannot be held over {MAX_PACKET_S:g} s: one packet with its frame takes "
            f"{seconds:.1f} s; choose {math.ceil(sent_bits / MAX_PACKET_S)} bit/s or more, or shorter packets"
        )
    return Framing(max(1, math.ceil(seconds * rate_hz)), max(1, round(REFRESH_S / seconds)))
