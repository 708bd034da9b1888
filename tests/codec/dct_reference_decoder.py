"""A decoder of `dct` written from docs/reference/bitstream.md alone, slow and in floating point."""

import itertools
import math
from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from tests.codec.reference_decoder import RangeDecoder, bounded


def magnitude(code: int) -> float:
    """A range code's magnitude in 1/256 of a least significant bit."""
    return float(min(round(2 ** (code / 256)), 2**28)) if code else 0.0


def interpolated(bottom: float, top: float, part: float) -> float:
    """The magnitude at a part of the way between two, by equal factors."""
    return float(bottom ** (1 - part) * top**part)


class Bits:
    """Bits from the highest of each byte on."""

    def __init__(self, data: bytes) -> None:
        self.bits: Iterator[int] = (byte >> shift & 1 for byte in data for shift in range(7, -1, -1))

    def read(self, count: int) -> int:
        value = 0
        for _ in range(count):
            value = value << 1 | next(self.bits, 0)
        return value


def huffman_values(bits: Bits) -> Callable[[], int]:
    """Read the table; return what reads a value."""
    lengths = [bits.read(4) for _ in range(bits.read(7) + 1)]
    codes = {}
    code = 0
    for length in range(1, 16):
        for symbol in (symbol for symbol, own in enumerate(lengths) if own == length):
            codes[length, code] = symbol
            code += 1
        code <<= 1

    def value() -> int:
        length = code = 0
        while (length, code) not in codes:
            length, code = length + 1, code << 1 | bits.read(1)
        symbol = codes[length, code]
        if symbol < 16:
            return symbol
        low_bits = symbol // 8 - 1
        return (8 + symbol % 8) << low_bits | bits.read(low_bits)

    return value


