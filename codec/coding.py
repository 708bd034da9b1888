"""Whole signals to packets and back, at a given quantiser step, signal-to-noise ratio or bit rate."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

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
_PART_SAMPLES = 1 << 20
_BALANCING_TRIALS = 20
_STEP_BACK = 0.9
_DB_PER_OCTAVE = 20 * math.log10(2)
_SMALLEST_STEP = 2.0**-18
_LARGEST_STEP = 2.0**6
_STEPS_PER_OCTAVE = 64
_MAX_GAIN = 2.0**127
_MIN_GAIN = 2.0**-120
_THRIFTS = (1.0, 0.9, 0.8, 0.65, 0.5, 0.3, 0.0)

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


def channel_snrs_db(reference: Signal, decoded: Signal) -> list[float | None]:
    """Signal-to-noise ratio in dB of each channel of two arrays (n, channels): 10 log10(sum x^2 / sum (x - y)^2).

    None where the reference is silent, infinity where both are equal.
    """
    if reference.shape != decoded.shape:
        raise ValueError(f"a reference of shape {reference.shape}, decoded {decoded.shape}")
    peaks = [_peak(channel) for channel in reference.T]
    energy, noise = np.zeros(len(peaks)), np.zeros(len(peaks))
    scales = np.array([peak or 1.0 for peak in peaks])
    for part in _parts(len(reference)):
        energy += np.sum(np.square(reference[part] / scales), axis=0)
        noise += np.sum(np.square((reference[part] - decoded[part]) / scales), axis=0)
    return [
        (10 * math.log10(signal / error) if error > 0 else math.inf) if peak > 0 else None
        for peak, signal, error in zip(peaks, energy, noise, strict=True)
    ]


def snr_db(reference: Signal, decoded: Signal) -> float | None:
    """Return the mean of `channel_snrs_db` over the channels that are not silent; None when every channel is silent."""
    ratios = [ratio for ratio in channel_snrs_db(reference, decoded) if ratio is not None]
    return sum(ratios) / len(ratios) if ratios else None


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
    source = _Source(samples, rate_hz, codec, live, tables, progress)
    return source.encode([step] * len(source.gains))


def encode_to_snr(
    samples: Signal,
    rate_hz: int,
    target_db: float,
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
    progress: Progress | None = None,
) -> CodedSignal:
    """Code every channel at `target_db` of SNR, to within 0.2 dB; above it where no step comes nearer.

    Raises CodecError as `encode`, and when `target_db` is out of reach, with the best that there is. A silent signal
    meets every target.
    """
    if not math.isfinite(target_db):
        raise CodecError(f"an SNR of {target_db} dB cannot be met; ask for a finite number")
    source = _Source(samples, rate_hz, codec, live, tables, progress)
    channels = len(source.gains)
    if source.silent:
        return source.encode([1.0] * channels)

    def excesses_db(coded: CodedSignal) -> list[float]:
        """Excess of each channel over the target; 0 for silent ones, which have none."""
        ratios = channel_snrs_db(source.samples, decode(coded, tables))
        return [0.0 if ratio is None else ratio - target_db for ratio in ratios]

    def mean_excess(coded: CodedSignal) -> float:
        ratio = snr_db(source.samples, decode(coded, tables))
        return math.inf if ratio is None else ratio - target_db

    found = _search(source, mean_excess, SNR_TOLERANCE_DB, side=1)
    best, least = found.coded, excesses_db(found.coded)
    balanced = [_ChannelStep(found.step) for _ in least]
    excesses = least
    for trial in range(_BALANCING_TRIALS if channels > 1 else 0):
        if _imbalance(least) <= (False, SNR_TOLERANCE_DB / 2):
            break
        for channel, excess in zip(balanced, excesses, strict=True):
            if trial < _BALANCING_TRIALS // 2:
                channel.move(excess)
            elif excess < -SNR_TOLERANCE_DB:  # at the edge of a jump: leave it
                channel.step *= _STEP_BACK
        coded = source.encode([channel.step for channel in balanced], found.thrift)
        excesses = excesses_db(coded)
        if _imbalance(excesses) < _imbalance(least):
            best, least = coded, excesses
    if min(least) < -SNR_TOLERANCE_DB:
        raise CodecError(
            f"an SNR of {target_db:g} dB cannot be met; this signal reaches {target_db + min(least):.1f} dB "
            "(16-bit samples set the limit)"
        )
    return best


def _imbalance(excesses_db: list[float]) -> tuple[bool, float]:
    """Order by which the steps of channels are chosen: none below the tolerance first, then the smallest excess."""
    return min(excesses_db) < -SNR_TOLERANCE_DB, max(map(abs, excesses_db))


@dataclass
class _ChannelStep:
    """The step of one channel among several that each need their own: between what is enough and what is too coarse."""

    step: float
    enough: float = 0.0
    too_coarse: float = math.inf

    def move(self, excess_db: float) -> None:
        """Choose the next step to try, from the channel's excess over its target at this one: 6 dB an octave."""
        if excess_db >= 0:
            self.enough = max(self.enough, self.step)
        else:
            self.too_coarse = min(self.too_coarse, self.step)
        if self.enough >= self.too_coarse:  # the other channels have moved the limit: find it again
            self.enough, self.too_coarse = 0.0, math.inf
        if abs(excess_db) <= SNR_TOLERANCE_DB / 2:
            return
        wanted = self.step * 2 ** (excess_db / _DB_PER_OCTAVE)
        if not self.enough < wanted < self.too_coarse:
            bracketed = self.enough > 0 and math.isfinite(self.too_coarse)
            wanted = math.sqrt(self.enough * self.too_coarse) if bracketed else self.step / 2
        self.step = wanted


