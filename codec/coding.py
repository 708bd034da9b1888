"""The codecs by name, and whole signals to packets and back at a given quantiser step."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from codec import mdct
from codec.interface import CodecError, CodedSignal, Decoded, Decoder, Encoder, Framing, Signal

LIVE_PACKET_BLOCKS = 4
LIVE_REFRESH_S = 0.25
_FILE_PACKET_BLOCKS = 128
# Every packet fits into one frame of the wire protocol, so that a file can be played as it is.
_LARGEST_PACKET_BYTES = 4000
_PART_SAMPLES = 1 << 20
SMALLEST_STEP = 2.0**-18
LARGEST_STEP = 2.0**6
_MAX_GAIN = 2.0**127
_MIN_GAIN = 2.0**-120

Progress: TypeAlias = Callable[[float], None]


@dataclass(frozen=True)
class Codec:
    """A codec by its name and by its number in stream headers, with the makers of its encoder and decoder.

    `make_encoder(steps, rate_hz, framing, tables, thrift)`: one quantiser step per channel, relative to full scale;
    `thrift` from 0 to 1 weighs bits against error in rounding.
    `make_decoder(configuration, channels, tables)`. `tables`: payload of a model image, None = built in.
    """

    name: str
    identifier: int
    make_encoder: Callable[[tuple[float, ...], int, Framing, bytes | None, float], Encoder]
    make_decoder: Callable[[bytes, int, bytes | None], Decoder]


CODECS: Mapping[str, Codec] = {
    mdct.NAME: Codec(mdct.NAME, mdct.IDENTIFIER, mdct.MdctEncoder, mdct.MdctDecoder),
}


def codec_by_name(name: str) -> Codec:
    """Return the codec of that name. Raises CodecError when there is none."""
    if name not in CODECS:
        raise CodecError(f"there is no codec {name!r}; choose one of {', '.join(sorted(CODECS))}")
    return CODECS[name]


def codec_by_identifier(identifier: int) -> Codec:
    """Return the codec of that number in stream headers. Raises CodecError when there is none."""
    for codec in CODECS.values():
        if codec.identifier == identifier:
            return codec
    raise CodecError(f"the stream needs codec number {identifier}, which this version does not have")


def decoder(identifier: int, configuration: bytes, channels: int, tables: bytes | None = None) -> Decoder:
    """Make the decoder of a stream from its header's fields. Raises CodecError when they do not fit a codec."""
    return codec_by_identifier(identifier).make_decoder(configuration, channels, tables)


def live_framing(rate_hz: int) -> Framing:
    """Return the framing for streaming: packets of 4 blocks, a refresh at least every 0.25 s."""
    packet_samples = LIVE_PACKET_BLOCKS * mdct.hop_samples(rate_hz)
    return Framing(packet_samples, max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples)))


