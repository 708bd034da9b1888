"""A decoder of `parametric` written from docs/reference/bitstream.md alone; its synthesis is in floating point."""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.codec.reference_decoder import RangeDecoder, bounded, divide
from vibrocast.codec import Signal


@dataclass
class Channel:
    """The state of a channel."""

    silent: bool = False
    last: list[int] | None = None
    pitch: int | None = None
    harmonics: list[int] = field(default_factory=list)
    phase: int = 0
    turn: int = 0
    amplitudes: Signal = field(default_factory=lambda: np.zeros(8))
    overlap: Signal = field(default_factory=lambda: np.zeros(0))


class Numbers:
    """Sections "`parametric`: numbers" and "`parametric`: probabilities"."""

    def __init__(self, coder: RangeDecoder, model: dict[tuple[object, ...], int]) -> None:
        self.coder, self.model, self.context = coder, model, 0

    def decide(self, *name: object, start: int = 32768) -> int:
        probability = self.model.setdefault(name, start)
        bit = self.coder.decode(bounded(probability))
        self.model[name] = probability + ((65535 - probability) >> 4) if bit else probability - (probability >> 4)
        return bit

    def number(self, kind: int, expected: int, least: int, greatest: int) -> int:
        magnitude = 0
        while magnitude < 12 and self.decide("above", kind, self.context, magnitude):
            magnitude += 1
        if magnitude == 12:
            ones = 0
            while ones < 24 and self.coder.decode():
                ones += 1
            magnitude += 2**ones - 1 + self.bits(ones)
        negative = magnitude > 0 and self.decide("sign", kind)
        self.context = min(magnitude, 2)
        difference = min(magnitude, 1024)
        return min(max(expected + (-difference if negative else difference), least), greatest)

    def bits(self, count: int) -> int:
        value = 0
        for _ in range(count):
            value = 2 * value + self.coder.decode()
        return value


class ParametricReferenceDecoder:
    """Section "`parametric`"."""

    def __init__(self, configuration: bytes, channels: int) -> None:
        shape, ridges, interval = configuration[:3]
        self.hop, width, self.level_bits = 16 << (shape & 3), shape >> 2 & 3, shape >> 4
        self.harmonics, self.blocks, self.interval = ridges & 15, 1 << (ridges >> 4), 1 << interval
        self.packet_frames = configuration[3] | configuration[4] << 8
        self.edges = [0]
        while self.edges[-1] < self.hop:
            edge = self.edges[-1] + max(1, self.edges[-1] >> width)
            self.edges.append(self.hop if edge > self.hop or 2 * (self.hop - edge) < edge >> width else edge)
        self.top = 21 << self.level_bits
        self.channels = [Channel(overlap=np.zeros(self.hop)) for _ in range(channels)]
        self.model: dict[tuple[object, ...], int] = {}

    def samples(self, packet: bytes) -> Signal:
        """Samples of one packet, in least significant bits, not rounded."""
        length = next(i for i, byte in enumerate(packet) if byte < 128) + 1
        head = sum((byte & 127) << 7 * i for i, byte in enumerate(packet[:length]))
        refresh, self.random = head & 1, head >> 1
        if refresh:
            self.model = {}
            for channel in self.channels:
                channel.silent, channel.last, channel.pitch = False, None, None
        coder = RangeDecoder(packet[length:])
        frames = [
            np.stack(
                [self.frame(coder, channel, bool(refresh) and number == 0) for channel in self.channels],
                axis=1,
            )
            for number in range(self.packet_frames)
        ]
        return np.concatenate(frames)

    def frame(self, coder: RangeDecoder, channel: Channel, coded_phase: bool) -> Signal:
        numbers = Numbers(coder, self.model)
        bands, times = [0] * (len(self.edges) - 1), [0] * (self.blocks // self.interval)
        harmonics, pitch = [0] * 8, None
        channel.silent = bool(numbers.decide("silent", channel.silent, start=8192))
        if not channel.silent:
            self.bands(numbers, channel.last, bands)
            for i in range(len(times) if len(times) > 1 else 0):
                times[i] = numbers.number(0, divide(times[i - 1], 2) if i else 0, -self.top, self.top)
            if self.harmonics and numbers.decide("ridges", channel.pitch is not None):
                pitch = self.ridges(numbers, channel, coded_phase, harmonics)
            channel.last, channel.harmonics = bands, harmonics
        channel.pitch = pitch
        return np.concatenate(
            [self.block(channel, bands, harmonics, times[block // self.interval]) for block in range(self.blocks)]
        )

    def bands(self, numbers: Numbers, last: list[int] | None, bands: list[int]) -> None:
        for b in range(len(bands)):
            if last is None:
                bands[b] = numbers.number(1, bands[b - 1] if b else 12 << self.level_bits, 0, self.top)
            else:
                change = divide(bands[b - 1] - last[b - 1], 2) if b else 0
                bands[b] = numbers.number(2, last[b] + change, 0, self.top)

    def ridges(self, numbers: Numbers, channel: Channel, coded_phase: bool, harmonics: list[int]) -> int:
        pitch = numbers.bits(9) if channel.pitch is None else numbers.number(3, channel.pitch, 0, 511)
        channel.turn = (64 + pitch % 64) << (pitch // 64 + 16)
        if coded_phase:
            channel.phase = numbers.bits(8) << 24
        elif channel.pitch is None:
            channel.phase = 0
        for i in range(self.harmonics):
            if (i + 1) * channel.turn < 2**31:
                before = harmonics[i - 1] if i else 12 << self.level_bits
                harmonics[i] = (
                    numbers.number(4, before, 0, self.top)
                    if channel.pitch is None
                    else numbers.number(5, channel.harmonics[i], 0, self.top)
                )
        return pitch

    def amplitude(self, level: int, time: int) -> int:
        code = (min(level + time, self.top) - 1) << (6 - self.level_bits)
        return (64 + code % 64) << (code // 64) if level > 0 and level + time > 0 else 0

    def block(self, channel: Channel, bands: list[int], harmonics: list[int], time: int) -> Signal:
        spectrum = np.zeros(self.hop)
        for b, level in enumerate(bands):
            for k in range(self.edges[b], self.edges[b + 1]):
                self.random = (1664525 * self.random + 1013904223) % 2**32
                spectrum[k] = self.amplitude(level, time) * (-1 if self.random >> 31 else 1)
        n, bins = np.arange(2 * self.hop)[:, None], np.arange(self.hop)
        window: Signal = math.sqrt(2 / self.hop) * np.sin(math.pi * (n[:, 0] + 0.5) / (2 * self.hop))
        wave: Signal = window * (np.cos(math.pi / self.hop * (n + 0.5 + self.hop / 2) * (bins + 0.5)) @ spectrum)
        output: Signal = channel.overlap + wave[: self.hop]
        channel.overlap = wave[self.hop :]
        samples = np.arange(self.hop)
        phases = channel.phase + samples * channel.turn
        for i in range(8):
            target = self.amplitude(harmonics[i], time)
            rise = divide(target - int(channel.amplitudes[i]), self.hop)
            angles = ((i + 1) * phases + (i + 1) ** 2 * 2**28) % 2**32 >> 22
            output += (channel.amplitudes[i] + samples * rise) * np.cos(2 * math.pi * angles / 1024)
            channel.amplitudes[i] = target
        channel.phase = (channel.phase + self.hop * channel.turn) % 2**32
        clipped: Signal = np.clip(output / 256, -32768, 32767)
        return clipped
