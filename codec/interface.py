"""The small interface that every codec fills: an encoder and a decoder of packets, each with its own state."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Signal = NDArray[np.float64]
Decoded = NDArray[np.int16]


class CodecError(ValueError):
    """A signal, parameter, configuration or packet that the codec refuses; the message says why and what to do."""


@dataclass(frozen=True)
class Framing:
    """How a stream is cut into packets.

    `packet_samples`: samples per channel in each packet, rounded up to whole blocks. `refresh_packets`: packets
    from one refresh to the next, 0 when only the first packet is a refresh.
    """

    packet_samples: int
    refresh_packets: int


class Encoder(Protocol):
    """Turns normalised samples into packets of equal duration; keeps the state of one stream."""

    @property
    def configuration(self) -> bytes:
        """The bytes from which `Codec.decoder` makes a matching decoder; they go into the stream's header."""

    @property
    def packet_samples(self) -> int:
        """Samples per channel in every packet."""

    @property
    def delay_samples(self) -> int:
        """Samples per channel by which decoded signal lags the input; also the trailing input that `finish` adds."""

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), full scale = 1; return the packets that they complete.

        Raises CodecError on a wrong shape, NaN or infinity.
        """

    def finish(self) -> list[bytes]:
        """Pad the end with zeros and return the packets that remain, so that every sample given can be decoded."""


class Decoder(Protocol):
    """Turns packets into samples; keeps the state of one stream."""

    @property
    def channels(self) -> int:
        """Channels in the stream."""

    @property
    def packet_samples(self) -> int:
        """Samples per channel in every packet."""

    @property
    def delay_samples(self) -> int:
        """Samples per channel by which decoded signal lags the encoder's input."""

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet; return int16 samples (packet_samples, channels), 32768 = full scale.

        A packet that does not follow the one decoded last is not played until a refresh packet comes: the result
        fades to silence instead. Raises CodecError on a malformed packet, whose time `conceal` then fills.
        """

    def conceal(self) -> Decoded:
        """Stand in for one missing packet: same shape as `decode`, the last sound faded out, then silence."""


@dataclass(frozen=True)
class CodedSignal:
    """A whole coded signal: all that a container needs to store.

    `gains`: the physical value of full scale, one per channel, each a number of at most 8 significant bits.
    """

    codec: str
    rate_hz: int
    samples: int
    gains: tuple[float, ...]
    configuration: bytes
    packets: tuple[bytes, ...]

    @property
    def channels(self) -> int:
        """Channels in the signal."""
        return len(self.gains)
