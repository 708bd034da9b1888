"""Packets coded at several quantiser offsets before one is chosen: encoders offer them, policies compare them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self, cast

from vibrocast.codec.interface import CodecError, Decoder, Signal, Trial
from vibrocast.codec.quality_meters import QualityMeter

_FIRST_STRIDE = 2


@dataclass(frozen=True)
class PacketTrial:
    """A codec.interface.Trial. `code` codes the packet at a quantiser offset and leaves the encoder as it was."""

    samples: Signal
    quantiser_offsets: range
    previous: int
    code: Callable[[int], bytes]

    def packet(self, quantiser_offset: int) -> bytes:
        """Return the packet at one of the quantiser offsets. Raises CodecError for others, and if it is too long."""
        if quantiser_offset not in self.quantiser_offsets:
            raise CodecError(
                f"a quantiser offset of {quantiser_offset}; "
                f"choose {self.quantiser_offsets[0]} to {self.quantiser_offsets[-1]}"
            )
        return self.code(quantiser_offset)


class CopyableDecoder(Decoder, Protocol):
    """A decoder whose state can be copied, to test packets on the copy."""

    def copy(self) -> Self:
        """Return an independent decoder in the same state."""


class Attempts:
    """The packets of trials that are due together, coded at quantiser offsets that are common to all, each once."""

    def __init__(self, trials: Sequence[Trial], sent_bytes: Callable[[bytes], int]) -> None:
        self.trials = trials
        finest, coarsest = min(t.quantiser_offsets[0] for t in trials), max(t.quantiser_offsets[-1] for t in trials)
        self.quantiser_offsets = range(finest, coarsest + 1)
        self.previous = max(trial.previous for trial in trials)
        self._sent_bytes = sent_bytes
        self._packets: dict[int, list[bytes] | None] = {}

    def packets(self, quantiser_offset: int) -> list[bytes] | None:
        """Return each trial's packet at the quantiser offset, or the nearest; None if one would be too long."""
        if quantiser_offset not in self._packets:
            try:
                packets = [trial.packet(within(trial.quantiser_offsets, quantiser_offset)) for trial in self.trials]
            except CodecError:
                packets = None
            self._packets[quantiser_offset] = packets
        return self._packets[quantiser_offset]

    def coded(self, quantiser_offset: int) -> list[bytes]:
        """Return the packets at a quantiser offset. Raises CodecError if one would be too long."""
        return self.packets(quantiser_offset) or [
            trial.packet(within(trial.quantiser_offsets, quantiser_offset)) for trial in self.trials
        ]

    def size_bytes(self, quantiser_offset: int) -> float:
        """Return the bytes of all packets with their frames; infinity if one would be too long."""
        packets = self.packets(quantiser_offset)
        try:
            return math.inf if packets is None else sum(map(self._sent_bytes, packets))
        except CodecError:
            return math.inf  # no frame carries one of them

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
        """Return the quality of the first trial's packet; infinity if it is too long to be coded."""
        packets = attempts.packets(quantiser_offset)
        if packets is None:
            return math.inf
        assert self._decoder is not None, "it has begun"
        return self._meter.quality_db(attempts.trials[0].samples, self._decoder.copy().decode(packets[0]) / 32768)

    def coarsest_with(self, attempts: Attempts, quality_db: float) -> int:
        """Return the coarsest offset with the quality; the finest that can be coded if none has it."""
        worse = attempts.finest(lambda each: self.quality_db(attempts, each) < quality_db, attempts.previous)
        quantiser_offset = (
            attempts.quantiser_offsets[-1] if worse is None else within(attempts.quantiser_offsets, worse - 1)
        )
        if attempts.packets(quantiser_offset) is not None:
            return quantiser_offset
        codable = attempts.finest(lambda each: attempts.packets(each) is not None, quantiser_offset)
        return attempts.quantiser_offsets[-1] if codable is None else codable

    def update(self, attempts: Attempts, quantiser_offset: int) -> None:
        """Decode the packet that was chosen."""
        assert self._decoder is not None, "it has begun"
        self._meter.update(
            attempts.trials[0].samples, self._decoder.decode(attempts.coded(quantiser_offset)[0]) / 32768
        )