class RangeValues:
    """Sections "`dct`: range coding" to "`dct`: rank"."""

    def __init__(self, coder: RangeDecoder, first_pair: int, zeros: int) -> None:
        self.coder, self.first_pair, self.zeros = coder, first_pair, zeros
        self.probabilities: dict[tuple[int | str, ...], int] = {("zero", context): 32768 for context in range(8)}
        for context, decision in itertools.product(range(40), range(16)):
            e = (2 + context % 2) * 2 ** (context // 2)
            self.probabilities[context, decision] = 65536 * e // (e + 2 ** (4 + max(0, context // 2 - 5)))

    def even(self, count: int) -> int:
        value = 0
        for _ in range(count):
            value = value << 1 | self.coder.decode()
        return value

    def block(self, last: list[tuple[int, int]] | None, bins: int) -> tuple[list[tuple[int, int]], list[int]]:
        """Return the ranks, each with whether zero came instead, and the values of the next block."""
        now: list[tuple[int, int]] = []
        values: list[int] = []
        for k in range(bins):
            one, zero_one = now[k - 1] if k > 0 else (0, 0)
            two, zero_two = now[k - 2] if k > 1 else (one, 0)
            here, zero_here = last[k] if last else (0, 0)
            if last is None:
                expected = 5 * one + 3 * two
            else:
                above = last[k + 1][0] if k + 1 < bins else 0
                expected = 3 * one + two + (last[k - 1][0] if k > 0 else 0) + 2 * here + above
            if self.zeros and self.decision("zero", 4 * zero_here + 2 * zero_one + zero_two):
                now.append((expected // 8, 1))
                values.append(0)
                continue
            rank = self.rank(expected)
            now.append((rank, 0))
            value = rank if rank < self.first_pair else 2 * rank - self.first_pair + self.even(1)
            values.append(value + self.zeros)
        return now, values

    def rank(self, expected: int) -> int:
        octave = int(math.log2(expected + 1))
        context = 2 * octave + (octave > 0 and (expected + 1) >> (octave - 1) & 1)
        low_bits = max(0, octave - 5)
        quotient = 0
        while quotient < 16 and self.decision(context, quotient):
            quotient += 1
        if quotient == 16:
            ones = 0
            while ones < 24 and self.coder.decode():
                ones += 1
            quotient += 2**ones + self.even(ones) - 1
        return min(quotient, 65535 >> low_bits) << low_bits | self.even(low_bits)

    def decision(self, *context: int | str) -> int:
        probability = self.probabilities[context]
        bit = self.coder.decode(bounded(probability))
        self.probabilities[context] = probability + ((65535 - probability) >> 4 if bit else -(probability >> 4))
        return bit


class ReferenceDecoder:
    """Decodes packets to samples that are neither rounded nor limited."""

    def __init__(self, configuration: bytes, channels: int) -> None:
        self.channels = channels
        self.whole = configuration[0] & 7 == 7
        self.block = 64 << (configuration[0] & 7)
        self.logarithmic, self.range_coded = configuration[0] >> 3 & 1, configuration[0] >> 4 & 1
        numbers: list[int] = np.frombuffer(configuration[1:], dtype="<u2").tolist()
        self.blocks, self.own_levels, self.first, self.end, *self.smallest = numbers
        if self.whole:
            self.block, self.blocks = self.blocks, 1
        self.levels = self.own_levels

    def level(self, value: int, zeros: int, ranges: tuple[float, float], smallest: float) -> float:
        """Sections on the levels of `dct`."""
        if value < zeros:
            return 0.0
        below, above = ranges
        last = self.levels - 1
        centre = self.levels // 2
        step = (below + above) / (self.levels - 1)
        if not self.logarithmic:
            # Halves upwards, as no side is below zero.
            centre = math.floor(Fraction(below) * last / Fraction(below + above) + Fraction(1, 2))
            last = centre + math.floor(Fraction(above) * last / Fraction(below + above) + Fraction(1, 2))
        v = min(value - zeros, last)
        shorter = min(centre, last - centre)
        if v <= 2 * shorter:
            level = centre - (v + 1) // 2 if v % 2 else centre + v // 2
        else:
            level = v if last - centre > centre else last - v
        if not self.logarithmic:
            return max(-(2.0**28), min((level - centre) * step, 2.0**28))
        if level < centre:
            return -interpolated(min(smallest, below), below, (centre - 1 - level) / (centre - 1))
        return interpolated(min(smallest, above), above, (level - centre) / (last - centre))

    def samples(self, packet: bytes) -> NDArray[np.float64]:
        """Return (samples, channels) in least significant bits."""
        head = next(index for index, byte in enumerate(packet) if byte < 0x80) + 1
        if self.own_levels == 0:
            self.levels = 1 + round(3 * 2 ** (packet[head] / 16))
            head += 1
        start = head + 4 * self.channels
        codes = np.frombuffer(packet[head:start], dtype="<u2").reshape(-1, 2).tolist()
        payload = packet[start:]
        bits, coder = Bits(payload), RangeDecoder(payload)
        zeros = 0
        if self.logarithmic:
            zeros = coder.decode() if self.range_coded else bits.read(1)
        ranged = RangeValues(coder, 1 - self.logarithmic, zeros)
        huffman = huffman_values(bits) if any(map(any, codes)) and not self.range_coded else None
        output = np.zeros((self.blocks, self.block, self.channels))
        n, k = np.arange(self.block)[:, None], np.arange(self.end)[None, :]
        basis = np.cos(np.pi * (2 * n + 1) * k / (2 * self.block))
        basis[:, 0] = np.sqrt(1 / 2)
        if not self.whole:
            basis *= np.sqrt(2 / self.block)
        for channel, both in enumerate(codes):
            if not any(both):
                continue
            least = 1.0 if self.logarithmic else 0.0
            ranges = max(least, magnitude(both[0])), max(least, magnitude(both[1]))
            smallest = max(least, magnitude(self.smallest[channel])) if self.logarithmic else 0.0
            ranks: list[tuple[int, int]] | None = None
            for block in range(self.blocks):
                if huffman:
                    values = [huffman() for _ in range(self.first, self.end)]
                else:
                    ranks, values = ranged.block(ranks, self.end - self.first)
                spectrum = np.zeros(self.end)
                spectrum[self.first :] = [self.level(value, zeros, ranges, smallest) for value in values]
                output[block, :, channel] = basis @ spectrum / 256
        return output.reshape(-1, self.channels)
