"""Encoders whose packets end with their own last sample: input is gathered until it fills whole packets."""

from abc import ABC, abstractmethod

import numpy as np

from vibrocast.codec.interface import CodecError, Framing, Signal, check_channels, checked_parts

_CHUNK_SAMPLES = 1 << 16


class PacketwiseEncoder(ABC):
    """The part of codec.interface.Encoder that gathers; samples beyond full scale are clipped to it."""

    delay_samples = 0

    def __init__(self, channels: int, framing: Framing, block: int, max_blocks: int) -> None:
        """Gather into packets of whole blocks of `block` samples, at most `max_blocks` of them.

        Raises CodecError on a channel count or packet length outside what the codec has.
        """
        check_channels(channels)
        self._packet_blocks = -(-framing.packet_samples // block)
        if not 1 <= self._packet_blocks <= max_blocks:
            raise CodecError(f"packets of {framing.packet_samples} samples; 1 to {max_blocks * block} are allowed")
        self.packet_samples = self._packet_blocks * block
        self._channels = channels
        self._pending: Signal = np.zeros((0, channels))

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), return packets completed. Raises CodecError on NaN, infinity or a wrong shape."""
        packets: list[bytes] = []
        for part in checked_parts(samples, self._channels, _CHUNK_SAMPLES):
            packets += self._complete(part)
        return packets

    def finish(self) -> list[bytes]:
        """Pad with zeros and return the packet that remains, if samples do."""
        return self._complete(np.zeros((-len(self._pending) % self.packet_samples, self._channels)))

    def _complete(self, samples: Signal) -> list[bytes]:
        gathered = np.concatenate([self._pending, samples])
        whole, self._pending = np.split(gathered, [len(gathered) // self.packet_samples * self.packet_samples])
        return self._code_packets(whole) if len(whole) else []

    @abstractmethod
    def _code_packets(self, samples: Signal) -> list[bytes]:
        """Return the packets that samples (n, channels) fill to the last."""
