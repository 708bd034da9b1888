"""Shared parts of codecs: an encoder that gathers input into packets, and the fade-out for a missing packet."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from vibrocast.codec.interface import (
    CodecError,
    Decoded,
    Framing,
    RateControl,
    Signal,
    Trial,
    check_channels,
    checked_parts,
)
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES

_CHUNK_SAMPLES = 1 << 16


class PacketwiseEncoder(ABC):
    """Base class of encoders: gathers input into packets, and clips samples to full scale."""

    delay_samples = 0
    _history = 0
    """Samples before a packet on which it also depends; zeros before the first."""
    _chunk_samples = _CHUNK_SAMPLES
    _rate_control: RateControl | None = None
    """Chooses the quantiser offset of each packet, one of `_quantiser_offsets`; None = always 0."""
    _quantiser_offsets = range(1)
    _quantiser_offset = 0
    """The last packet's."""

    def __init__(self, channels: int, framing: Framing, block: int, max_blocks: int) -> None:
        """Gather into packets of whole blocks of `block` samples, at most `max_blocks` of them.

        Raises CodecError for a channel count or packet length that the codec cannot have.
        """
        check_channels(channels)
        self._packet_blocks = -(-framing.packet_samples // block)
        if not 1 <= self._packet_blocks <= max_blocks:
            raise CodecError(
                f"packets of {framing.packet_samples} samples are not possible; give 1 to {max_blocks * block}"
            )
        self.packet_samples = self._packet_blocks * block
        self._channels = channels
        self._pending: Signal = np.zeros((self._history, channels))
        self._begun = False

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), return packets completed. Raises CodecError on NaN, infinity or a wrong shape."""
        packets: list[bytes] = []
        for part in checked_parts(samples, self._channels, self._chunk_samples):
            self._begun = True
            packets += self._complete(part)
        return packets

    def finish(self) -> list[bytes]:
        """Pad with zeros and return the remaining packets, so that every input sample can be decoded."""
        if not self._begun:
            return []
        self._begun = False
        left = len(self._pending) - self._history
        packets = -(-(left + self.delay_samples) // self.packet_samples)
        return self._complete(np.zeros((packets * self.packet_samples - left, self._channels)))

    def _complete(self, samples: Signal) -> list[bytes]:
        gathered = np.concatenate([self._pending, samples])
        taken = (len(gathered) - self._history) // self.packet_samples * self.packet_samples
        self._pending = gathered[taken:]
        return self._code_packets(gathered[: self._history + taken]) if taken else []

    def _chosen(
        self, samples: Signal, code: Callable[[int], bytes], attempt: Callable[[int], bytes] | None = None
    ) -> bytes:
        """Return the packet from `code` at the quantiser offset that the rate control chooses, padded as it chooses.

        `samples`: the input that the packet stands for. `attempt`: like `code`, but leaves the encoder's state as it
        is; None = `code` does so too. Raises CodecError for a choice that no packet can have.
        """
        if self._rate_control is None:
            return code(0)
        offsets = self._quantiser_offsets
        choice = self._rate_control(Trial(samples, offsets, self._quantiser_offset, attempt or code))
        if choice.quantiser_offset not in offsets or choice.min_bytes > MAX_PACKET_BYTES:
            raise CodecError(
                f"the rate control chose a quantiser offset of {choice.quantiser_offset} in {choice.min_bytes} bytes; "
                f"it must choose {offsets[0]} to {offsets[-1]}, in at most {MAX_PACKET_BYTES} bytes"
            )
        self._quantiser_offset = choice.quantiser_offset
        return code(choice.quantiser_offset).ljust(choice.min_bytes, b"\0")

    @abstractmethod
    def _code_packets(self, samples: Signal) -> list[bytes]:
        """Return the packets of samples (n, channels), which begin with the history and fill the last packet."""


def faded_backwards(last: Decoded, fade_samples: int) -> Decoded:
    """Return a substitute for a missing packet: the last one, backwards and faded out, then silence."""
    samples = np.zeros_like(last)
    fade = np.linspace(1, 0, min(fade_samples, len(last)))[:, None]
    samples[: len(fade)] = np.rint(last[::-1][: len(fade)] * fade)
    return samples