def encode_to_rate(
    samples: Signal,
    rate_hz: int,
    bits_per_second: float,
    size_bytes: Callable[[CodedSignal], int],
    *,
    codec: str = mdct.NAME,
    live: bool = False,
    tables: bytes | None = None,
    progress: Progress | None = None,
) -> CodedSignal:
    """Code at `bits_per_second`, to within 2 %; below it where no step comes nearer.

    `size_bytes` counts a coded signal's bytes. All channels have the same step relative to their RMS values. Raises
    CodecError as `encode`, and when `bits_per_second` is below the least that the signal takes, with that rate.
    """
    if not (math.isfinite(bits_per_second) and bits_per_second > 0):
        raise CodecError(f"a rate of {bits_per_second} bit/s cannot be met; ask for a positive number")
    source = _Source(samples, rate_hz, codec, live, tables, progress)

    def rate(coded: CodedSignal) -> float:
        return size_bytes(coded) * 8 * rate_hz / coded.samples

    def excess(coded: CodedSignal) -> float:
        return math.log(rate(coded)) - math.log(bits_per_second)

    found = _search(source, excess, math.log1p(RATE_TOLERANCE), side=-1)
    if found.excess > math.log1p(RATE_TOLERANCE):
        raise CodecError(
            f"a rate of {bits_per_second:.0f} bit/s cannot be met; this signal takes at least "
            f"{rate(found.coded):.0f} bit/s, most of it headers: ask for more, or code a longer signal"
        )
    return found.coded


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


def _parts(samples: int) -> Iterator[slice]:
    """Yield slices that cover a long signal, so that no work on it needs a copy of all of it."""
    for start in range(0, samples, _PART_SAMPLES):
        yield slice(start, start + _PART_SAMPLES)


def _peak(channel: Signal) -> float:
    return max(float(np.max(channel, initial=0.0)), -float(np.min(channel, initial=0.0)))


