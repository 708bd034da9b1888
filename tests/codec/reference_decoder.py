"""A decoder of `mdct` written from docs/reference/bitstream.md alone, slow."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

STRETCH = [round(256 * math.log((i + 0.5) / (2047.5 - i))) for i in range(2048)]
SQUASH = [round(65536 / (1 + math.exp(-(4 * i - 2046) / 256))) for i in range(1024)]
LEARNING = [round(65536 / (i + 1.6)) for i in range(256)]
COSINES = [round(2**24 * math.cos(2 * math.pi * i / 1024)) for i in range(1024)]
MARGIN = 3
"""Zeros before and behind the bins of a row."""
NEXT_STATE = ((0, 2), (2, 0), (1, 3), (3, 1))


def divide(numerator: int, denominator: int) -> int:
    """Integer division that rounds towards zero, as in C."""
    quotient = abs(numerator) // denominator
    return quotient if numerator >= 0 else -quotient


def clamp(value: int, limit: int) -> int:
    return max(-limit, min(limit, value))


def fine_class(x: int) -> int:
    if x < 4:
        return x
    exponent = x.bit_length() - 1
    return 4 * (exponent - 1) + ((x >> (exponent - 2)) & 3)


def log16(x: int) -> int:
    exponent = x.bit_length() - 1
    return 16 * exponent + ((x << 4 >> exponent) & 15)


def adapted(probability: int, bit: int, shift: int = 5) -> int:
    return probability + ((65535 - probability) >> shift) if bit else probability - (probability >> shift)


def bounded(probability: int) -> int:
    return max(32, min(65536 - 32, probability))


class RangeDecoder:
    """Section "Range coder"."""

    def __init__(self, data: bytes) -> None:
        self.data = iter(data)
        self.low, self.high, self.value = 0, 0xFFFFFFFF, 0
        for _ in range(4):
            self.value = self.value << 8 | next(self.data, 0)

    def decode(self, probability: int = 32768) -> int:
        split = self.low + ((self.high - self.low) * probability >> 16)
        bit = int(self.value <= split)
        if bit:
            self.high = split
        else:
            self.low = split + 1
        while self.low >> 24 == self.high >> 24:
            self.low = self.low << 8 & 0xFFFFFFFF
            self.high = self.high << 8 & 0xFFFFFFFF | 0xFF
            self.value = (self.value << 8 | next(self.data, 0)) & 0xFFFFFFFF
        return bit


@dataclass
class Contexts:
    """Section "`mdct`: contexts": what the decisions of a coefficient depend on."""

    quantiser: int
    weights: int
    cells: list[int]

    def centroid(self, level: int) -> tuple[int, int, int]:
        return self.quantiser, min(level, 3) - 1, min(self.cells[0] // 8, 15)


class Model:
    """Sections "`mdct`: adaptive model" and "`mdct`: tables"."""

    def __init__(self, tables: bytes) -> None:
        assert len(tables) == 5744
        cells = np.frombuffer(tables, np.int8, 4096).astype(np.int64).reshape(4, 2, 2, 256)
        self.cell = np.where(cells == -128, 32768, np.array(SQUASH)[512 + 4 * cells])
        self.count = np.where(cells == -128, 0, 30)
        self.weight = np.frombuffer(tables, "<i2", 768, 4096).astype(np.int64).reshape(4, 2, 48, 2)
        self.silence = [256 * value + 128 for value in tables[5632:5648]]
        self.centroid = np.frombuffer(tables, np.int8, 96, 5648).reshape(2, 3, 16)

    def decide(self, coder: RangeDecoder, contexts: Contexts, decision: int) -> int:
        kind, quantiser = min(decision, 3), contexts.quantiser
        weight = self.weight[kind, quantiser, contexts.weights]
        cells = [(kind, quantiser, i, context) for i, context in enumerate(contexts.cells)]
        inputs = [STRETCH[self.cell[cell] >> 5] for cell in cells]
        total = sum(int(w) * x for w, x in zip(weight, inputs, strict=True))
        mixed = SQUASH[max(0, min(1023, (total >> 16) + 512))]
        bit = coder.decode(bounded(mixed))
        error = 6 * (65536 * bit - mixed) >> 6
        for i, (cell, x) in enumerate(zip(cells, inputs, strict=True)):
            weight[i] = clamp(int(weight[i]) + ((error * x + 8192) >> 14), 32767)
            probability, rate = int(self.cell[cell]), LEARNING[self.count[cell]]
            change = (65535 - probability) * rate >> 16 if bit else -(probability * rate >> 16)
            self.cell[cell] = probability + change
            self.count[cell] = min(255, self.count[cell] + 1)
        return bit


@dataclass
class QuantiserOffset:
    """Section "Quantiser offset"."""

    value: int = 0
    same: int = 32768

    def decode(self, coder: RangeDecoder) -> None:
        same = coder.decode(bounded(self.same))
        self.same += (65535 - self.same) >> 2 if same else -(self.same >> 2)
        if not same:
            finer = coder.decode()
            change = 2 * suffix(coder) + coder.decode() + 1
            self.value = clamp(self.value + (-change if finer else change), 336)


@dataclass
class Channel:
    """Section "`mdct`: contexts": the state of a channel."""

    hop: int
    state: int = 0
    silent_history: int = 1
    block_sum: int = 0
    blocks: int = 0
    rows: list[list[int]] = field(default_factory=list)
    average: list[int] = field(default_factory=list)
    mean: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rows = [[0] * (self.hop + 2 * MARGIN) for _ in range(4)]
        self.average = [0] * (self.hop + 2 * MARGIN)
        self.mean = [0] * (self.hop + 2 * MARGIN)

    def next_block(self) -> None:
        self.block_sum = sum(self.rows[0])
        self.blocks = min(24, self.blocks + 1)
        for k in range(MARGIN, self.hop + MARGIN):
            self.average[k] += 32 * self.rows[0][k] - (self.average[k] >> 3)
            self.mean[k] += ((512 * self.rows[0][k] - self.mean[k]) * round(4096 / self.blocks) + 2048) >> 12
        self.rows = [[0] * (self.hop + 2 * MARGIN), *self.rows[:3]]

    def contexts(self, k: int) -> Contexts:
        now, last, second, third = self.rows
        j, average, mean = k + MARGIN, self.average, self.mean
        averages, means = average[j - 1] + average[j + 1], mean[j - 1] + mean[j + 1]
        below, below_mean = sum(now[:j]), sum(mean[:j])
        ratio = max(0, min(64, log16(below + 1) - log16(below_mean + 512) + 176))
        loudness = (195 * mean[j] + 30 * means) >> 9
        expected = (
            263 + 89 * last[j] + 94 * last[j + 1] + 15 * (last[j - 1] + last[j + 2] + last[j - 2])
            + 22 * second[j] + 7 * (second[j + 1] + second[j - 1]) + 9 * third[j]
            + ((56 * average[j] + 8 * averages) >> 9)
            + (((53 if self.blocks < 6 else 37) * mean[j] + 6 * means) >> 9)
            + 183 * now[j - 1] + 65 * now[j - 2] + 28 * now[j - 3]
            + (below * (40448 // (k + 1)) >> 9) + (loudness * round(16 * 2 ** (ratio / 16)) >> 6)
        )  # fmt: skip
        magnitude_class = min(63, fine_class(expected) - 28)
        mean_class = min(15, fine_class((2 * mean[j] + means) >> 7) // 2)
        ratio_class = sum(3 * ratio >= limit for limit in range(48, 145, 16))
        quarter = 4 * k // self.hop
        cells = [4 * magnitude_class + quarter, 16 * mean_class + 2 * ratio_class + (now[j - 1] > 0)]
        return Contexts(self.state >> 1, 4 * min(11, self.blocks) + quarter, cells)


def decode_block(coder: RangeDecoder, model: Model, channel: Channel, row: NDArray[np.int64]) -> None:
    """Section "`mdct`: payload": one block of a channel, reconstructed in 1/256 step."""
    loudness = sum(channel.block_sum > limit for limit in (0, 8, 32))
    context = channel.silent_history * 4 + loudness
    silent = coder.decode(bounded(model.silence[context]))
    model.silence[context] = adapted(model.silence[context], silent)
    channel.silent_history = (channel.silent_history * 2 + silent) & 3
    if silent:
        channel.state = 0
    for k in range(0 if silent else len(row)):
        contexts = channel.contexts(k)
        index = 0
        while index < 15 and model.decide(coder, contexts, index):
            index += 1
        if index == 15:
            index += suffix(coder)
        if index:
            level = 2 * index - contexts.quantiser
            magnitude = 256 * level + int(model.centroid[contexts.centroid(level)])
            row[k] = -magnitude if coder.decode() else magnitude
            channel.rows[0][k + MARGIN] = min(126, level)
        channel.state = NEXT_STATE[channel.state][index & 1]
    channel.next_block()


def suffix(coder: RangeDecoder) -> int:
    bits = 0
    while bits < 24 and coder.decode():
        bits += 1
    value = 1
    for _ in range(bits):
        value = value * 2 + coder.decode()
    return value - 1


def read_varint(packet: bytes) -> int:
    position = next(i for i, byte in enumerate(packet) if byte < 0x80)
    return sum((byte & 0x7F) << 7 * i for i, byte in enumerate(packet[: position + 1]))


def down(value: int) -> int:
    return (value + 2**23) >> 24


def turn(z: tuple[int, int], i: int) -> tuple[int, int]:
    c, s = COSINES[i], COSINES[(i + 768) % 1024]
    return down(z[0] * c + z[1] * s), down(z[1] * c - z[0] * s)


def cosine_transform(spectrum: list[int]) -> tuple[list[int], int]:
    """The numbers v and h of section "`mdct`: synthesis in integers"."""
    hop, count, h = len(spectrum), len(spectrum) // 2, 0
    while sum(map(abs, spectrum)) >> h > 2**30:
        h += 1
    x = [divide(each, 2**h) for each in spectrum]
    bits = count.bit_length() - 1
    z = [(0, 0)] * count
    for k in range(count):
        z[int(f"{k:0{bits}b}"[::-1], 2)] = turn((x[2 * k], x[hop - 1 - 2 * k]), (4 * k + 1) * 128 // hop)
    half = 1
    while half < count:
        for start in range(0, count, 2 * half):
            for n in range(start, start + half):
                a, b = z[n], turn(z[n + half], 512 * (n - start) // half)
                z[n], z[n + half] = (a[0] + b[0], a[1] + b[1]), (a[0] - b[0], a[1] - b[1])
        half *= 2
    v = [0] * hop
    for k in range(count):
        v[2 * k], minus = turn(z[k], 512 * k // hop)
        v[hop - 1 - 2 * k] = -minus
    return v, h


def synthesised(spectrum: list[int], overlap: list[int]) -> list[int]:
    """The next samples of a channel; `overlap` becomes that of the next block."""
    hop = len(spectrum)
    v, h = cosine_transform(spectrum)
    norm = round(2**24 * math.sqrt(2 / hop))
    window = [down(norm * COSINES[((2 * n + 1) * 128 // hop + 768) % 1024]) for n in range(hop)]
    sums = list(overlap)
    for n in range(hop // 2):
        m, first, second = hop - 1 - n, v[hop // 2 + n], -v[hop // 2 - 1 - n]
        sums[n] += clamp(down(first * window[n]) << h, 2**30)
        sums[m] -= clamp(down(first * window[m]) << h, 2**30)
        overlap[n] = clamp(down(second * window[m]) << h, 2**30)
        overlap[m] = clamp(down(second * window[n]) << h, 2**30)
    return [max(-32768, min(32767, int(math.copysign((abs(each) + 128) // 256, each)))) for each in sums]


class Rotation:
    """Section "`mdct`: rotation", in floating point."""

    def __init__(self, section: bytes, codes: list[int], hop: int) -> None:
        channels = len(codes)
        bits = iter("".join(f"{byte:08b}" for byte in section))

        def take(count: int) -> int:
            return int("".join(next(bits) for _ in range(count)), 2)

        def matrix() -> NDArray[np.float64]:
            product = np.eye(channels)
            for p in range(channels):
                for q in range(p + 1, channels):
                    angle = math.pi * take(6) / 64
                    c, s = math.cos(angle), math.sin(angle)
                    product[:, p], product[:, q] = (
                        product[:, p] * c - product[:, q] * s,
                        product[:, p] * s + product[:, q] * c,
                    )
            return product

        delays = [take(6) for _ in range(channels)]
        states = [take(2) for _ in range(4)]
        common = matrix() if 1 in states else np.eye(channels)
        steps = np.array([(64 + code % 64) * 2.0 ** (code // 64) for code in codes])
        self.matrices = [
            (common if state == 1 else matrix() if state == 2 else np.eye(channels)) * (steps / steps.min())[:, None]
            for state in states
        ]
        self.ends = [hop // 16, 3 * hop // 16, 7 * hop // 16, hop]
        self.lines = [np.zeros(delay) for delay in delays]

    def mixed(self, spectrum: NDArray[np.float64]) -> NDArray[np.float64]:
        output = np.empty_like(spectrum)
        start = 0
        for matrix, end in zip(self.matrices, self.ends, strict=True):
            output[:, start:end] = matrix @ spectrum[:, start:end]
            start = end
        return output

    def delayed(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        output = np.empty_like(samples)
        for channel, line in enumerate(self.lines):
            joined = np.concatenate([line, samples[:, channel]])
            output[:, channel] = joined[: len(samples)]
            self.lines[channel] = joined[len(samples) :]
        return output


class ReferenceDecoder:
    """Decodes packets to values in 1/256 step (blocks, channels, hop) and to samples by the exact transform."""

    def __init__(self, configuration: bytes, channels: int, tables: bytes) -> None:
        head, position = configuration[0], 1
        if head & 0x80:
            head, position = head & 0x7F | configuration[1] << 7, 2
        self.hop, self.blocks = 16 << (head & 3), head >> 3
        fields = np.frombuffer(configuration, "<u2", channels, position)
        self.codes = [int(code) % 2048 for code in fields]
        self.fills = [int(code) // 2048 for code in fields]
        position += 2 * channels
        self.shape = [0] * self.hop
        if head & 4:
            self.shape = self.coarser(int.from_bytes(configuration[position : position + 2], "little"))
            position += 2
        features, *section = configuration[position:] or b"\0"
        self.rate_controlled = bool(features & 1)
        self.rotation = Rotation(bytes(section), self.codes, self.hop) if features & 2 else None
        self.tables = tables
        self.channels = [Channel(self.hop) for _ in range(channels)]
        window = self.window()
        self.overlap = np.zeros((channels, len(window) - self.hop))
        self.halves = [[0] * self.hop for _ in range(channels)]
        n = np.arange(len(window))[None, :]
        k = np.arange(self.hop)[:, None]
        self.synthesis = (
            math.sqrt(2 / self.hop) * np.cos(np.pi / self.hop * (n + 0.5 + self.hop / 2) * (k + 0.5)) * window
        )

    def coarser(self, section: int) -> list[int]:
        """Section "`mdct`: step shape": step codes to add, by bin."""
        values = [14 * ((section >> 14) + 1) * (section >> 2 * node & 3) for node in range(7)]
        nodes = [0, 16, 32, 64, 128, 256, 512]
        found = []
        for k in range(self.hop):
            x = (2 * k + 1) * 256 // self.hop
            i = max(i for i in range(6) if nodes[i] <= x)
            low, high = nodes[i : i + 2]
            found.append((values[i] * (high - x) + values[i + 1] * (x - low)) // (high - low))
        return found

    def window(self) -> NDArray[np.float64]:
        return np.sin(np.pi * (np.arange(2 * self.hop) + 0.5) / (2 * self.hop))

    def values(self, packet: bytes) -> NDArray[np.int64]:
        position = next(i for i, byte in enumerate(packet) if byte < 0x80) + 1
        if packet[0] & 1:
            self.model = Model(self.tables)
            self.channels = [Channel(self.hop) for _ in self.channels]
            self.quantiser_offset = QuantiserOffset()
        coder = RangeDecoder(packet[position:])
        if self.rate_controlled:
            self.quantiser_offset.decode(coder)
        values = np.zeros((self.blocks, len(self.channels), self.hop), dtype=np.int64)
        self.silent = np.zeros(values.shape[:2], dtype=bool)
        for block, silent in zip(values, self.silent, strict=True):
            for number, channel in enumerate(self.channels):
                decode_block(coder, self.model, channel, block[number])
                silent[number] = channel.silent_history & 1
        return values

    def steps(self) -> NDArray[np.int64]:
        """Steps of the last packet in 1/256 LSB, (channels, hop)."""
        base = [min(self.codes)] * len(self.codes) if self.rotation else self.codes
        moved = [[code + 16 * self.quantiser_offset.value + more for more in self.shape] for code in base]
        codes = np.clip(np.array(moved, dtype=np.int64), 0, 1343)
        return 64 + codes % 64 << codes // 64

    def fill(self, spectra: NDArray[np.int64], steps: NDArray[np.int64], random: int) -> None:
        """Section "`mdct`: noise filling": puts a magnitude of random sign in place of zeros."""
        for block, channel in np.ndindex(spectra.shape[:2]):
            for k in np.flatnonzero(spectra[block, channel] == 0):
                magnitude = 0 if self.silent[block, channel] else int(steps[channel, k]) * self.fills[channel] // 128
                random = (random * 1664525 + 1013904223) % 2**32
                spectra[block, channel, k] = -magnitude if random >> 31 else magnitude

    def coefficients(self, packet: bytes) -> NDArray[np.int64]:
        """Spectra in 1/256 LSB, (blocks, channels, hop)."""
        values, steps = self.values(packet), self.steps()
        spectra = np.clip(np.sign(values) * (np.abs(values) * steps // 256), -(2**28), 2**28)
        self.fill(spectra, steps, read_varint(packet) >> 1)
        return spectra

    def integers(self, packet: bytes) -> NDArray[np.int64]:
        """Section "`mdct`: synthesis in integers": samples (packet_samples, channels) of a stream without rotation."""
        blocks = [
            [synthesised(spectrum.tolist(), overlap) for spectrum, overlap in zip(block, self.halves, strict=True)]
            for block in self.coefficients(packet)
        ]
        return np.array(blocks).swapaxes(1, 2).reshape(-1, len(self.channels))

    def samples(self, packet: bytes) -> NDArray[np.float64]:
        """Exact samples (packet_samples, channels), not rounded, 32768 = full scale."""
        spectra = self.coefficients(packet) / 256
        signal = np.zeros((self.blocks, self.hop, len(self.channels)))
        for block, spectrum in zip(signal, spectra, strict=True):
            added = (self.rotation.mixed(spectrum) if self.rotation else spectrum) @ self.synthesis
            added[:, : -self.hop] += self.overlap
            block[:] = added[:, : self.hop].T
            self.overlap = added[:, self.hop :]
        samples = signal.reshape(-1, len(self.channels))
        return self.rotation.delayed(samples) if self.rotation else samples
