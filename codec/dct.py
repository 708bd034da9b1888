"""The codec `dct`: blockwise DCT, quantised linearly or logarithmically, after a paper on material-like textures.

A block of N samples x[n] becomes the orthonormal DCT-II C[k] = s_k sum x[n] cos(pi (2n + 1) k / (2N)), s_0 = sqrt(1/N),
s_k = sqrt(2/N). Its index k stands for the frequency F = k rate / (2N); for a hand that sweeps at the speed v over the
length D of the block that is v k / (2D), half the spacing v / D of a discrete Fourier transform. The paper's |C_k| is
an amplitude of displacement: here it is |C[k]| sqrt(2/N), that of a cosine which fits the block. Blocks do not
overlap. Layout in docs/bitstream.md, choices in docs/codecs.md.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.core import UNIT, CoreDecoder, does_not_fit
from vibrocast.codec.huffman import canonical_codes, code_lengths, pack_bits
from vibrocast.codec.interface import (
    AUTO,
    Codec,
    CodecError,
    Framing,
    Model,
    Parameter,
    RateControl,
    Setting,
    Signal,
    SignalFormat,
    number,
    word,
)
from vibrocast.codec.packetwise import PacketwiseEncoder
from vibrocast.codec.threshold import DETECTION_THRESHOLD, read_threshold, threshold_amplitude
from vibrocast.device_protocol.coded_stream import MAX_PACKET_BYTES, PROFILE_UNIT
from vibrocast.device_protocol.encoding import pack_varint
from vibrocast.firmware.native_core import ffi, library

NAME = "dct"
IDENTIFIER = 2
BLOCKS = (64, 128, 256, 512, 1024)
MAX_PACKET_BLOCKS = 4095
MAX_PACKET_SAMPLES = 2**18
MAX_LEVELS = 65_535
LEVEL_CODES = 231
"""Of the numbers of levels that the packets of a rate-controlled stream say."""
HEIGHT_LIMIT_HZ = 400.0
"""The source paper drops what is above it: its display has no more, and fingers feel little of it."""
MIN_HEIGHT_UM = 0.05
"""S of the source paper."""
MIN_OF_RMS = 0.05
"""S of other units, relative to the RMS value of a coefficient: a tenth gains 1 dB at 14 levels, but stops at 25 dB."""

_RANGE_CODES_PER_OCTAVE = 256
_LEVEL_CODES_PER_OCTAVE = 16
# Quantiser offsets beyond 4 levels cut what is small, from 36 dB below the greatest magnitude on, and with the last one
# all.
_CUTTING_QUANTISER_OFFSETS = 6 * _LEVEL_CODES_PER_OCTAVE + 1
_FIRST_CLASS = 16


def range_code(magnitude: float) -> int:
    """Return the code of the power of 2^(1/256) next above a magnitude in the core's unit; 0 for less than half."""
    if magnitude < 0.5:
        return 0
    return min(max(math.ceil(_RANGE_CODES_PER_OCTAVE * math.log2(magnitude)), 1), 65_535)


def level_code(levels: int) -> int:
    """Return the code of the number of levels nearest `levels`: 16 codes for each factor of two in the steps' size."""
    return min(round(_LEVEL_CODES_PER_OCTAVE * math.log2((levels - 1) / 3)), LEVEL_CODES - 1)


