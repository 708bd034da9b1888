"""A decoder of `slp` written from docs/reference/bitstream.md alone; its filter and transform are in floating point."""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.codec.reference_decoder import QuantiserOffset, RangeDecoder, adapted, bounded, divide, fine_class
from vibrocast.codec import Signal

THRESHOLD = [
    round(
        256
        / 6.020599913
        * min(30.0, 62 * (math.log10(2 ** (4 + i / 8) / 550 + 300 / 550) / math.log10(300 / 550)) ** 2)
    )
    for i in range(57)
]


def lg(x: int) -> int:
    """Section "`slp`: steps": logarithm by straight lines."""
    if x == 0:
        return 0
    exponent = x.bit_length() - 1
    return 256 * exponent + ((x << 8 >> exponent) & 255)


def ex(y: int) -> int:
    y = min(max(y, 0), 26 * 256)
    return (256 + (y & 255)) << (y >> 8) >> 8


@dataclass
class Channel:
    """The state of a channel."""

    frame: int
    order: int
    last: list[int] = field(default_factory=list)
    average: list[int] = field(default_factory=list)
    silences: int = 0
    changed: int = 0
    reflections: list[int] = field(default_factory=list)
    state: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.last, self.average = [0] * (self.frame + 4), [0] * (self.frame + 4)
        self.reflections, self.state = [0] * self.order, [0.0] * (self.order + 1)


