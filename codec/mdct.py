"""The codec `mdct`: low-delay MDCT, trellis-coded quantisation, range coding; layout: docs/reference/bitstream.md."""

import math
from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.core import (
    HOPS,
    RATE_CONTROLLED,
    STEP_CODES,
    UNIT,
    CoreDecoder,
    CoreEncoder,
    PacketwiseEncoder,
    damaged_packet,
    step_code,
    step_of,
)
from vibrocast.codec.interface import (
    AUTO,
    Codec,
    CodecError,
    Estimate,
    Framing,
    Model,
    ModelTables,
    Parameter,
    RateControl,
    RatePoints,
    Setting,
    Signal,
    SignalFormat,
    Steps,
    number,
    numbers,
    word,
)
from vibrocast.codec.rotation import MAX_DELAY, Rotation, aligned, candidates
from vibrocast.codec.threshold import FLAT, parsed_shape
from vibrocast.device_protocol.coded_stream import packet_sequence
from vibrocast.device_protocol.layout import pack_varint, unpack_varint
from vibrocast.firmware.native_core import ffi, library

NAME = "mdct"
IDENTIFIER = 1
MAX_PACKET_BLOCKS = 2047
STEP_CODES_OF_QUANTISER_OFFSET = 4
"""Step codes in one unit of the quantiser offset."""
SHAPED = 4
"""Bit of a configuration's first number whose stream has steps that differ over frequency."""
ROTATION = 2
"""Bit of the features of a stream whose channels are rotated."""
NONE = "none"
"""The value of the parameter `rotation` for none."""
MAX_NOISE_FILLING = 31 / 128
LAMBDA = 108
"""Weight of a bit against squared error, in 1/256 of a squared step; 70 to 125 differ by at most 1 % of BD-rate."""

_MAX_COEFFICIENT = 2**28
_CHUNK_BLOCKS = 8192
_RESOLVING_SAMPLES = 1 << 15
_RESOLVING_STEP = 0.5
_RESOLVING_PACKET = 1024
_SAME_COST = 1.001
_LEAST_GAIN = 0.01
"""Part of the cost by which a rotation, and then its delays, must lower it: the gain at one step shrinks at others."""
_NOISE_FILLING_UNIT = 128
_BLOCKS_SHIFT = 3
_SHAPE_UNITS = (14 / 64, 28 / 64, 42 / 64, 56 / 64)
"""Octaves: of the shapes for touch at the strengths 0.25, 0.5, 0.75 and 1, a third of the greatest."""

ERROR_OF_STEP = 1 / 3
"""Squared error of a coefficient above it, in squared steps: the mean over recordings of `mdct`, from 0 to 45 dB."""
_BITS_OF_IDEAL = 1.14
_CODE_BITS = 20
_SUM_OF_WEIGHTS = 4 * 8

MIN_STEP = 2.0**-18
MAX_STEP = 2.0**6


def hop_samples(rate_hz: float) -> int:
    """Return the hop of live streams: 32 samples, or 64 from 5600 Hz on, where a block of 128 lasts 23 ms at most."""
    return 64 if rate_hz >= 5600 else 32


def configuration(
    hop: int,
    packet_blocks: int,
    step_codes: Sequence[int],
    noise_filling_code: int = 0,
    rate_controlled: bool = False,
    shape: bytes = b"",
    rotation: bytes = b"",
) -> bytes:
    """Return the codec's bytes in the stream header.

    `shape`: as from `packed_shape`, empty = none. `rotation`: the section of one, empty = none.
    """
    head = pack_varint(packet_blocks << _BLOCKS_SHIFT | SHAPED * bool(shape) | HOPS.index(hop))
    steps = b"".join((noise_filling_code << 11 | code).to_bytes(2, "little") for code in step_codes)
    features = RATE_CONTROLLED[0] * rate_controlled | ROTATION * bool(rotation)
    return head + steps + shape + bytes([features] if features else []) + rotation


