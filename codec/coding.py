"""Whole signals to packets and back, at a given quantiser step, signal-to-noise ratio or bit rate."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from codec import mdct
from codec.interface import CodecError, CodedSignal, Decoded, Decoder, Encoder, Framing, Signal

SNR_TOLERANCE_DB = 0.2
RATE_TOLERANCE = 0.02
LIVE_PACKET_BLOCKS = 4
LIVE_REFRESH_S = 0.25
_FILE_PACKET_BLOCKS = 128
# Every packet fits into one frame of the wire protocol, so that a file can be played as it is.
_LARGEST_PACKET_BYTES = 4000
_CHUNK_SAMPLES = 1_000_000
_SMALLEST_STEP = 2.0**-18
_LARGEST_STEP = 2.0**6
_STEPS_PER_OCTAVE = 64
_MAX_GAIN = 2.0**127
_MIN_GAIN = 2.0**-120
_THRIFTS = (1.0, 0.9, 0.8, 0.65, 0.5, 0.3, 0.0)


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


def snr_db(reference: Signal, decoded: Signal) -> float | None:
    """Signal-to-noise ratio in dB of arrays (n, channels): the mean over the channels that are not silent.

    10 log10(sum x^2 / sum (x - y)^2) for each channel; None when every channel is silent, infinity when equal.
    """
    ratios = []
    for clean, noisy in zip(reference.T, decoded.T, strict=True):
        peak = np.max(np.abs(clean), initial=0.0)
        if peak > 0:
            noise = np.sum(np.square((clean - noisy) / peak))
            ratios.append(10 * math.log10(np.sum(np.square(clean / peak)) / noise) if noise > 0 else math.inf)
    return sum(ratios) / len(ratios) if ratios else None


def encode(
    samples: Signal,
    rate_hz: int,
    step: float,
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
) -> CodedSignal:
    """Code samples (n, channels) in any physical unit; `step`: quantiser step relative to each channel's RMS value.

    `live`: in short packets with regular refreshes, as for streaming; otherwise in the fewest bytes, as for a file.
    Raises CodecError on an empty signal, NaN, infinity, or a channel count or level that cannot be coded.
    """
    return _Source(samples, rate_hz, codec, live, tables).encode(step)


def encode_to_snr(
    samples: Signal,
    rate_hz: int,
    target_db: float,
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
) -> CodedSignal:
    """Code at `target_db` of SNR (as `snr_db`), to within 0.2 dB; above it where no step comes nearer.

    Raises CodecError as `encode`, and when `target_db` is out of reach, with the best that there is. A silent signal
    meets every target.
    """
    if not math.isfinite(target_db):
        raise CodecError(f"an SNR of {target_db} dB cannot be met; ask for a finite number")
    source = _Source(samples, rate_hz, codec, live, tables)
    if source.silent:
        return source.encode(1.0)

    def excess_db(coded: CodedSignal) -> float:
        measured = snr_db(source.samples, decode(coded))
        return (math.inf if measured is None else measured) - target_db

    found = _search(source, excess_db, SNR_TOLERANCE_DB, side=1)
    if isinstance(found, float):
        raise CodecError(
            f"an SNR of {target_db:g} dB cannot be met; this signal reaches {target_db + found:.1f} dB "
            "(16-bit samples set the limit)"
        )
    return found


def encode_to_rate(
    samples: Signal,
    rate_hz: int,
    bits_per_second: float,
    size_bytes: Callable[[CodedSignal], int],
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
) -> CodedSignal:
    """Code at `bits_per_second`, to within 2 %; below it where the signal has no step that comes nearer.

    `size_bytes` counts a coded signal's bytes. Raises CodecError as `encode`, and when `bits_per_second` is below the
    least that the signal takes, with that rate.
    """
    if not (math.isfinite(bits_per_second) and bits_per_second > 0):
        raise CodecError(f"a rate of {bits_per_second} bit/s cannot be met; ask for a positive number")
    source = _Source(samples, rate_hz, codec, live, tables)

    def excess(coded: CodedSignal) -> float:
        return size_bytes(coded) * 8 * rate_hz / (coded.samples * bits_per_second) - 1

    found = _search(source, excess, RATE_TOLERANCE, side=-1)
    if isinstance(found, float):
        raise CodecError(
            f"a rate of {bits_per_second:.0f} bit/s cannot be met; this signal takes at least "
            f"{bits_per_second * (1 + found):.0f} bit/s, most of it headers: ask for more, or code a longer signal"
        )
    return found


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


class _Source:
    """A signal ready to be coded at any step."""

    def __init__(self, samples: Signal, rate_hz: int, codec: str, live: bool, tables: bytes | None) -> None:
        if samples.ndim != 2 or samples.shape[1] < 1:
            raise CodecError(f"samples of shape {samples.shape}; (n, channels) is needed")
        if len(samples) == 0:
            raise CodecError("the signal is empty; there is nothing to code")
        if not np.all(np.isfinite(samples)):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        self.samples = samples
        self.rate_hz = rate_hz
        self.codec = codec_by_name(codec)
        self.tables = tables
        self.framing = live_framing(rate_hz) if live else file_framing(len(samples), rate_hz, samples.shape[1])
        self.gains = tuple(gain_for(float(np.max(np.abs(channel)))) for channel in samples.T)
        self.rms = tuple(
            math.sqrt(float(np.mean(np.square(channel / gain)))) or 1.0
            for channel, gain in zip(samples.T, self.gains, strict=True)
        )
        self.silent = not np.any(samples)

    def encode(self, step: float, thrift: float = 1.0) -> CodedSignal:
        if not (math.isfinite(step) and step > 0):
            raise CodecError(f"a quantiser step of {step} is not a positive number")
        steps = tuple(min(max(step * rms, _SMALLEST_STEP), _LARGEST_STEP) for rms in self.rms)
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
        for start in range(0, len(self.samples), _CHUNK_SAMPLES):
            packets += encoder.encode(self.samples[start : start + _CHUNK_SAMPLES] / np.array(self.gains))
        packets += encoder.finish()
        return CodedSignal(
            self.codec.name, self.rate_hz, len(self.samples), self.gains, encoder.configuration, tuple(packets)
        )


def _search(
    source: _Source, excess: Callable[[CodedSignal], float], tolerance: float, side: int
) -> CodedSignal | float:
    """Find the step whose `excess`, which on the whole falls as the step grows, is nearest zero.

    `side`: +1 when an excess above the tolerance is better than none, -1 when one below is. Returns the coded signal,
    or the excess nearest zero on the other side when no step is acceptable.
    """
    best: tuple[float, CodedSignal] | None = None
    refused = -side * math.inf
    # Rounding for the best rate makes the excess jump, most of all in signals of few coefficients, and the sign may
    # change in a jump: then other weights of bits against error, whose jumps lie elsewhere, are tried.
    for thrift in _THRIFTS:
        finest = round(_STEPS_PER_OCTAVE * math.log2(_SMALLEST_STEP))
        coarsest = round(_STEPS_PER_OCTAVE * math.log2(_LARGEST_STEP / min(source.rms)))
        while finest <= coarsest:
            middle = (finest + coarsest) // 2
            coded = source.encode(2 ** (middle / _STEPS_PER_OCTAVE), thrift)
            over = excess(coded)
            if side * over < -tolerance:
                refused = side * max(side * refused, side * over)
            elif best is None or abs(over) < best[0]:
                best = abs(over), coded
            if best is not None and best[0] <= tolerance / 2:
                return best[1]
            if over > 0:
                finest = middle + 1
            else:
                coarsest = middle - 1
        if best is None or best[0] <= tolerance:
            break
    return refused if best is None else best[1]