class Model:
    """Section "`slp`: probabilities"."""

    def __init__(self, bins: int) -> None:
        """`bins`: of a context each; 0 = contexts by neighbours."""
        starts = [x for x in range(20_000) if x == 0 or fine_class(x) != fine_class(x - 1)]
        expected = [starts[i] + starts[i + 1] for i in range(48)]
        self.level = [[65535 * e // (e + 128)] * 6 for e in expected]
        if bins:
            self.level = [[8192] * (288 // bins) for _ in range(bins)]
        self.frames = 0
        self.silent = [4096, 4096, 4096, 32768]
        self.changed = [8192, 8192]
        self.differs, self.sign, self.above = [32768] * 16, [32768] * 16, [32768] * 15


class SlpReferenceDecoder:
    """Section "`slp`"."""

    def __init__(self, configuration: bytes, channels: int) -> None:
        self.frame, self.order = 32 << (configuration[0] >> 5 & 3), configuration[0] & 31
        self.bins = self.frame if configuration[0] >> 7 else 0
        self.packet_frames = configuration[1] | configuration[2] << 8
        self.shaping, self.rate_code = configuration[3], configuration[4]
        self.step_codes = list(configuration[5 : 5 + channels])
        self.rate_controlled = configuration[5 + channels :] == b"\x01"
        self.quantiser_offset = QuantiserOffset()
        self.model = Model(self.bins)
        self.channels: list[Channel] = []

    def samples(self, packet: bytes) -> Signal:
        """Samples of one packet, in least significant bits, not rounded."""
        head = next(i for i, byte in enumerate(packet) if byte < 128) + 1
        if packet[0] & 1:
            self.model = Model(self.bins)
            self.quantiser_offset = QuantiserOffset()
            self.channels = [Channel(self.frame, self.order) for _ in self.step_codes]
        coder = RangeDecoder(packet[head:])
        if self.rate_controlled:
            self.quantiser_offset.decode(coder)
        frames = [
            [self._frame(coder, channel, code) for channel, code in zip(self.channels, self.step_codes, strict=True)]
            for _ in range(self.packet_frames)
        ]
        return np.array(frames).swapaxes(1, 2).reshape(-1, len(self.channels)) / 256

    def _decide(self, coder: RangeDecoder, probabilities: list[int], index: int, shift: int = 5) -> int:
        bit = coder.decode(bounded(probabilities[index]))
        probabilities[index] = adapted(probabilities[index], bit, shift)
        return bit

    def _frame(self, coder: RangeDecoder, channel: Channel, step_code: int) -> list[float]:
        silent = self._decide(coder, self.model.silent, channel.silences)
        channel.silences = (channel.silences << 1 | silent) & 3
        if not silent and self.order:
            channel.changed = self._decide(coder, self.model.changed, channel.changed)
            if channel.changed:
                channel.reflections = [self._reflection(coder, i, last) for i, last in enumerate(channel.reflections)]
        now = [0] * (self.frame + 4)
        levels = [0] * self.frame
        for k in range(self.frame if not silent else 0):
            levels[k] = self._level(coder, k if self.bins else self._context(channel, now, k + 2))
            now[k + 2] = min(abs(levels[k]), 126)
        self.model.frames += 1
        channel.last = now
        channel.average = [a - (a >> 3) + 32 * m for a, m in zip(channel.average, now, strict=True)]
        steps = self._steps(channel.reflections, step_code)
        return self._synthesised(channel, [level * step for level, step in zip(levels, steps, strict=True)])

    def _reflection(self, coder: RangeDecoder, i: int, last: int) -> int:
        if not self._decide(coder, self.model.differs, i):
            return last
        negative = self._decide(coder, self.model.sign, i)
        magnitude = 1
        while magnitude < 15 and self._decide(coder, self.model.above, magnitude):
            magnitude += 1
        return (last + (-magnitude if negative else magnitude) + 15) % 31 - 15

    def _context(self, channel: Channel, now: list[int], j: int) -> int:
        last, average = channel.last, channel.average
        expected = (
            14 * (now[j - 1] + now[j - 2])
            + 4 * (last[j - 1] + last[j] + last[j + 1] + last[j + 2])
            + (28 * (average[j - 1] + average[j] + average[j + 1]) >> 8)
        )
        return fine_class(expected >> 1)

    def _level(self, coder: RangeDecoder, context: int) -> int:
        magnitude, probabilities = 0, self.model.level[context]
        shift = 3 + (self.model.frames >= 8) + (self.model.frames >= 24) if self.bins else 5
        while magnitude < 15 and self._decide(coder, probabilities, min(magnitude, len(probabilities) - 1), shift):
            magnitude += 1
        if magnitude == 15:
            bits = 0
            while bits < 24 and coder.decode():
                bits += 1
            value = 1
            for _ in range(bits):
                value = value << 1 | coder.decode()
            magnitude += value - 1
        return -magnitude if magnitude and coder.decode() else magnitude

    def _direct(self, reflections: list[int]) -> list[int]:
        """A(z) in 1/2^16."""
        direct = [1 << 16]
        for code in reflections:
            value = round(2**24 * math.sin(math.pi * code / 32))
            longer = [*direct, 0]
            direct = [a + divide(value * b, 1 << 24) for a, b in zip(longer, longer[::-1], strict=True)]
        return direct

    def _steps(self, reflections: list[int], step_code: int) -> list[int]:
        direct = self._direct(reflections)
        steps = []
        for k in range(self.frame):
            angles = [2 * math.pi * (2 * k + 1) * (128 // self.frame) * i / 512 for i in range(len(direct))]
            real, imaginary = (
                divide(sum(a * round(2**24 * wave(x)) for a, x in zip(direct, angles, strict=True)), 1 << 28)
                for wave in (math.cos, math.sin)
            )
            frequency = lg(2 * k + 1) + 32 * self.rate_code - 512 - lg(self.frame)
            index = min(max(divide(frequency - 1024 + 16, 32), 0), 56)
            gain = lg(real**2 + imaginary**2) // 2 - 3072
            steps.append(
                ex(
                    768
                    + 32 * step_code
                    + 16 * self.quantiser_offset.value
                    + gain
                    + (self.shaping * THRESHOLD[index] >> 8)
                )
            )
        return steps

    def _synthesised(self, channel: Channel, spectrum: list[int]) -> list[float]:
        n = np.arange(self.frame)
        basis = np.cos(np.pi * (2 * n[:, None] + 1) * n[None, :] / (2 * self.frame)) * math.sqrt(2 / self.frame)
        basis[:, 0] /= math.sqrt(2)
        reflections = [math.sin(math.pi * code / 32) for code in channel.reflections]
        state = channel.state
        output = []
        for residual in basis @ np.clip(spectrum, -(2**30), 2**30):
            forward = float(residual)
            for i in reversed(range(self.order)):
                forward -= reflections[i] * state[i]
                state[i + 1] = (state[i] + reflections[i] * forward) * 255 / 256
            state[0] = forward * 255 / 256
            output.append(forward)
        return output
