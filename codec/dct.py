"""The codec `dct`: DCT of blocks or of a whole file, quantised linearly or logarithmically, after a paper on textures.

A block of N samples x[n] becomes the orthonormal DCT-II C[k] = s_k sum x[n] cos(pi (2n + 1) k / (2N)), s_0 = sqrt(1/N),
s_k = sqrt(2/N). Its index k stands for the frequency F = k rate / (2N). For a hand that sweeps at the speed v over the
length D of the block, F is v k / (2D): half the spacing v / D of a discrete Fourier transform.

The paper's |C_k| is an amplitude of displacement. Here it is |C[k]| sqrt(2/N), the amplitude of a cosine that fits the
block. Blocks do not overlap. A whole file is one transform, whose coefficients are coded as these amplitudes.
docs/reference/bitstream.md has the layout, docs/reference/codecs.md the choices.
"""

import heapq
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.core import (
    UNIT,
    CoreDecoder,
    CoreState,
    PacketwiseEncoder,
    damaged_packet,
    does_not_fit,
    faded_backwards,
)
from vibrocast.codec.interface import (
    AUTO,
    WHOLE,
    Codec,
    CodecError,
    Decoded,
    Decoder,
    Framing,
    Model,
    Parameter,
    RateControl,
    RatePoints,
    Setting,
    Signal,
    SignalFormat,
    check_channels,
    number,
    word,
)
from vibrocast.codec.threshold import DETECTION_THRESHOLD, read_threshold, threshold_amplitude
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES, PROFILE_UNIT
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.firmware.native_core import ffi, library

NAME = "dct"
IDENTIFIER = 2
BLOCKS = (64, 128, 256, 512, 1024)
WHOLE_SAMPLES = 20_000
"""N of the source paper: 10 mm at 0.5 um. A longer file is cut into equal transforms, as near to this as possible."""
WHOLE_M = 0.01
"""D of the source paper: the same for a file over position."""
MAX_COEFFICIENTS = 1024
"""Most coefficients coded of one transform: as many as the core's adaptive model holds."""
MAX_PACKET_BLOCKS = 4095
MAX_PACKET_SAMPLES = 2**18
MAX_LEVELS = 65_535
LEVEL_CODES = 231
"""Numbers of levels that a packet of a rate-controlled stream can state."""
HEIGHT_LIMIT_HZ = 400.0
"""The source paper drops higher frequencies: its display does not reach them, and fingers feel little of them."""
MIN_HEIGHT_UM = 0.05
"""S of the source paper."""
MIN_OF_RMS = 0.05
"""S in other units, relative to the RMS value of a coefficient. 0.1 gains 1 dB at 14 levels, but ends at 25 dB."""

MAX_CODE = 15

_RANGE_CODES_PER_OCTAVE = 256
_LEVEL_CODES_PER_OCTAVE = 16
# Quantiser offsets beyond 4 levels cut small coefficients. The first cuts from 36 dB below the greatest magnitude, the
# last cuts all.
_CUTTING_QUANTISER_OFFSETS = 6 * _LEVEL_CODES_PER_OCTAVE + 1
_FIRST_CLASS = 16
_WHOLE_CODE = 7
_LOGARITHMIC = 0x08
_RANGE_CODED = 0x10
_LINEAR = 0x20
_FADE_SAMPLES = 64


def range_code(magnitude: float) -> int:
    """Return the code of the lowest power of 2^(1/256) not below a magnitude in the core's unit; 0 below one half."""
    if magnitude < 0.5:
        return 0
    return min(max(math.ceil(_RANGE_CODES_PER_OCTAVE * math.log2(magnitude)), 1), 65_535)


def level_code(levels: int) -> int:
    """Return the code of the number of levels nearest `levels`: 16 codes for each factor of two in the steps' size."""
    return min(round(_LEVEL_CODES_PER_OCTAVE * math.log2((levels - 1) / 3)), LEVEL_CODES - 1)