def file_framing(samples: int, rate_hz: int, channels: int) -> Framing:
    """Return the framing for a file: one refresh at the start, packets of at most 128 blocks over all channels."""
    hop = mdct.hop_samples(rate_hz)
    needed = -(-samples // hop) + 1
    return Framing(min(needed, max(1, _FILE_PACKET_BLOCKS // channels)) * hop, 0)


def gain_for(peak: float) -> float:
    """Return the smallest number of 8 significant bits that is not below `peak`; 1 for silence.

    Raises CodecError outside 2^-120 to 2^127.
    """
    if peak == 0:
        return 1.0
    if not _MIN_GAIN <= peak <= _MAX_GAIN:
        raise CodecError(f"the signal's peak {peak:g} is outside {_MIN_GAIN:.0e} to {_MAX_GAIN:.0e}; use another unit")
    mantissa, exponent = math.frexp(peak)
    return math.ldexp(math.ceil(mantissa * 256), exponent - 8)


def encode(
    samples: Signal,
    rate_hz: int,
    step: float,
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
    progress: Progress | None = None,
) -> CodedSignal:
    """Code samples (n, channels) in any physical unit; `step`: quantiser step relative to each channel's RMS value.

    `live`: in short packets with regular refreshes, as for streaming; otherwise in the fewest bytes, as for a file.
    `progress` is called with the part done, from 0 to 1. Raises CodecError on an empty signal, NaN, infinity, or a
    channel count or level that cannot be coded.
    """
    if not (math.isfinite(step) and step > 0):
        raise CodecError(f"a quantiser step of {step} is not a positive number")
    source = Source(samples, rate_hz, codec, live, tables, progress)
    return source.encode([step] * len(source.gains))


def decode_integers(coded: CodedSignal, tables: bytes | None = None) -> Decoded:
    """Decode every packet: int16 (packets * packet_samples, channels), the codec's delay still in front.

    Raises CodecError on a malformed packet or configuration.
    """
    state = codec_by_name(coded.codec).make_decoder(coded.configuration, coded.channels, tables)
    decoded = np.empty((len(coded.packets) * state.packet_samples, coded.channels), dtype=np.int16)
    for index, packet in enumerate(coded.packets):
        decoded[index * state.packet_samples : (index + 1) * state.packet_samples] = state.decode(packet)
    return decoded


def decode(coded: CodedSignal, tables: bytes | None = None) -> Signal:
    """Decode to float64 (samples, channels) in the physical unit, the codec's delay removed.

    Raises CodecError on a malformed packet or configuration, and when packets are missing at the end.
    """
    state = codec_by_name(coded.codec).make_decoder(coded.configuration, coded.channels, tables)
    end = state.delay_samples + coded.samples
    held = len(coded.packets) * state.packet_samples
    if coded.samples and held < end:
        raise CodecError(f"the stream is cut short: it holds {held} of {end} samples; copy the file again")
    integers = decode_integers(coded, tables)[state.delay_samples : end]
    return integers * (np.array(coded.gains) / 32768)


def parts(samples: int) -> Iterator[slice]:
    """Yield slices that cover a long signal, so that no work on it needs a copy of all of it."""
    for start in range(0, samples, _PART_SAMPLES):
        yield slice(start, start + _PART_SAMPLES)


def peak_of(channel: Signal) -> float:
    return max(float(np.max(channel, initial=0.0)), -float(np.min(channel, initial=0.0)))


class Source:
    """A signal ready to be coded at any step.

    `gains`: the physical value of full scale of each channel. `rms`: its RMS value relative to that, 1 for silence.
    `silent`: every channel is.
    """

    def __init__(
        self, samples: Signal, rate_hz: int, codec: str, live: bool, tables: bytes | None, progress: Progress | None
    ) -> None:
        if samples.ndim != 2 or samples.shape[1] < 1:
            raise CodecError(f"samples of shape {samples.shape}; (n, channels) is needed")
        if len(samples) == 0:
            raise CodecError("the signal is empty; there is nothing to code")
        if not all(np.all(np.isfinite(samples[part])) for part in parts(len(samples))):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        self.samples = samples
        self.rate_hz = rate_hz
        self.codec = codec_by_name(codec)
        self.tables = tables
        self.progress = progress or (lambda part: None)
        self.framing = live_framing(rate_hz) if live else file_framing(len(samples), rate_hz, samples.shape[1])
        self.gains = tuple(gain_for(peak_of(channel)) for channel in samples.T)
        energies = sum(np.sum(np.square(samples[part] / np.array(self.gains)), axis=0) for part in parts(len(samples)))
        self.rms = [math.sqrt(energy / len(samples)) or 1.0 for energy in np.atleast_1d(energies)]
        self.silent = not np.any(energies)
        self._trials = 0

    def encode(self, relative_steps: list[float], thrift: float = 1.0) -> CodedSignal:
        """Code with a step for each channel, relative to its RMS value; in shorter packets where they grow too long."""
        steps = tuple(
            min(max(step * rms, SMALLEST_STEP), LARGEST_STEP)
            for step, rms in zip(relative_steps, self.rms, strict=True)
        )
        framing = self.framing
        while True:
            coded = self._encode(steps, framing, thrift)
            shorter = Framing(framing.packet_samples // 2, 2 * framing.refresh_packets)
            fits = max(map(len, coded.packets)) <= _LARGEST_PACKET_BYTES
            if fits or shorter.packet_samples < mdct.hop_samples(self.rate_hz):
                return coded
            framing = shorter

    def _encode(self, steps: tuple[float, ...], framing: Framing, thrift: float) -> CodedSignal:
        encoder = self.codec.make_encoder(steps, self.rate_hz, framing, self.tables, thrift)
        packets: list[bytes] = []
        for part in parts(len(self.samples)):
            packets += encoder.encode(self.samples[part] / np.array(self.gains))
            # How many trials a search takes is not known before: each is given half of what is left of the bar.
            within = min(part.stop, len(self.samples)) / len(self.samples)
            self.progress(1 - 0.5**self._trials * (1 - within / 2))
        self._trials += 1
        packets += encoder.finish()
        return CodedSignal(
            self.codec.name, self.rate_hz, len(self.samples), self.gains, encoder.configuration, tuple(packets)
        )