class _Source:
    """A signal ready to be coded at any step."""

    def __init__(
        self, samples: Signal, rate_hz: int, codec: str, live: bool, tables: bytes | None, progress: Progress | None
    ) -> None:
        if samples.ndim != 2 or samples.shape[1] < 1:
            raise CodecError(f"samples of shape {samples.shape}; (n, channels) is needed")
        if len(samples) == 0:
            raise CodecError("the signal is empty; there is nothing to code")
        if not all(np.all(np.isfinite(samples[part])) for part in _parts(len(samples))):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        self.samples = samples
        self.rate_hz = rate_hz
        self.codec = codec_by_name(codec)
        self.tables = tables
        self.progress = progress or (lambda part: None)
        self.framing = live_framing(rate_hz) if live else file_framing(len(samples), rate_hz, samples.shape[1])
        self.gains = tuple(gain_for(_peak(channel)) for channel in samples.T)
        energies = sum(np.sum(np.square(samples[part] / np.array(self.gains)), axis=0) for part in _parts(len(samples)))
        self.rms = [math.sqrt(energy / len(samples)) or 1.0 for energy in np.atleast_1d(energies)]
        self.silent = not np.any(energies)
        self._trials = 0

    def encode(self, relative_steps: list[float], thrift: float = 1.0) -> CodedSignal:
        """Code with a step for each channel, relative to its RMS value; in shorter packets where they grow too long."""
        steps = tuple(
            min(max(step * rms, _SMALLEST_STEP), _LARGEST_STEP)
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
        for part in _parts(len(self.samples)):
            packets += encoder.encode(self.samples[part] / np.array(self.gains))
            # How many trials a search takes is not known before: each is given half of what is left of the bar.
            within = min(part.stop, len(self.samples)) / len(self.samples)
            self.progress(1 - 0.5**self._trials * (1 - within / 2))
        self._trials += 1
        packets += encoder.finish()
        return CodedSignal(
            self.codec.name, self.rate_hz, len(self.samples), self.gains, encoder.configuration, tuple(packets)
        )


@dataclass(frozen=True)
class _Found:
    """What a search found: the coded signal, its excess, and the step and thrift that made it."""

    coded: CodedSignal
    excess: float
    step: float
    thrift: float


def _search(source: _Source, excess: Callable[[CodedSignal], float], tolerance: float, side: int) -> _Found:
    """Find the step, the same for all channels, whose `excess` is nearest zero; on the whole it falls with the step.

    `side`: +1 when an excess above the tolerance is better than none, -1 when one below is. What is found lies beyond
    the tolerance on the other side only where every step does.
    """
    best: _Found | None = None

    def preference(found: _Found) -> tuple[bool, float]:
        return side * found.excess < -tolerance, abs(found.excess)

    # Rounding for the best rate makes the excess jump, most of all in signals of few coefficients, and the sign may
    # change in a jump: then other weights of bits against error, whose jumps lie elsewhere, are tried.
    for thrift in _THRIFTS:
        finest = round(_STEPS_PER_OCTAVE * math.log2(_SMALLEST_STEP))
        coarsest = round(_STEPS_PER_OCTAVE * math.log2(_LARGEST_STEP / min(source.rms)))
        above = below = math.nan  # excess beside the finest and the coarsest step that are left
        interpolates = False
        while finest <= coarsest:
            width = coarsest - finest
            exponent = (finest + coarsest) // 2
            if interpolates:
                exponent = finest + round(width * min(max(above / (above - below), 0.0), 1.0))
            step = 2 ** (exponent / _STEPS_PER_OCTAVE)
            coded = source.encode([step] * len(source.gains), thrift)
            found = _Found(coded, excess(coded), step, thrift)
            if best is None or preference(found) < preference(best):
                best = found
            if abs(best.excess) <= tolerance / 2:
                return best
            if found.excess > 0:
                finest, above = exponent + 1, found.excess
            else:
                coarsest, below = exponent - 1, found.excess
            # Straight lines lead there soon, unless one end stays where it is: then halve.
            halved = 2 * (coarsest - finest) <= width
            interpolates = halved and math.isfinite(above - below)
        if best is not None and (abs(best.excess) <= tolerance or side * best.excess < -tolerance):
            break
    assert best is not None, "there is a step to try"
    return best