def symbols_of(values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the symbol of each coded value, and how many of the value's low bits follow its code.

    Each value below 16 has its own symbol. Above, a symbol is one of eight classes an octave.
    """
    octaves = np.frexp(np.maximum(values, 1))[1].astype(np.int64) - 1
    low_bits = np.where(values < _FIRST_CLASS, 0, octaves - 3)
    classes = 8 * (octaves - 2) + (values >> low_bits & 7)
    return np.where(values < _FIRST_CLASS, values, classes), low_bits


def reconstruction_levels(logarithmic: bool, levels: int, smallest: int, below: int, above: int) -> NDArray[np.int32]:
    """Return one channel's levels in a packet, from its range codes, in the core's unit and in the order of values.

    Linear quantisers have one level more than `levels` where equation (2) of the source paper gives one more.
    """
    memory = np.empty(levels + 1, dtype=np.int32)
    pointer = ffi.cast("int32_t *", memory.ctypes.data)
    return memory[: library().vc_dct_levels(logarithmic, levels, smallest, below, above, pointer)]


def nearest(levels: NDArray[np.int32], coefficients: Signal, rounds_logarithm: bool = False) -> NDArray[np.int64]:
    """Return the index of the level nearest to each coefficient; the levels may have any order.

    `rounds_logarithm`: each takes the level of its sign whose logarithm is nearest, as in equations (5) and (7) of the
    source paper.
    """
    rising = np.argsort(levels, kind="stable")
    lower, upper = levels[rising][:-1].astype(np.float64), levels[rising][1:].astype(np.float64)
    edges = (lower + upper) / 2
    if rounds_logarithm:
        edges = np.sign(lower + upper) * np.sqrt(np.maximum(lower * upper, 0))
    return rising[np.searchsorted(edges, coefficients)]


def whole_samples(signal_format: SignalFormat) -> int:
    """Return the samples of each transform of a file: all, or an equal part near WHOLE_SAMPLES or WHOLE_M."""
    assert signal_format.samples is not None, "live streams have no whole"
    usual = WHOLE_M * signal_format.rate_hz if signal_format.unit == PROFILE_UNIT else WHOLE_SAMPLES
    parts = max(1, round(signal_format.samples / usual))
    return max(_FADE_SAMPLES, -(-signal_format.samples // parts))


def is_whole(configuration: bytes) -> bool:
    """Return whether a stream has whole transforms, which no controller has the memory for."""
    return bool(configuration) and configuration[0] & _WHOLE_CODE == _WHOLE_CODE


class DctEncoder(PacketwiseEncoder):
    """Encoder of `dct`; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(
        self,
        setting: Setting,
        signal_format: SignalFormat,
        framing: Framing,
        model: Model | None = None,
        rate_control: RateControl | None = None,
    ) -> None:
        """Make an encoder of a complete, checked setting; it takes no model.

        `rate_control` chooses the levels of each packet.
        Raises CodecError for a channel count, packet length, frequency limit or threshold that the codec cannot have.
        """
        self._whole = word(setting, "block") == WHOLE
        if self._whole:
            if signal_format.samples is None:
                raise CodecError(
                    "block=whole needs a whole file, and this is a live stream; choose a block of "
                    f"{BLOCKS[0]} to {BLOCKS[-1]}"
                )
            self._block = whole_samples(signal_format)
            framing, max_blocks = Framing(self._block, 0), 1
        else:
            self._block = int(word(setting, "block"))
            max_blocks = min(MAX_PACKET_BLOCKS, MAX_PACKET_SAMPLES // self._block)
        super().__init__(signal_format.channels, framing, self._block, max_blocks)
        # The coefficient of a cosine of amplitude 1 that fits the block. For a whole file it is 1, which fits the core
        # at any length.
        self._unit_coefficient = 1.0 if self._whole else math.sqrt(self._block / 2)
        self._weight = self._unit_coefficient * math.sqrt(2 / self._block)
        self._logarithmic = word(setting, "quantiser") != "linear"
        self._rounds_logarithm = word(setting, "quantiser") == "log"
        entropy = word(setting, "entropy")
        self._range_coded = entropy == "range" or (entropy == AUTO and rate_control is not None)
        self._levels = int(number(setting, "levels"))
        self._rate_control, own_code = rate_control, level_code(self._levels)
        self._quantiser_offsets = range(own_code - LEVEL_CODES + 1, own_code + _CUTTING_QUANTISER_OFFSETS + 1)
        self._bins = _kept_bins(setting, signal_format, self._block)
        self._cuts = self._unit_coefficient * _cuts(setting, signal_format, self._block)[:, self._bins]
        self._smallest = [range_code(value) for value in self._least_magnitudes(setting, signal_format)]
        self.configuration = b"".join(
            (
                bytes(
                    (
                        (_WHOLE_CODE if self._whole else BLOCKS.index(self._block))
                        | (_LOGARITHMIC if self._logarithmic else _LINEAR)
                        | self._range_coded * _RANGE_CODED,
                    )
                ),
                (self._block if self._whole else self._packet_blocks).to_bytes(2, "little"),
                (0 if rate_control else self._levels).to_bytes(2, "little"),
                self._bins.start.to_bytes(2, "little"),
                self._bins.stop.to_bytes(2, "little"),
                *(code.to_bytes(2, "little") for code in self._smallest if self._logarithmic),
            )
        )
        self._gains = np.array(signal_format.gains)
        self._sequence = 0

    def _code_packets(self, samples: Signal) -> list[bytes]:
        from scipy.fft import dct

        blocks = samples.reshape(-1, self._packet_blocks, self._block, self._channels)
        coefficients = dct(blocks, axis=2, norm="ortho")[:, :, self._bins] * (UNIT * self._weight)
        kept = np.rint(coefficients)
        kept[np.abs(coefficients) < self._cuts.T] = 0
        parts = zip(kept.transpose(0, 3, 1, 2), samples.reshape(-1, self.packet_samples, self._channels), strict=True)
        packets = []
        for packet, own_samples in parts:
            packets.append(
                self._rate_controlled(packet, own_samples) if self._rate_control else self._code(packet, self._levels)
            )
            self._sequence += 1
        return packets

    def _rate_controlled(self, coefficients: Signal, samples: Signal) -> bytes:
        """Return one packet at the quantiser offset that the rate control chooses."""
        own_code = level_code(self._levels)

        def code(quantiser_offset: int) -> bytes:
            packet_code = max(own_code - quantiser_offset, 0)
            levels = library().vc_dct_levels_of(packet_code)
            cut = self._cut(coefficients, quantiser_offset - own_code)
            return self._code(cut, levels, bytes((packet_code,)))

        return self._chosen(samples, code)

    def _cut(self, coefficients: Signal, quantiser_offset: int) -> Signal:
        """Return a packet's coefficients, the small ones zero, as a quantiser offset beyond the fewest levels asks."""
        if quantiser_offset <= 0:
            return coefficients
        # One limit for all channels in the physical unit, so that the bits go to the strongest channels.
        physical = np.abs(coefficients) * self._gains[:, None, None]
        octaves = (quantiser_offset + 1 - _CUTTING_QUANTISER_OFFSETS) / _LEVEL_CODES_PER_OCTAVE
        return np.where(physical < 2**octaves * np.max(physical), 0, coefficients)

    def _least_magnitudes(self, setting: Setting, signal_format: SignalFormat) -> list[float]:
        """Return S of the logarithmic quantiser for each channel, in the core's unit."""
        smallest = number(setting, "smallest")
        if smallest == 0 and signal_format.unit not in ("um", PROFILE_UNIT):
            return [MIN_OF_RMS * rms * UNIT * self._weight for rms in signal_format.rms]
        return [(smallest or MIN_HEIGHT_UM) * UNIT / gain * self._unit_coefficient for gain in signal_format.gains]

    def _code(self, coefficients: Signal, levels: int, stated_levels: bytes = b"") -> bytes:
        """Return one packet of coefficients (channels, blocks, bins) in the core's unit.

        `stated_levels`: the code of its levels, if the configuration does not state them. Raises CodecError if the
        packet is too long.
        """
        # The greatest magnitudes below and above zero.
        ranges = [(range_code(-float(np.min(part))), range_code(float(np.max(part)))) for part in coefficients]
        sounding = [channel for channel, both in enumerate(ranges) if any(both)]
        # Only logarithmic levels have none at zero.
        zeros = self._logarithmic and bool(np.any(coefficients[sounding] == 0))
        values = [
            self._quantised(coefficients[channel], levels, self._smallest[channel], *ranges[channel], zeros)
            for channel in sounding
        ]
        packet = pack_varint(2 * self._sequence + 1) + stated_levels
        packet += b"".join(code.to_bytes(2, "little") for both in ranges for code in both)
        if values:
            packet += (
                self._range_code(np.array(values), zeros)
                if self._range_coded
                else huffman_code(np.array(values), zeros if self._logarithmic else None)
            )
        if len(packet) > MAX_PACKET_BYTES:
            raise does_not_fit(self.packet_samples)
        return packet

    def _quantised(
        self, coefficients: Signal, levels: int, smallest: int, below: int, above: int, zeros: bool
    ) -> NDArray[np.int64]:
        """Return each coefficient's coded value: that of its level or, if zero has a value, 0 for zero."""
        levels_of_values = reconstruction_levels(self._logarithmic, levels, smallest, below, above)
        values = nearest(levels_of_values, coefficients, self._rounds_logarithm) + zeros
        return np.where(coefficients == 0, 0, values) if zeros else values

    def _range_code(self, values: NDArray[np.int64], zeros: bool) -> bytes:
        flat = np.ascontiguousarray(values, dtype=np.uint32)
        output = ffi.new("uint8_t[]", MAX_PACKET_BYTES)
        pointer = ffi.cast("const uint32_t *", flat.ctypes.data)
        length = library().vc_dct_range_encode(pointer, *flat.shape, self._logarithmic, zeros, output, MAX_PACKET_BYTES)
        if length < 0:
            raise does_not_fit(self.packet_samples)
        return bytes(ffi.buffer(output, length))


def _kept_bins(setting: Setting, signal_format: SignalFormat, block: int) -> slice:
    """Return which coefficients are coded. Raises CodecError for none, and for too many."""
    first = int(word(setting, "dc") == "drop")
    heights = signal_format.unit == "um" or (signal_format.unit == PROFILE_UNIT and word(setting, "block") == WHOLE)
    limit_hz = number(setting, "limit_hz") or (HEIGHT_LIMIT_HZ if heights else math.inf)
    spacing_hz = _spacing_hz(setting, signal_format, block)
    end = min(limit_hz / spacing_hz + 1, block)
    if end < first + 1:
        raise CodecError(
            f"a limit of {limit_hz:g} Hz leaves no component; choose a limit_hz of at least {first * spacing_hz:.3g}"
        )
    if end >= MAX_COEFFICIENTS + 1:
        raise CodecError(
            f"{int(end)} coefficients in one transform, more than {MAX_COEFFICIENTS}: choose a limit_hz of at "
            f"most {(MAX_COEFFICIENTS - 1) * spacing_hz:.0f}, or a shorter block"
        )
    return slice(first, int(end))


def _spacing_hz(setting: Setting, signal_format: SignalFormat, block: int) -> float:
    """Return the frequency from one coefficient to the next: of a file over position, at the setting's hand speed."""
    metres_per_s = number(setting, "hand_speed_mm_s") / 1000 if signal_format.unit == PROFILE_UNIT else 1.0
    return signal_format.rate_hz * metres_per_s / (2 * block)


def _cuts(setting: Setting, signal_format: SignalFormat, block: int) -> Signal:
    """Return the amplitude below which each coefficient is cut, in the core's unit: float64 (channels, block)."""
    name = word(setting, "threshold")
    if name == "off":
        return np.zeros((signal_format.channels, block))
    try:
        rows = read_threshold(DETECTION_THRESHOLD if name == "on" else Path(name))
    except CodecError as error:
        raise CodecError(f"threshold is neither off nor on, and the file {error}") from error
    frequency_hz = np.arange(block, dtype=np.float64) * _spacing_hz(setting, signal_format, block)
    unit = "um" if signal_format.unit == PROFILE_UNIT else signal_format.unit
    amplitude = threshold_amplitude(rows, frequency_hz, unit) * 10 ** (number(setting, "b0_db") / 20)
    return np.array([amplitude * UNIT / gain for gain in signal_format.gains])


def huffman_code(values: NDArray[np.int64], zeros: bool | None) -> bytes:
    """Return the Huffman code of values of any shape: the table of the code, then the values.

    `zeros`: whether 0 stands for zero, for levels that have none at zero; the code states it first. None = not stated.
    """
    flat = values.reshape(-1)
    symbols, low_bits = symbols_of(flat)
    # The code is complete: if all values are equal, a second symbol has a code too.
    lengths = code_lengths(np.bincount(symbols, minlength=2).tolist())
    codes = np.array(canonical_codes(lengths))[symbols] << low_bits | flat & ((1 << low_bits) - 1)
    table = [(len(lengths) - 1, 7), *((length, 4) for length in lengths)]
    if zeros is not None:
        table.insert(0, (int(zeros), 1))
    words, sizes = (np.array(part, dtype=np.int64) for part in zip(*table, strict=True))
    return pack_bits(np.concatenate([words, codes]), np.concatenate([sizes, np.array(lengths)[symbols] + low_bits]))


def code_lengths(counts: Sequence[int]) -> list[int]:
    """Return the length of each symbol's code in bits, at most MAX_CODE; 0 for a symbol that does not occur.

    D. Huffman, "A method for the construction of minimum-redundancy codes", Proc. IRE 40 (1952). The code is complete:
    if only one symbol occurs, a second one gets a code too. While a code is too long, the counts are halved, as in
    bzip2.
    """
    shared = list(counts)
    while sum(count > 0 for count in shared) < 2:
        shared[shared.index(0)] = 1
    while True:
        lengths = [0] * len(shared)
        heap: list[tuple[int, tuple[int, ...]]] = [
            (count, (symbol,)) for symbol, count in enumerate(shared) if count > 0
        ]
        heapq.heapify(heap)
        while len(heap) > 1:
            (first, left), (second, right) = heapq.heappop(heap), heapq.heappop(heap)
            for symbol in left + right:
                lengths[symbol] += 1
            heapq.heappush(heap, (first + second, left + right))
        if max(lengths) <= MAX_CODE:
            return lengths
        shared = [(count + 1) // 2 for count in shared]


def canonical_codes(lengths: Sequence[int]) -> list[int]:
    """Return the code of each symbol: numbers in order of length, then of symbol; 0 for a symbol without a code."""
    codes = [0] * len(lengths)
    code = previous = 0
    for length, symbol in sorted((length, symbol) for symbol, length in enumerate(lengths) if length):
        code <<= length - previous
        codes[symbol] = code
        code, previous = code + 1, length
    return codes


def pack_bits(words: NDArray[np.int64], lengths: NDArray[np.int64]) -> bytes:
    """Join words of these lengths in bits, each from its highest bit on; zeros fill the last byte."""
    ends = np.cumsum(lengths)
    shifts = np.repeat(ends, lengths) - 1 - np.arange(ends[-1] if len(ends) else 0)
    return np.packbits((np.repeat(words, lengths) >> shifts & 1).astype(np.uint8)).tobytes()


class WholeDecoder:
    """Decoder of whole transforms, for hosts only; see codec.interface.Decoder. The core reads the coefficients.

    The inverse transform is in floating point, so samples may differ in the last bit from machine to machine.
    """

    delay_samples = 0
    hosts_only = True

    def __init__(self, configuration: bytes, channels: int) -> None:
        """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
        check_channels(channels)
        self.channels = channels
        self._state = CoreState(NAME, "decoder", configuration, channels)
        self.packet_samples: int = library().vc_dct_decoder_packet_samples(self._state.pointer)
        first, end = (int.from_bytes(configuration[start : start + 2], "little") for start in (5, 7))
        self._bins = slice(first, end)
        self._last = np.zeros((self.packet_samples, channels), dtype=np.int16)

    def coefficients(self, packet: bytes) -> NDArray[np.int32]:
        """Return the coded coefficients (channels, end - first): amplitudes in the core's unit, exact on every machine.

        Raises CodecError when the packet is malformed.
        """
        coded = np.empty((self.channels, self._bins.stop - self._bins.start), dtype=np.int32)
        pointer = ffi.cast("int32_t *", coded.ctypes.data)
        if library().vc_dct_decode_whole(self._state.pointer, packet, len(packet), pointer) < 0:
            raise damaged_packet()
        return coded

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError when it is malformed."""
        from scipy.fft import idct

        coefficients = np.zeros((self.packet_samples, self.channels))
        weight = math.sqrt(self.packet_samples / 2) * 32_768 / UNIT
        coefficients[self._bins] = self.coefficients(packet).T * weight
        samples = np.rint(idct(coefficients, axis=0, norm="ortho"))
        self._last = np.clip(samples, -32_768, 32_767).astype(np.int16)
        return self._last

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last one backwards, faded out, then silence."""
        self._last = faded_backwards(self._last, _FADE_SAMPLES)
        return self._last


def make_decoder(configuration: bytes, channels: int, tables: bytes | None = None) -> Decoder:
    """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
    if is_whole(configuration):
        return WholeDecoder(configuration, channels)
    return CoreDecoder(NAME, configuration, channels)


RATE_POINT_LEVELS = (4, 5, 6, 8, 10, 12, 14, 20, 28, 40, 56, 80, 112, 160, 224, 320)
"""The paper's seven numbers of levels, then more, up to 25 dB of SNR and beyond."""
RATE_POINT_B0_DB = (24.0, 18.0, 12.0, 8.0, 4.0, 0.0, -4.0, -8.0, -12.0, -18.0, -24.0)


def _level_rate_points(**fixed: str) -> RatePoints:
    return RatePoints(tuple({**fixed, "levels": levels} for levels in RATE_POINT_LEVELS), "threshold" in fixed)


CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="DCT of blocks or of a whole file, few levels, Huffman or range coding, after a paper on textures",
    parameters={
        "quantiser": Parameter(
            "spacing of the levels; log rounds the logarithm, log-nearest takes the nearest level",
            "linear",
            choices=("linear", "log", "log-nearest"),
        ),
        "levels": Parameter("number of levels; 65535 keeps 16 bits", 14, low=4, high=MAX_LEVELS, whole=True),
        "smallest": Parameter(
            "smallest logarithmic level, in the signal's unit; 0 = 0.05 um, or 0.05 of the RMS value in other units",
            0.0,
            low=0,
        ),
        "threshold": Parameter(
            "cut of coefficients below the detection threshold: off, on, or a file with another threshold",
            "off",
            text=True,
        ),
        "b0_db": Parameter("level of the cut relative to the detection threshold, in dB", -8.0, low=-200, high=200),
        "entropy": Parameter(
            "entropy coder; auto = range with rate control, else huffman", AUTO, choices=(AUTO, "huffman", "range")
        ),
        "block": Parameter(
            "samples in a block; whole = one transform of a file, for hosts only",
            "512",
            choices=(*map(str, BLOCKS), WHOLE),
            is_block=True,
        ),
        "limit_hz": Parameter(
            "highest frequency kept; 0 = 400 Hz for heights over time or in whole transforms, else no limit", 0.0, low=0
        ),
        "hand_speed_mm_s": Parameter(
            "speed of the hand at which limit_hz and threshold apply to a profile over position", 50.0, low=0.1
        ),
        "dc": Parameter("whether to keep the mean of each block", "keep", choices=("keep", "drop")),
    },
    rate_point_sets={
        "dct-linear": _level_rate_points(),
        "dct-log": _level_rate_points(quantiser="log"),
        "dct-linear-range": _level_rate_points(entropy="range"),
        "dct-log-range": _level_rate_points(quantiser="log", entropy="range"),
        "dct-threshold": RatePoints(
            tuple({"levels": MAX_LEVELS, "threshold": "on", "b0_db": b0} for b0 in RATE_POINT_B0_DB), is_physical=True
        ),
        "dct-linear-threshold": _level_rate_points(threshold="on"),
        "dct-log-threshold": _level_rate_points(quantiser="log", threshold="on"),
    },
    make_encoder=DctEncoder,
    make_decoder=make_decoder,
    controls_rate=True,
)
