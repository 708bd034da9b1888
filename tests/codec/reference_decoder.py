"""A decoder of `mdct` written from docs/reference/bitstream.md alone, slow and in floating point where it may be."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

STRETCH = [round(256 * math.log((i + 0.5) / (2047.5 - i))) for i in range(2048)]
SQUASH = [round(65536 / (1 + math.exp(-(4 * i - 2046) / 256))) for i in range(1024)]
NEXT_STATE = ((0, 2), (2, 0), (1, 3), (3, 1))


def divide(numerator: int, denominator: int) -> int:
    """Integer division that rounds towards zero, as in C."""
    quotient = abs(numerator) // denominator
    return quotient if numerator >= 0 else -quotient


def clamp(value: int, limit: int) -> int:
    return max(-limit, min(limit, value))


def squash(stretched: int) -> int:
    return SQUASH[(clamp(stretched, 2047) + 2048) >> 2]


def fine_class(x: int) -> int:
    if x < 4:
        return x
    exponent = x.bit_length() - 1
    return 4 * (exponent - 1) + ((x >> (exponent - 2)) & 3)


def coarse_class(x: int) -> int:
    return min(15, fine_class(x) // 2)


def adapted(probability: int, bit: int) -> int:
    return probability + ((65535 - probability) >> 5) if bit else probability - (probability >> 5)


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


class Network:
    """Section "`mdct`: network"."""

    def __init__(self, payload: bytes) -> None:
        self.layers, position = [], 0
        for outputs, inputs in ((32, 29), (24, 32), (6, 24), (6, 24)):
            weights = np.frombuffer(payload, np.int8, outputs * inputs, position).reshape(outputs, inputs)
            biases = np.frombuffer(payload, "<i2", outputs, position + outputs * inputs)
            self.layers.append((weights.astype(np.int64), biases.astype(np.int64)))
            position += outputs * (inputs + 2)
        assert position == len(payload)

    def logits(self, inputs: list[int], quantiser: int) -> list[int]:
        values = np.array(inputs)
        for layer, (divisor, least) in ((0, (4, 0)), (1, (64, 0)), (2 + quantiser, (64, -32767))):
            weights, biases = self.layers[layer]
            values = np.clip(np.trunc(weights @ values / divisor).astype(np.int64) + biases, least, 32767)
        return [clamp(int(value), 2047) for value in values]


class Model:
    """Section "`mdct`: adaptive model"."""

    def __init__(self, payload: bytes) -> None:
        tables, network = payload[:12784], payload[12784:]
        self.network = Network(network) if network else None
        signed = np.frombuffer(tables, dtype=np.int8)
        cells = 6 * 2 * 4 * 256
        self.cell = np.array([squash(16 * int(value)) for value in signed[:cells]]).reshape(6, 2, 4, 256)
        weights = np.frombuffer(tables[cells : cells + 480], dtype="<i2")
        in_tables = np.array([clamp(16 * int(value), 8 << 16) for value in weights]).reshape(6, 2, 4, 5)
        self.weight = np.insert(in_tables, 4, 65536, axis=-1)
        self.silence = [256 * value + 128 for value in tables[cells + 480 :]]

    def logits(self, contexts: list[int], magnitudes: list[int], others: list[int], quantiser: int) -> list[int]:
        if self.network is None:
            return [0] * 6
        cells = self.cell[:2, quantiser]
        stretched = [STRETCH[cells[kind, i, contexts[i]] >> 5] for kind in range(2) for i in range(4)]
        inputs = [fine_class(x) for x in magnitudes] + others + [divide(x, 16) for x in stretched]
        return self.network.logits(inputs, quantiser)

    def decide(
        self, coder: RangeDecoder, contexts: list[int], logits: list[int], scale: int, decision: int, quantiser: int
    ) -> int:
        kind = min(decision, 5)
        weight = self.weight[kind, quantiser, scale]
        cells = self.cell[kind, quantiser]
        inputs = [STRETCH[cells[i, contexts[i]] >> 5] for i in range(4)] + [logits[kind], 256]
        mixed = squash(divide(sum(int(w) * x for w, x in zip(weight, inputs, strict=True)), 65536))
        bit = coder.decode(bounded(mixed))
        error = 6 * (65536 * bit - mixed)
        for i, x in enumerate(inputs):
            weight[i] = clamp(int(weight[i]) + divide(error * x, 1 << 18), 8 << 16)
        for i in range(4):
            cells[i, contexts[i]] = adapted(int(cells[i, contexts[i]]), bit)
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
        self.rows = [[0] * (self.hop + 4) for _ in range(4)]
        self.average = [0] * (self.hop + 4)
        self.mean = [0] * (self.hop + 4)

    def next_block(self) -> None:
        self.block_sum = sum(self.rows[0])
        self.blocks = min(24, self.blocks + 1)
        for k in range(2, self.hop + 2):
            self.average[k] += 32 * self.rows[0][k] - (self.average[k] >> 3)
            weighted = self.mean[k] * (self.blocks - 1) + 512 * self.rows[0][k]
            self.mean[k] = (weighted + self.blocks // 2) // self.blocks
        self.rows = [[0] * (self.hop + 4), *self.rows[:3]]

    def contexts(self, k: int, block_sum: int) -> tuple[list[int], int]:
        now, last, second, third = self.rows
        j, average = k + 2, self.average
        expected = (
            28 * now[j - 1] + 8 * now[j - 2] + 21 * last[j] + 18 * last[j + 1] + 6 * last[j - 1] + 2 * last[j + 2]
            + 12 * second[j] + 3 * second[j + 1] + 3 * third[j] + (26 * average[j] >> 8) + 20
        ) >> 1  # fmt: skip
        fine, band = fine_class(expected), k * 16 // self.hop
        around = 2 * now[j - 1] + now[j - 2] + 2 * last[j] + last[j + 1] + last[j - 1]
        indices = [
            min(63, fine) * 4 + k * 4 // self.hop,
            min(15, fine // 2) * 16 + band,
            coarse_class(16 * block_sum // (k + 1)) * 16 + coarse_class((average[j] + average[j + 1]) >> 3),
            coarse_class((average[j - 1] + 2 * average[j] + average[j + 1]) >> 4) * 16 + band,
        ]
        return indices, coarse_class(4 * around) // 4

    def network_inputs(self, k: int, block_sum: int) -> tuple[list[int], list[int]]:
        """The magnitudes whose logarithm is an input, and the other inputs but for the cells."""
        now, last, second, third = self.rows
        j, mean = k + 2, self.mean
        below = [now[j - 1], now[j - 2], now[j - 3] if k > 2 else 0]
        eighths = [8 * x for x in [*below, *last[j - 2 : j + 3], *second[j - 1 : j + 2], third[j]]]
        eighths += [x // 64 for x in mean[j - 1 : j + 2]]
        eighths += [8 * block_sum // (k + 1), sum(mean[2:j]) // (64 * (k + 1)), sum(mean) // (64 * self.hop)]
        return eighths, [64 * k // self.hop, self.blocks, self.hop // 4]


def decode_block(coder: RangeDecoder, model: Model, channel: Channel, row: NDArray[np.int64]) -> None:
    """Section "`mdct`: payload": one block of a channel."""
    loudness = sum(channel.block_sum > limit for limit in (0, 8, 32))
    context = channel.silent_history * 4 + loudness
    silent = coder.decode(bounded(model.silence[context]))
    model.silence[context] = adapted(model.silence[context], silent)
    channel.silent_history = (channel.silent_history * 2 + silent) & 3
    if silent:
        channel.state = 0
    block_sum = 0
    for k in range(0 if silent else len(row)):
        quantiser = channel.state >> 1
        contexts, scale = channel.contexts(k, block_sum)
        logits = model.logits(contexts, *channel.network_inputs(k, block_sum), quantiser)
        index = 0
        while index < 15 and model.decide(coder, contexts, logits, scale, index, quantiser):
            index += 1
        if index == 15:
            index += suffix(coder)
        level = 2 * index - quantiser if index else 0
        row[k] = -level if index and coder.decode() else level
        channel.state = NEXT_STATE[channel.state][index & 1]
        channel.rows[0][k + 2] = min(126, level)
        block_sum += min(126, level)
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
    """Decodes packets to signed levels (blocks, channels, hop) and to samples by the exact transform."""

    def __init__(self, configuration: bytes, channels: int, tables: bytes) -> None:
        head, position = configuration[0], 1
        if head & 0x80:
            head, position = head & 0x7F | configuration[1] << 7, 2
        self.hop, self.blocks = 16 << (head & 3), head >> 2
        fields = np.frombuffer(configuration, "<u2", channels, position)
        self.codes = [int(code) % 2048 for code in fields]
        self.fills = [int(code) // 2048 for code in fields]
        features, *sections = configuration[position + 2 * channels :] or b"\0"
        self.rate_controlled = bool(features & 1)
        self.shape = self.coarser(bytes(sections[-4:])) if features & 4 else [0] * self.hop
        section = bytes(sections[:-4] if features & 4 else sections)
        self.rotation = Rotation(section, self.codes, self.hop) if features & 2 else None
        self.tables = tables
        self.channels = [Channel(self.hop) for _ in range(channels)]
        window = self.window()
        self.overlap = np.zeros((channels, len(window) - self.hop))
        n = np.arange(len(window))[None, :]
        k = np.arange(self.hop)[:, None]
        self.synthesis = (
            math.sqrt(2 / self.hop) * np.cos(np.pi / self.hop * (n + 0.5 + self.hop / 2) * (k + 0.5)) * window
        )

    def coarser(self, section: bytes) -> list[int]:
        """Section "`mdct`: step shape": step codes to add, by bin."""
        unit, *units = [nibble for byte in section for nibble in (byte & 15, byte >> 4)]
        values = [4 * unit * each for each in units]
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

    def levels(self, packet: bytes) -> NDArray[np.int64]:
        position = next(i for i, byte in enumerate(packet) if byte < 0x80) + 1
        if packet[0] & 1:
            self.model = Model(self.tables)
            self.channels = [Channel(self.hop) for _ in self.channels]
            self.quantiser_offset = QuantiserOffset()
        coder = RangeDecoder(packet[position:])
        if self.rate_controlled:
            self.quantiser_offset.decode(coder)
        levels = np.zeros((self.blocks, len(self.channels), self.hop), dtype=np.int64)
        self.silent = np.zeros(levels.shape[:2], dtype=bool)
        for block, silent in zip(levels, self.silent, strict=True):
            for number, channel in enumerate(self.channels):
                decode_block(coder, self.model, channel, block[number])
                silent[number] = channel.silent_history & 1
        return levels

    def steps(self) -> NDArray[np.float64]:
        """Steps of the last packet, (channels, hop)."""
        base = [min(self.codes)] * len(self.codes) if self.rotation else self.codes
        moved = [[code + 16 * self.quantiser_offset.value + more for more in self.shape] for code in base]
        codes = np.clip(np.array(moved), 0, 1343)
        return np.array((64 + codes % 64) * 2.0 ** (codes // 64) / 256)

    def fill(
        self, levels: NDArray[np.int64], spectra: NDArray[np.float64], steps: NDArray[np.float64], random: int
    ) -> None:
        """Section "`mdct`: noise filling": puts a magnitude of random sign in place of zeros."""
        fills = [
            [int(256 * step * fill / 128) / 256 for step in row] for row, fill in zip(steps, self.fills, strict=True)
        ]
        for block, channel in np.ndindex(levels.shape[:2]):
            for k in np.flatnonzero(levels[block, channel] == 0):
                magnitude = 0.0 if self.silent[block, channel] else fills[channel][k]
                random = (random * 1664525 + 1013904223) % 2**32
                spectra[block, channel, k] = -magnitude if random >> 31 else magnitude

    def samples(self, packet: bytes) -> NDArray[np.float64]:
        """Exact samples (packet_samples, channels), not rounded, 32768 = full scale."""
        levels = self.levels(packet)
        steps = self.steps()
        spectra = levels * steps
        self.fill(levels, spectra, steps, read_varint(packet) >> 1)
        signal = np.zeros((self.blocks, self.hop, len(self.channels)))
        for block, spectrum in zip(signal, spectra, strict=True):
            added = (self.rotation.mixed(spectrum) if self.rotation else spectrum) @ self.synthesis
            added[:, : -self.hop] += self.overlap
            block[:] = added[:, : self.hop].T
            self.overlap = added[:, self.hop :]
        samples = signal.reshape(-1, len(self.channels))
        return self.rotation.delayed(samples) if self.rotation else samples


class LappedReferenceDecoder(ReferenceDecoder):
    """Section "`lapped`"."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes) -> None:
        self.windows = np.frombuffer(payload[:960], "<i2") / 32768
        super().__init__(configuration, channels, payload[960:])

    def window(self) -> NDArray[np.float64]:
        half = self.windows[2 * (self.hop - 16) :][: 2 * self.hop]
        return np.concatenate([half, half[::-1]])
