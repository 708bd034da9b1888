"""Packets coded at several quantiser offsets before one is chosen, and their quality at the far end."""

import math
from collections.abc import Callable
from typing import Protocol, Self, cast

from vibrocast.codec.interface import CodecError, Decoder, Trial
from vibrocast.codec.quality_meters import QualityMeter

_FIRST_STRIDE = 2


class CopyableDecoder(Decoder, Protocol):
    """A decoder whose state can be copied, to test packets on the copy."""

    def copy(self) -> Self:
        """Return an independent decoder in the same state."""


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


class DecoderProbe:
    """Decodes the packets of one stream as the far end will; a meter measures their quality."""

    def __init__(self, meter: QualityMeter) -> None:
        self._meter = meter
        self._decoder: CopyableDecoder | None = None

    def begin(self, decoder: Decoder) -> None:
        """Begin with a decoder in the state of the far end. Raises CodecError if its state cannot be copied."""
        if not hasattr(decoder, "copy"):
            raise CodecError("this codec cannot hold a quality; ask for a constant rate, or choose another codec")
        self._decoder = cast(CopyableDecoder, decoder)

    def quality_db(self, attempts: Attempts, quantiser_offset: int) -> float:
        """Return the quality of the packet; infinity if it is too long to be coded."""
        packet = attempts.packet(quantiser_offset)
        if packet is None:
            return math.inf
        assert self._decoder is not None, "it has begun"
        return self._meter.quality_db(attempts.trial.samples, self._decoder.copy().decode(packet) / 32768)

    def coarsest_with(self, attempts: Attempts, quality_db: float) -> int:
        """Return the coarsest offset with the quality; the finest that can be coded if none has it."""
        worse = attempts.finest(lambda each: self.quality_db(attempts, each) < quality_db, attempts.trial.previous)
        quantiser_offset = (
            attempts.quantiser_offsets[-1] if worse is None else within(attempts.quantiser_offsets, worse - 1)
        )
        if attempts.packet(quantiser_offset) is not None:
            return quantiser_offset
        codable = attempts.finest(lambda each: attempts.packet(each) is not None, quantiser_offset)
        return attempts.quantiser_offsets[-1] if codable is None else codable

    def update(self, attempts: Attempts, quantiser_offset: int) -> None:
        """Decode the packet that was chosen."""
        assert self._decoder is not None, "it has begun"
        self._meter.update(attempts.trial.samples, self._decoder.decode(attempts.coded(quantiser_offset)) / 32768)