def packed_shape(octaves: Sequence[float] | None) -> tuple[bytes, float]:
    """Return a step shape for a configuration, empty for one that is flat, and the mean octaves of its nodes.

    Nodes are 0 to 3 times a unit; of the four units, the one that comes nearest.
    """
    if octaves is None:
        return b"", 0.0
    wanted = np.array(octaves)
    shapes = [(code, np.clip(np.rint(wanted / unit), 0, 3).astype(int), unit) for code, unit in enumerate(_SHAPE_UNITS)]
    code, values, unit = min(shapes, key=lambda each: float(np.sum(np.square(each[1] * each[2] - wanted))))
    if not values.any():
        return b"", 0.0
    section = code << 2 * len(values) | sum(int(value) << 2 * node for node, value in enumerate(values))
    return section.to_bytes(2, "little"), unit * float(np.mean(values))


def built_in_tables() -> bytes:
    """Return the initial tables that are built into the core."""
    core = library()
    return bytes(ffi.buffer(core.vc_mdct_builtin_tables(), core.vc_mdct_tables_size()))


def limited(coefficients: Signal) -> NDArray[np.int32]:
    """Return coefficients in the core's unit, rounded, within what the core takes."""
    rounded = np.rint(coefficients)
    return np.clip(rounded, -_MAX_COEFFICIENT, _MAX_COEFFICIENT, out=rounded).astype(np.int32, order="C")