def symbols_of(values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the symbol of each coded value, and how many of the value's low bits follow its code.

    Below 16 each value has its own symbol; above, a symbol is one of eight classes an octave.
    """
    octaves = np.frexp(np.maximum(values, 1))[1].astype(np.int64) - 1
    low_bits = np.where(values < _FIRST_CLASS, 0, octaves - 3)
    classes = 8 * (octaves - 2) + (values >> low_bits & 7)
    return np.where(values < _FIRST_CLASS, values, classes), low_bits


def reconstruction_levels(logarithmic: bool, levels: int, smallest: int, below: int, above: int) -> NDArray[np.int32]:
    """Return the levels of a channel of a packet, from its range codes, in the core's unit: in the order of values."""
    memory = np.empty(levels, dtype=np.int32)
    pointer = ffi.cast("int32_t *", memory.ctypes.data)
    library().vc_dct_levels(logarithmic, levels, smallest, below, above, pointer)
    return memory


class DctEncoder(PacketwiseEncoder):
    """Encoder of `dct`; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(
        self, setting: Setting, signal_format: SignalFormat, framing: Framing, rate_control: RateControl | None = None
    ) -> None:
        """Make an encoder; the setting is complete and checked. `rate_control` chooses the levels of each packet.

        Raises CodecError on a channel count, packet length, frequency limit or threshold that the codec does not have.
        """
        self._block = int(word(setting, "block"))
        max_blocks = min(MAX_PACKET_BLOCKS, MAX_PACKET_SAMPLES // self._block)
        super().__init__(signal_format.channels, framing, self._block, max_blocks)
        self._logarithmic = word(setting, "quantiser") == "log"
        entropy = word(setting, "entropy")
        self._range_coded = entropy == "range" or (entropy == AUTO and rate_control is not None)
        self._levels = int(number(setting, "levels"))
        self._rate_control, own_code = rate_control, level_code(self._levels)
        self._quantiser_offsets = range(own_code - LEVEL_CODES + 1, own_code + _CUTTING_QUANTISER_OFFSETS + 1)
        self._bins = _kept_bins(setting, signal_format, self._block)
        self._cuts = _cuts(setting, signal_format, self._block)[:, self._bins]
        self._smallest = [range_code(value) for value in _smallest(setting, signal_format, self._block)]
        self.configuration = b"".join(
            (
                bytes((BLOCKS.index(self._block) | self._logarithmic << 3 | self._range_coded << 4,)),
                self._packet_blocks.to_bytes(2, "little"),
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
        coefficients = dct(blocks, axis=2, norm="ortho")[:, :, self._bins] * UNIT
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
        """Return one packet at the quantiser offset chosen for it."""
        own_code = level_code(self._levels)

        def code(quantiser_offset: int) -> bytes:
            packet_code = max(own_code - quantiser_offset, 0)
            levels = library().vc_dct_levels_of(packet_code)
            cut = self._cut(coefficients, levels, quantiser_offset - own_code)
            return self._code(cut, levels, bytes((packet_code,)))

        return self._chosen(samples, code)

    def _cut(self, coefficients: Signal, levels: int, quantiser_offset: int) -> Signal:
        """Return the coefficients of a rate-controlled packet without those that count as zero.

        These are less than half a step of linear levels, and, `quantiser_offset` beyond the fewest levels, what it
        cuts.
        """
        magnitudes = np.abs(coefficients)
        limits = np.zeros((self._channels, 1, 1))
        if not self._logarithmic:
            limits = np.ptp(coefficients, axis=(1, 2), keepdims=True) / (levels - 1) / 2
        if quantiser_offset > 0:
            # Equal in the physical unit, so that the bits go to the channels that have most.
            physical = magnitudes * self._gains[:, None, None]
            octaves = (quantiser_offset + 1 - _CUTTING_QUANTISER_OFFSETS) / _LEVEL_CODES_PER_OCTAVE
            limits = np.maximum(limits, 2**octaves * np.max(physical) / self._gains[:, None, None])
        return np.where(magnitudes < limits, 0, coefficients)

    def _code(self, coefficients: Signal, levels: int, stated_levels: bytes = b"") -> bytes:
        """Return one packet of coefficients (channels, blocks, bins) in the core's unit.

        `stated_levels`: the code of its levels, where the configuration states none. Raises CodecError where it does
        not fit.
        """
        # The greatest magnitudes below and above zero.
        magnitudes = [(max(-float(np.min(part)), 0.0), max(float(np.max(part)), 0.0)) for part in coefficients]
        if stated_levels and not self._logarithmic:
            magnitudes = [_with_level_at_zero(below, above, levels) for below, above in magnitudes]
        ranges = [(range_code(below), range_code(above)) for below, above in magnitudes]
        sounding = [channel for channel, both in enumerate(ranges) if any(both)]
        zeros = bool(np.any(coefficients[sounding] == 0))
        values = [
            self._quantised(coefficients[channel], levels, self._smallest[channel], *ranges[channel], zeros)
            for channel in sounding
        ]
        packet = pack_varint(2 * self._sequence + 1) + stated_levels
        packet += b"".join(code.to_bytes(2, "little") for both in ranges for code in both)
        if values:
            coder = self._range_code if self._range_coded else _huffman_code
            packet += coder(np.array(values), zeros)
        if len(packet) > MAX_PACKET_BYTES:
            raise does_not_fit(self.packet_samples)
        return packet

    def _quantised(
        self, coefficients: Signal, levels: int, smallest: int, below: int, above: int, zeros: bool
    ) -> NDArray[np.int64]:
        """Return the coded value of each coefficient: that of the nearest level, or 0 for zero where that is one."""
        values_of_levels = reconstruction_levels(self._logarithmic, levels, smallest, below, above)
        rising = np.argsort(values_of_levels, kind="stable")
        edges = (values_of_levels[rising][1:] + values_of_levels[rising][:-1].astype(np.float64)) / 2
        values = rising[np.searchsorted(edges, coefficients)] + zeros
        return np.where(coefficients == 0, 0, values) if zeros else values

    def _range_code(self, values: NDArray[np.int64], zeros: bool) -> bytes:
        flat = np.ascontiguousarray(values, dtype=np.uint32)
        output = ffi.new("uint8_t[]", MAX_PACKET_BYTES)
        pointer = ffi.cast("const uint32_t *", flat.ctypes.data)
        length = library().vc_dct_range_encode(pointer, *flat.shape, self._logarithmic, zeros, output, MAX_PACKET_BYTES)
        if length < 0:
            raise does_not_fit(self.packet_samples)
        return bytes(ffi.buffer(output, length))


def _with_level_at_zero(below: float, above: float, levels: int) -> tuple[float, float]:
    """Return the ends of a linear quantiser moved by at most half a step, so that a level is at zero.

    Without one, small coefficients cost a bit each at an even number of levels and next to nothing at an odd one: bytes
    would not fall with the levels.
    """
    step = (below + above) / (levels - 1)
    steps_below = round(below / step) if step else 0
    return steps_below * step, (levels - 1 - steps_below) * step


def _kept_bins(setting: Setting, signal_format: SignalFormat, block: int) -> slice:
    """Return the coefficients that are coded. Raises CodecError when none is."""
    first = int(word(setting, "dc") == "drop")
    limit_hz = number(setting, "limit_hz") or (HEIGHT_LIMIT_HZ if signal_format.unit == "um" else math.inf)
    end = min(limit_hz * 2 * block / signal_format.rate_hz + 1, block)
    if end < first + 1:
        raise CodecError(
            f"a limit of {limit_hz:g} Hz leaves nothing; with limit_hz from "
            f"{first * signal_format.rate_hz / (2 * block):.3g} on there is a component below it"
        )
    return slice(first, int(end))


def _cuts(setting: Setting, signal_format: SignalFormat, block: int) -> Signal:
    """Return the magnitude below which each coefficient is cut, in the core's unit: float64 (channels, block)."""
    name = word(setting, "threshold")
    if name == "off":
        return np.zeros((signal_format.channels, block))
    try:
        rows = read_threshold(DETECTION_THRESHOLD if name == "on" else Path(name))
    except CodecError as error:
        raise CodecError(f"threshold is neither off nor on, and the file {error}") from error
    frequency_hz = np.arange(block) * signal_format.rate_hz / (2 * block)
    amplitude = threshold_amplitude(rows, frequency_hz, signal_format.unit) * 10 ** (number(setting, "b0_db") / 20)
    return np.array([amplitude * _coefficients_of(gain, block) for gain in signal_format.gains])


def _smallest(setting: Setting, signal_format: SignalFormat, block: int) -> list[float]:
    """Return S of the logarithmic quantiser for each channel, in the core's unit."""
    smallest = number(setting, "smallest")
    if smallest == 0 and signal_format.unit not in ("um", PROFILE_UNIT):
        return [MIN_OF_RMS * rms * UNIT for rms in signal_format.rms]
    return [(smallest or MIN_HEIGHT_UM) * _coefficients_of(gain, block) for gain in signal_format.gains]


def _coefficients_of(gain: float, block: int) -> float:
    """Return the coefficient, in the core's unit, of an amplitude of 1 in the signal's unit."""
    return math.sqrt(block / 2) * UNIT / gain


def _huffman_code(values: NDArray[np.int64], zeros: bool) -> bytes:
    flat = values.reshape(-1)
    symbols, low_bits = symbols_of(flat)
    # The code is complete, so two symbols have one even where all values are equal.
    lengths = code_lengths(np.bincount(symbols, minlength=2).tolist())
    codes = np.array(canonical_codes(lengths))[symbols] << low_bits | flat & ((1 << low_bits) - 1)
    table = [(int(zeros), 1), (len(lengths) - 1, 7), *((length, 4) for length in lengths)]
    words, sizes = (np.array(part, dtype=np.int64) for part in zip(*table, strict=True))
    return pack_bits(np.concatenate([words, codes]), np.concatenate([sizes, np.array(lengths)[symbols] + low_bits]))


def make_encoder(
    setting: Setting,
    signal_format: SignalFormat,
    framing: Framing,
    model: Model | None,
    rate_control: RateControl | None = None,
) -> DctEncoder:
    """Make an encoder. Raises CodecError as `DctEncoder`."""
    assert model is None, "no model brings tables"
    return DctEncoder(setting, signal_format, framing, rate_control)


def make_decoder(configuration: bytes, channels: int, tables: bytes | None = None) -> CoreDecoder:
    """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
    assert tables is None, "no model brings tables"
    return CoreDecoder(NAME, configuration, channels)


RATE_POINT_LEVELS = (4, 5, 6, 8, 10, 12, 14, 20, 28, 40, 56, 80, 112, 160, 224, 320)
"""The paper's seven, then on to some 25 dB of SNR and beyond."""
RATE_POINT_B0_DB = (24.0, 18.0, 12.0, 8.0, 4.0, 0.0, -4.0, -8.0, -12.0, -18.0, -24.0)


def _level_rate_point_set(**fixed: str) -> tuple[Setting, ...]:
    return tuple({**fixed, "levels": levels} for levels in RATE_POINT_LEVELS)


CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="blockwise DCT at few levels, Huffman or range coded, after a paper on material-like textures",
    parameters={
        "quantiser": Parameter("spacing of the levels", "linear", choices=("linear", "log")),
        "levels": Parameter("number of levels L; 65535 are 16 bits", 14, low=4, high=MAX_LEVELS, whole=True),
        "smallest": Parameter(
            "least magnitude S of log, in the signal's unit; 0: .05 um, or in other units .05 of the RMS value",
            0.0,
            low=0,
        ),
        "threshold": Parameter(
            "whether what is below the detection threshold is cut: off, on, or the name of another threshold's file",
            "off",
            text=True,
        ),
        "b0_db": Parameter("where the cut is, relative to the detection threshold", -8.0, low=-200, high=200),
        "entropy": Parameter(
            "entropy coder; auto: range where rate-controlled", AUTO, choices=(AUTO, "huffman", "range")
        ),
        "block": Parameter("samples in a block", "512", choices=tuple(map(str, BLOCKS))),
        "limit_hz": Parameter("components above are dropped; 0: above 400 Hz for um over time, else none", 0.0, low=0),
        "dc": Parameter("the mean of each block", "keep", choices=("keep", "drop")),
    },
    rate_point_sets={
        "dct-linear": _level_rate_point_set(),
        "dct-log": _level_rate_point_set(quantiser="log"),
        "dct-linear-range": _level_rate_point_set(entropy="range"),
        "dct-log-range": _level_rate_point_set(quantiser="log", entropy="range"),
        "dct-threshold": tuple({"levels": MAX_LEVELS, "threshold": "on", "b0_db": b0} for b0 in RATE_POINT_B0_DB),
        "dct-linear-threshold": _level_rate_point_set(threshold="on"),
        "dct-log-threshold": _level_rate_point_set(quantiser="log", threshold="on"),
    },
    physical_rate_point_sets=frozenset({"dct-threshold", "dct-linear-threshold", "dct-log-threshold"}),
    make_encoder=make_encoder,
    make_decoder=make_decoder,
    controls_rate=True,
    block_parameter="block",
    # The range coder has taken fewer bits than Huffman's on every texture (docs/results.md).
    planned_setting={"entropy": "range"},
)
