"""A decoder of `eva` written from docs/reference/bitstream.md: the synthesis in numpy, of whole signals at once."""

import numpy as np
from numpy.typing import NDArray

from tests.codec.reference_decoder import QuantiserOffset, RangeDecoder, bounded, suffix
from vibrocast.codec.eva_image import Convolution, EvaImage, IntegerNetwork, Normalisation

Columns = NDArray[np.int64]
"""Activations as (columns, channels)."""


def scaled(values: Columns, multipliers: NDArray[np.uint32], limit: int) -> Columns:
    """Products by 2^-32, to the nearest, half away from zero, limited."""
    magnitudes = (np.abs(values).astype(np.uint64) * multipliers.astype(np.uint64) + np.uint64(2**31)) >> np.uint64(32)
    return np.asarray(np.sign(values) * np.minimum(magnitudes, limit).astype(np.int64))


def integer_roots(values: Columns) -> Columns:
    """Square roots rounded down."""
    roots = np.floor(np.sqrt(values.astype(np.float64))).astype(np.int64)
    roots -= roots * roots > values
    return roots


def normalised(part: Normalisation, columns: Columns) -> Columns:
    """Inverse GDN."""
    doubled = np.zeros((len(columns), 1), dtype=np.int64)
    greatest = np.max(np.abs(columns), axis=1, keepdims=True, initial=0)
    while np.any(more := (greatest > 0) & (greatest << (doubled + 1) <= 32767)):
        doubled += more
    squares = (columns << doubled) ** 2 >> 15
    sums = squares @ part.weights.astype(np.int64).T
    energies = (sums.astype(np.uint64) * part.multipliers.astype(np.uint64)) >> (24 + 2 * doubled).astype(np.uint64)
    roots = integer_roots(np.minimum(energies + part.constants.astype(np.uint64), 2**30 - 1).astype(np.int64))
    rounded = (np.abs(columns) * roots + (1 << part.shift >> 1)) >> part.shift
    return np.asarray(np.sign(columns) * np.minimum(rounded, 32767))


def convolved(part: Convolution, columns: Columns, stride: int) -> Columns:
    """Transposed convolution by definition: each input column adds a scaled kernel, half of it before its own place."""
    kernel, outputs, _ = part.weights.shape
    reach = kernel // 2
    sums = np.zeros((stride * len(columns) + 2 * reach, outputs), dtype=np.int64)
    for tap, weights in enumerate(part.weights.astype(np.int64)):
        sums[tap : tap + stride * len(columns) : stride] += columns @ weights.T
    assert np.max(np.abs(sums), initial=0) < 2**31
    return sums[reach : reach + stride * len(columns)]


def synthesised(network: IntegerNetwork, latents: Columns, level: int) -> NDArray[np.int64]:
    """Samples (16 n,) of latents (n, latents); sample 16 t is at the middle of column t."""
    columns = latents
    for normalisation, convolution in zip(network.normalisations[:2], network.convolutions[:2], strict=True):
        columns = scaled(convolved(convolution, normalised(normalisation, columns), 2), convolution.multipliers, 32767)
    last = network.convolutions[2]
    sums = convolved(last, normalised(network.normalisations[2], columns), 4)
    values = scaled(sums, last.multipliers, 2**30)[:, 0] * level
    units = np.sign(values) * (np.abs(values) // 1024)
    return np.asarray(np.clip(np.sign(units) * ((np.abs(units) + 128) // 256), -32768, 32767))


class EvaReferenceDecoder:
    """Decodes the packets of a stream to levels, latents and samples."""

    def __init__(self, configuration: bytes, channels: int, payload: bytes) -> None:
        self.image = EvaImage.unpack(payload)
        head = 1 + (configuration[0] >> 7)
        self.columns = configuration[0] & 0x7F | (configuration[1] << 7 if head == 2 else 0)
        codes = np.frombuffer(configuration, "<u2", channels, head)
        self.rate_controlled = configuration[head + 2 * channels :] == b"\x01"
        self.levels = [(64 + int(code) % 64) << int(code) // 64 for code in codes]

    def latents(self, packets: list[bytes]) -> NDArray[np.int64]:
        """Latents (channels, columns of all packets, latents) in the model's unit."""
        return np.concatenate([self._packet(packet) for packet in packets], axis=1)

    def samples(self, packets: list[bytes]) -> NDArray[np.int64]:
        """Samples (all of the packets, channels), the decoder's delay in front."""
        assert self.image.network is not None
        signals = []
        for latents, level in zip(self.latents(packets), self.levels, strict=True):
            signal = synthesised(self.image.network, np.pad(latents, ((2, 0), (0, 0))), level)
            signals.append(signal[32 - 28 : 32 - 28 + 16 * len(latents)])
        return np.stack(signals, axis=1)

    def _packet(self, packet: bytes) -> NDArray[np.int64]:
        start = next(i for i, byte in enumerate(packet) if byte < 0x80) + 1
        if packet[0] & 1:
            self.probabilities = [self.image.probabilities.astype(int).tolist() for _ in self.levels]
            self.coded = [0 for _ in self.levels]
            self.quantiser_offset = QuantiserOffset()
        coder = RangeDecoder(packet[start:])
        if self.rate_controlled:
            self.quantiser_offset.decode(coder)
        codes = (64 * (6 + int(bits)) + 4 * self.quantiser_offset.value for bits in self.image.fraction_bits)
        steps = [(64 + code % 64) << code // 64 for code in (min(max(code, 0), 1535) for code in codes)]
        values = np.zeros((len(self.levels), self.columns, self.image.latents), dtype=np.int64)
        for channel, columns in enumerate(values):
            for column in columns:
                self._column(coder, channel, column)
        rounded = np.sign(values) * ((np.abs(values * np.array(steps)) + 2048) // 4096)
        return np.asarray(np.clip(rounded, -32767, 32767))

    def _column(self, coder: RangeDecoder, channel: int, column: NDArray[np.int64]) -> None:
        coded = self.coded[channel]
        shift = 3 if coded < 8 else 4 if coded < 24 else 5
        for k, probabilities in enumerate(self.probabilities[channel]):
            magnitude = 0
            while magnitude < 15 and self._decision(coder, probabilities, magnitude, shift):
                magnitude += 1
            if magnitude == 15:
                magnitude += suffix(coder)
            negative = magnitude > 0 and self._decision(coder, probabilities, 15, shift)
            column[k] = -magnitude if negative else magnitude
        self.coded[channel] += 1

    def _decision(self, coder: RangeDecoder, probabilities: list[int], decision: int, shift: int) -> bool:
        probability = probabilities[decision]
        bit = coder.decode(bounded(probability))
        if self.image.prior == "adaptive":
            probabilities[decision] += (65535 - probability) >> shift if bit else -(probability >> shift)
        return bool(bit)