def spectra(samples: Signal, hop: int) -> NDArray[np.int32]:
    """Return the MDCT (blocks, channels, hop) of samples (n, channels), by the core, in its unit; full scale is 1."""
    units = limited(samples * UNIT)
    channels = samples.shape[1]
    coefficients = np.empty((len(samples) // hop - 1, channels, hop), np.int32)
    library().vc_mdct_analyse(
        ffi.cast("int32_t *", units.ctypes.data),
        len(coefficients),
        channels,
        hop,
        ffi.cast("int32_t *", coefficients.ctypes.data),
    )
    return coefficients


class MdctEncoder(PacketwiseEncoder):
    """Encoder of `mdct`; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(  # noqa: PLR0913 - a setting of the codec each
        self,
        steps: Sequence[float],
        rate_hz: float,
        framing: Framing,
        tables: bytes | None = None,
        rd_weight: float = 1.0,
        hop: int | None = None,
        noise_filling: float = 0.0,
        rate_control: RateControl | None = None,
        shape: Sequence[float] | None = None,
        rotation: Rotation | None = None,
    ) -> None:
        """Make an encoder of len(steps) channels with quantiser steps relative to full scale.

        `rd_weight`: weight of bits against squared error in rounding, 1 = the best for its rate, 0 = the least error.
        `hop`: one of HOPS, None = the one of live streams. `noise_filling`: magnitude that replaces coefficients
        rounded to zero, in quantiser steps. `rate_control`: chooses the quantiser offset of each packet, in 1/16 octave
        of the steps; None = no offsets. `shape`: octaves by which steps are coarser at `threshold.NODES`; their mean
        stays that of `steps`. `rotation`: mixes the channels, None = each is coded alone. Raises CodecError for a
        channel count, step, packet length, hop, noise filling or tables that the codec cannot have.
        """
        self._hop = hop_samples(rate_hz) if hop is None else hop
        if self._hop not in HOPS:
            raise CodecError(f"hop {self._hop} is not possible; give one of {HOPS}")
        if not all(math.isfinite(step) and step > 0 for step in steps):
            raise CodecError("a quantiser step is not positive; give positive numbers")
        self._rotation = rotation
        self._history = self.delay_samples = _delay_samples(self._hop, rotation)
        self._chunk_samples = max(1, _CHUNK_BLOCKS * self._hop // max(1, len(steps)))
        super().__init__(len(steps), framing, self._hop, MAX_PACKET_BLOCKS)
        if not 0 <= noise_filling <= MAX_NOISE_FILLING:
            raise CodecError(f"noise_filling {noise_filling} is not possible; give 0 to {MAX_NOISE_FILLING}")
        packed, mean_octaves = packed_shape(shape)
        step_codes = [step_code(step / 2**mean_octaves) for step in steps]
        self.configuration = configuration(
            self._hop,
            self._packet_blocks,
            step_codes,
            round(noise_filling * _NOISE_FILLING_UNIT),
            rate_control is not None,
            packed,
            rotation.pack() if rotation else b"",
        )
        # Coded channels of a rotation all have the smallest step.
        self._relative_steps = np.array([step_of(min(step_codes)) / step_of(code) for code in step_codes])
        self._rate_control = rate_control
        self._quantiser_offsets = range(
            -(max(step_codes) // STEP_CODES_OF_QUANTISER_OFFSET),
            (STEP_CODES - 1 - min(step_codes)) // STEP_CODES_OF_QUANTISER_OFFSET + 1,
        )
        self._tables, table_arguments = _tables_arguments(tables)
        parameters = (*table_arguments, framing.refresh_packets, round(LAMBDA * rd_weight))
        self._core = CoreEncoder(NAME, self.configuration, self._channels, *parameters)

    @property
    def squared_errors(self) -> tuple[float, ...] | None:
        """The squared error of each channel so far; see codec.interface.MeasuringEncoder."""
        if self._rotation is not None:
            return None
        core, unit = library(), 256 * 32_768**2
        return tuple(core.vc_mdct_squared_error(self._core.pointer, each) / unit for each in range(self._channels))

    def adapted_tables(self) -> bytes:
        """Return the adapted state as initial tables for a model image. Training on recordings uses this."""
        core = library()
        tables = ffi.new("uint8_t[]", core.vc_mdct_tables_size())
        core.vc_mdct_encoder_tables(self._core.pointer, tables)
        return bytes(ffi.buffer(tables))

    def follow(self, before: "MdctEncoder | None") -> None:
        """Begin with the adapted state of another encoder, for training; None = with the tables.

        The encoder then counts what the levels stand for, and its adapted tables say so.
        """
        self._before = before
        pointer = ffi.NULL if before is None else before._core.pointer
        library().vc_mdct_encoder_follow(self._core.pointer, pointer)

    def _code_packets(self, samples: Signal) -> list[bytes]:
        count = (len(samples) - self._history) // self.packet_samples
        if self._rotation is None:
            coefficients = spectra(samples, self._hop)
        else:
            rotated = spectra(aligned(samples, self._rotation.delays), self._hop)
            coefficients = limited(self._rotation.coded(rotated * self._relative_steps[None, :, None]))
        return [
            self._packet_of(part, samples[index * self.packet_samples : (index + 1) * self.packet_samples])
            for index, part in enumerate(np.split(coefficients, count))
        ]

    def _packet_of(self, coefficients: NDArray[np.int32], samples: Signal) -> bytes:
        def code(encoder: CoreEncoder, quantiser_offset: int) -> bytes:
            return encoder.packet(self.packet_samples, coefficients, quantiser_offset)

        return self._chosen(samples, partial(code, self._core), lambda offset: code(copy(self._core), offset))


class MdctDecoder(CoreDecoder):
    """Decoder of `mdct`; see codec.interface.Decoder."""

    def __init__(self, configuration: bytes, channels: int, tables: bytes | None = None) -> None:
        """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
        self._tables, table_arguments = _tables_arguments(tables)
        super().__init__(NAME, configuration, channels, *table_arguments)


def _tables_arguments(tables: bytes | None) -> tuple[Any, tuple[Any, int]]:
    """Return the memory that must stay alive, and the core's two arguments. Raises CodecError on a wrong size."""
    if tables is None:
        return None, (ffi.NULL, 0)
    size = library().vc_mdct_tables_size()
    if len(tables) != size:
        raise CodecError(f"the tables have {len(tables)} bytes, not {size}; train them again")
    memory = ffi.new("uint8_t[]", tables)
    return memory, (memory, len(tables))


def check_tables(tables: bytes) -> None:
    """Raise CodecError for the payload of a model image that does not hold tables of this codec."""
    _tables_arguments(tables)


def resolve(samples: Signal | None, signal_format: SignalFormat, model: Model | None, words: Setting) -> Setting:
    """Choose the hop and the rotation of a file by the built-in tables; see codec.interface.Codec.

    The hop has the least squared error + lambda * bits, as in the encoder's search, by an estimate at half the RMS
    value. On the development recordings, an estimate chooses as well as coding with each hop does. Rotations that save
    bits by estimate are coded, at a step of the RMS value. A live stream of the least delay has half of its usual hop.
    """
    if samples is None:
        return {"hop": str(hop_samples(signal_format.rate_hz) // 2), "rotation": NONE}
    normalised = samples[:_RESOLVING_SAMPLES] / np.array(signal_format.gains)
    steps = np.array(signal_format.rms)

    def estimated_cost(hop: int) -> float:
        filling_steps = _RESOLVING_STEP * steps
        filling = _water_filling(normalised, hop)
        errors = filling.squared_errors(filling_steps) / np.square(filling_steps)
        return float(np.sum(errors) + LAMBDA / 256 * filling.bits(filling_steps))

    def cost(hop: int, rotation: Rotation | None) -> float:
        framing = Framing(_RESOLVING_PACKET, 0)
        encoder = MdctEncoder(list(steps), signal_format.rate_hz, framing, hop=hop, rotation=rotation)
        decoder = MdctDecoder(encoder.configuration, signal_format.channels)
        packets = encoder.encode(normalised) + encoder.finish()
        decoded = np.concatenate([decoder.decode(packet) for packet in packets])[decoder.delay_samples :]
        error = np.sum(np.square((normalised - decoded[: len(normalised)] / 32768) / steps))
        side_bytes = 1 + len(rotation.pack()) if rotation else 0
        return float(error + LAMBDA / 256 * 8 * (sum(map(len, packets)) + side_bytes))

    hop, rotation = word(words, "hop"), word(words, "rotation")
    given = _rotation(rotation, signal_format.channels)
    mixable = rotation == AUTO and signal_format.channels > 1
    if hop == AUTO:
        costs = {each: estimated_cost(each) for each in HOPS}
        # Of hops that cost the same, the shortest has the least delay.
        hop = str(next(each for each in HOPS if costs[each] <= _SAME_COST * min(costs.values())))
    if mixable and len(normalised) >= 2 * int(hop) + MAX_DELAY:
        least = cost(int(hop), None)
        quietest = np.min(steps)  # by which no sample passes full scale
        for trial in candidates(
            normalised / steps, int(hop), lambda part: spectra(part * quietest, int(hop)) / (UNIT * quietest)
        ):
            if (reached := cost(int(hop), trial)) < (1 - _LEAST_GAIN) * least:
                least, given = reached, trial
    return {"hop": hop, "rotation": given.pack().hex() if given else NONE}


def _rotation(text: str, channels: int) -> Rotation | None:
    """Return the rotation of a setting. Raises CodecError for text that is none."""
    if text in (AUTO, NONE):
        return None
    try:
        section = bytes.fromhex(text)
    except ValueError as error:
        raise CodecError(f"rotation is {text!r}; give {AUTO}, {NONE}, or the section of one in hexadecimal") from error
    return Rotation.unpack(section, channels)


def _delay_samples(hop: int, rotation: Rotation | None) -> int:
    return hop + (rotation.delay_samples if rotation else 0)


class _WaterFilling:
    """Spectra as Gaussian variables, each of the power around it, coded by reverse water-filling.

    A variable of power p then has the error D = min(p, level), and takes log2(p / D) / 2 bits (Cover and Thomas,
    *Elements of Information Theory*, 10.3.3). On the development recordings, the SNR of `mdct` differs from this by
    0.4 dB, and its bits by 6 % (standard deviations).
    """

    def __init__(self, spectra: NDArray[np.int32], unit: float) -> None:
        """Take coefficients (blocks, channels, bins), full scale = `unit`."""
        powers = np.pad(np.square(spectra.astype(np.float32)), ((1, 1), (0, 0), (2, 2)), mode="edge")
        # Weights over blocks are 1, 2, 1, and over bins 1, 2, 2, 2, 1.
        for axis, distances in ((0, (1, 1)), (2, (1, 2, 1))):
            for distance in distances:
                powers = _summed(powers, distance, axis)
        # Counted by their level, the powers of a long signal take no more time than those of a short one. The upper
        # bits of a number are its octave and, in eighths, its place in the octave.
        codes = powers.view(np.int32) >> _CODE_BITS
        levels = (codes - np.min(codes, initial=0)).swapaxes(0, 1)
        length = 1 + int(np.max(levels, initial=0))
        self._counts = np.array([np.bincount(channel.ravel(), minlength=length) for channel in levels])
        sums = np.bincount(levels.ravel(), powers.swapaxes(0, 1).ravel(), length)
        self._powers = sums / np.maximum(np.sum(self._counts, axis=0), 1) / (_SUM_OF_WEIGHTS * unit**2)

    def bits(self, steps: Signal) -> float:
        """Return the bits over all channels; `steps`: of each channel, (channels,)."""
        octaves = np.log2(np.maximum(self._powers / (ERROR_OF_STEP * np.square(steps)[:, None]), 1))
        return _BITS_OF_IDEAL * float(np.sum(self._counts * octaves)) / 2

    def squared_errors(self, steps: Signal) -> Signal:
        """Return the sum of squared errors of each channel, (channels,)."""
        errors: Signal = np.sum(
            self._counts * np.minimum(self._powers, ERROR_OF_STEP * np.square(steps)[:, None]), axis=1
        )
        return errors


def _summed(powers: NDArray[np.float32], distance: int, axis: int) -> NDArray[np.float32]:
    """Return the sums of neighbours at a distance along an axis."""
    before = (slice(None),) * axis
    return powers[(*before, slice(distance, None))] + powers[(*before, slice(None, -distance))]


def _water_filling(normalised: Signal, hop: int) -> _WaterFilling:
    """Return the estimate of coding samples (n, channels), full scale = 1, at a hop."""
    padded = np.pad(normalised, ((hop, hop + -len(normalised) % hop), (0, 0)))
    return _WaterFilling(spectra(padded, hop), UNIT)


def estimate(samples: Signal, signal_format: SignalFormat, setting: Setting, model: Model | None) -> Estimate:
    """Estimate bits and error of coding a signal, by the step; see codec.interface.Codec."""
    hop = hop_samples(signal_format.rate_hz) if word(setting, "hop") == AUTO else int(word(setting, "hop"))
    filling = _water_filling(samples / np.array(signal_format.gains), hop)
    rms = np.array(signal_format.rms)
    count = len(samples)
    return lambda step: (filling.bits(step * rms) / count, filling.squared_errors(step * rms) / count)


def make_encoder(
    setting: Setting,
    signal_format: SignalFormat,
    framing: Framing,
    model: Model | None,
    rate_control: RateControl | None = None,
) -> MdctEncoder:
    """Make an encoder whose steps are relative to the RMS values. Raises CodecError as `MdctEncoder`."""
    relative_steps = numbers(setting, "step", signal_format.channels)
    steps = [
        min(max(step * rms, MIN_STEP), MAX_STEP) for step, rms in zip(relative_steps, signal_format.rms, strict=True)
    ]
    live_hop = hop_samples(signal_format.rate_hz)
    hop = live_hop if word(setting, "hop") == AUTO else int(word(setting, "hop"))
    rotation = _rotation(word(setting, "rotation"), signal_format.channels)
    delay_samples = _delay_samples(hop, rotation)
    if framing.refresh_packets == 0:
        # A file's framing has room for one block of a live stream after the end; this hop needs another.
        framing = Framing(max(1, framing.packet_samples + delay_samples - live_hop), 0)
    return MdctEncoder(
        steps,
        signal_format.rate_hz,
        framing,
        model.tables if model else None,
        number(setting, "rd_weight"),
        hop,
        number(setting, "noise_filling"),
        rate_control,
        parsed_shape(word(setting, "shape")),
        rotation,
    )


class _LevelWriter(CoreEncoder):
    """Codes packets from levels, silent blocks, the quantiser offset, and whether the packet is a refresh."""

    def __init__(self, configuration: bytes, channels: int, *table_arguments: Any) -> None:
        super().__init__(NAME, configuration, channels, *table_arguments, 0, 0)
        self._encode = library().vc_mdct_write_levels


def repack(
    configuration: bytes, channels: int, tables: bytes | None, packets: Sequence[bytes], packet_samples: int
) -> tuple[bytes, list[bytes]]:
    """Code the levels of packets again in shorter packets; see codec.interface.Codec.

    Blocks keep their levels, refreshes and quantiser offsets. The signs of noise filling differ, because the number of
    a packet seeds them. Silent blocks fill the last packet.
    """
    core = library()
    _memory, table_arguments = _tables_arguments(tables)
    reader = CoreEncoder(NAME, configuration, channels, *table_arguments, 0, 0)
    head, head_bytes = unpack_varint(configuration, 0, 14)
    blocks, hop = head >> _BLOCKS_SHIFT, HOPS[head & 3]
    refreshes = [packet_sequence(packet)[1] for packet in packets]
    # A packet must begin wherever a refresh or another quantiser offset does.
    features = configuration[head_bytes + 2 * channels + 2 * bool(head & SHAPED) :][:1]
    rate_controlled = bool(features and features[0] & RATE_CONTROLLED[0])
    starts = math.gcd(blocks * rate_controlled, *(blocks * before for before, each in enumerate(refreshes) if each))
    longest = min(packet_samples // hop, MAX_PACKET_BLOCKS)
    length = max((count for count in range(1, longest + 1) if starts % count == 0), default=0)
    if length == 0:
        raise CodecError(
            f"packets of {packet_samples} samples hold no block of {hop}; encode with a shorter hop or at a lower rate"
        )
    configuration = pack_varint(length << _BLOCKS_SHIFT | head & (1 << _BLOCKS_SHIFT) - 1) + configuration[head_bytes:]
    writer = _LevelWriter(configuration, channels, *table_arguments)
    read_levels, read_silent = np.empty((blocks, channels, hop), np.int32), np.empty((blocks, channels), np.uint8)
    read_offset = ffi.new("int32_t *")
    into = (
        ffi.cast("int32_t *", read_levels.ctypes.data),
        ffi.cast("uint8_t *", read_silent.ctypes.data),
        read_offset,
    )
    levels, silent = read_levels[:0], read_silent[:0]
    offsets: list[int] = []
    written: list[bytes] = []
    for done, packet in enumerate(packets, 1):
        if core.vc_mdct_read_levels(reader.pointer, packet, len(packet), *into) != core.VC_OK:
            raise damaged_packet()
        offsets.append(read_offset[0])
        levels, silent = np.concatenate([levels, read_levels]), np.concatenate([silent, read_silent])
        if done == len(packets):
            lack = -len(levels) % length
            levels = np.pad(levels, ((0, lack), (0, 0), (0, 0)))
            silent = np.pad(silent, ((0, lack), (0, 0)), constant_values=1)
        while len(levels) >= length:
            source, block = divmod(len(written) * length, blocks)
            refresh = refreshes[source] and block == 0
            written.append(writer.packet(length * hop, levels[:length], silent[:length], offsets[source], refresh))
            levels, silent = levels[length:], silent[length:]
    return configuration, written


_RATE_POINT_STEPS = tuple(2 ** (exponent / 2) for exponent in range(4, -14, -1))
"""From 2 dB of SNR to 42 dB, roughly."""

CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="low-delay MDCT, trellis-coded quantisation, trained and adaptive context mixing",
    parameters={
        "step": Parameter("quantiser step relative to the RMS value", 0.25, low=MIN_STEP, per_channel=True),
        "rd_weight": Parameter(
            "weight of bits against error in rounding; 1 = the best quality for the rate", 1.0, low=0, high=1
        ),
        "hop": Parameter(
            "samples from block to block; auto = by rate for live streams, by signal for files",
            AUTO,
            choices=(AUTO, *map(str, HOPS)),
            is_block=True,
        ),
        "rotation": Parameter(
            "mixes the channels: auto = by signal for files, none for live streams; or a section in hexadecimal",
            AUTO,
            text=True,
        ),
        "noise_filling": Parameter(
            "noise in place of zeros, in quantiser steps; 0 = none", 1 / 32, low=0, high=MAX_NOISE_FILLING
        ),
        "shape": Parameter(
            "octaves by which steps are coarser at 0, 1/32, 1/16 ... 1 of half the rate, divided by slashes",
            FLAT,
            text=True,
        ),
    },
    # The second set has the delay of a live stream at 2800 Hz.
    rate_point_sets={
        NAME: RatePoints(tuple({"step": step} for step in _RATE_POINT_STEPS)),
        f"{NAME}-live": RatePoints(tuple({"step": step, "hop": "32"} for step in _RATE_POINT_STEPS)),
    },
    make_encoder=make_encoder,
    make_decoder=MdctDecoder,
    resolve=resolve,
    tables=ModelTables(check_tables, built_in_tables),
    steps=Steps("step", lambda signal_format: (MIN_STEP, MAX_STEP / min(signal_format.rms)), estimate),
    repack=repack,
    controls_rate=True,
)
