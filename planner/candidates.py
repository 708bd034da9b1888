"""The options to code a texture: cost and quality of each, measured on the texture itself, each only once."""

import math
from dataclasses import dataclass, replace

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec import Codec, CodecError, Framing, Setting, Signal, Source, metrics
from vibrocast.codec.encoding import Encoding, families
from vibrocast.codec.rate_control import DEFAULT_RATE_BUFFER_S, RateTarget, added_bytes
from vibrocast.codec.source import LIVE_REFRESH_S
from vibrocast.codec.threshold import DEFAULT_TOUCH, FLAT, SHAPE, read_threshold
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, StreamHeader
from vibrocast.errors import InputError, located
from vibrocast.firmware.native_core import library
from vibrocast.output.profile import HAND_DELAY_US, HAND_SMOOTHING_US, min_samples
from vibrocast.output.rendering import Drive
from vibrocast.planner import costs
from vibrocast.planner.band import (
    MARGIN_DB,
    band_of,
    error_over_threshold_db,
    played_codes,
    played_error_over_threshold_db,
    slowest_mm_s,
)
from vibrocast.planner.costs import MAX_LOAD_PERCENT
from vibrocast.planner.plan_file import Forecast, encode, prepared
from vibrocast.planner.scene import MEASURES, Asked, Scene, SceneTexture, Weights
from vibrocast.textures import Profile, Recording

PACKET_BLOCKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
DEFAULT_BLOCK_SAMPLES = 32
"""Of codecs with one block length; their packets are rounded up to whole blocks of their own."""
_PLANNED = {"entropy": "range"}
"""Parameters, of codecs that have them, whose best value is known: the range coder took fewer bits than the Huffman
code on every texture (docs/benchmarks/results.md)."""
MAX_PACKET_S = LIVE_REFRESH_S
MEASURED_SAMPLES = 1 << 14
"""Samples of all channels on which candidates are compared: those of most energy in a longer texture."""
PACKET_SNRS_DB = tuple(step / 2 for step in range(1, 121))
"""SNRs of a packet that a capped rate may aim at."""
SPQI_RATE_HZ = 2800
"""SPQI counts blocks and thresholds in samples, so it is always measured at the rate of the reference data."""
BUFFERS_MS = (10.0, 8.0, 6.0, 4.0)
"""Playout delays, the usual one first; docs/benchmarks/latency.md has the shortest stable one of each controller."""

_TOUCHES = {"spqi": (DEFAULT_TOUCH, 1.0), "imperceptible": (1.0,)}
"""Strengths of the shape for touch that may need fewer bits than a flat one, by the required quality."""
# In any second, a capped rate may exceed the cap by its rate buffer; half a packet may round that second. A larger
# rate buffer would need a lower cap, and lose more than it brings.
_CAP = 1 / (1 + DEFAULT_RATE_BUFFER_S / (1 - MAX_PACKET_S / 2))


@dataclass(frozen=True)
class CodingOption:
    """A way to code a texture, without the quality. `family`: of models, None = no model. `block`: samples, None if the
    codec has one length only. `touch`: strength of the shape by which steps differ over frequency (shape_setting).

    `rate_limit_bps`: limit over any second that a capped rate keeps; None = every packet has the setting.
    """

    codec: str
    family: str | None
    block: str | None
    touch: float = 0.0
    rate_limit_bps: float | None = None

    @property
    def name(self) -> str:
        """Name in the answer, such as "mdct, hop 32"."""
        block = "".join(f", {name} {value}" for name, value in self._known.block_setting(self.block).items())
        capped = "" if self.rate_limit_bps is None else f", capped to {self.rate_limit_bps:g} bit/s"
        touch = f", touch {self.touch:g}" if self.touch else ""
        return (self.codec if self.family is None else f"{self.codec} with {self.family}") + block + touch + capped

    @property
    def decoder(self) -> str:
        """Name in the tables of decoding costs."""
        return self.family or self.codec

    @property
    def given(self) -> Setting:
        """The part of the setting that the option fixes; a strength of touch replaces the shape of the steps."""
        known = {**_PLANNED, SHAPE: FLAT}
        given = {name: value for name, value in known.items() if name in self._known.parameters}
        return {**given, **self._known.block_setting(self.block)}

    @property
    def _known(self) -> Codec:
        return codec.codec_by_name(self.codec)


@dataclass(frozen=True)
class MeasuredCoding:
    """One coding of a texture, measured. Figures that the required quality does not need may be None.

    `peak_bps`: the highest rate of the frames over any second. `max_frame_bytes`: of the longest frame.
    `delay_samples`: by which the codec lags its input. `error_db`: of the error at the skin re the felt level.
    `quiet`: as costs.quiet_part. `target`: of rate control, None = every packet has the setting.
    """

    option: CodingOption
    model: str | None
    setting: Setting
    target: RateTarget | None
    packet_samples: int
    refresh_packets: int
    payload_bps: float
    wire_bps: float
    peak_bps: float
    max_frame_bytes: int
    delay_samples: int
    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    error_db: float | None
    quiet: float

    @property
    def rate_buffer_bytes(self) -> float:
        """The most data of a capped rate that may wait on a link of that rate; 0 without a cap."""
        return 0.0 if self.target is None else (self.target.rate_bps or 0.0) * DEFAULT_RATE_BUFFER_S / 8


@dataclass(frozen=True)
class Limit:
    """A limit of the scene: the value that a candidate needs, and the available one, None = no limit.

    `table`, `key`: its place in the scene. Limits of a controller are those of the one that plays the texture.
    """

    table: str
    key: str
    needed: float
    available: float | None

    def place(self, controller: str) -> str:
        """Return its place in the scene. `controller`: name of the one that plays the texture."""
        return (
            f"[[controllers]] {controller}: {self.key}" if self.table == "controllers" else f"[{self.table}] {self.key}"
        )

    @property
    def kept(self) -> bool:
        """Whether the candidate keeps the limit."""
        return self.available is None or self.needed <= self.available


@dataclass(frozen=True)
class Candidate:
    """A coding, compared with the scene.

    `quality`: in the required measure, None for silence. `shortfall`: difference from the required quality, at most 0
    if it is reached. `limits`: of the scene, without the quality. `cost`: weighted sum.
    """

    measured: MeasuredCoding
    forecast: Forecast
    buffer_ms: float
    quality: float | None
    shortfall: float
    limits: tuple[Limit, ...]
    cost: float

    @property
    def broken(self) -> tuple[Limit, ...]:
        """The limits that it exceeds."""
        return tuple(limit for limit in self.limits if not limit.kept)

    @property
    def meets(self) -> bool:
        """Whether it has the required quality within all limits."""
        return self.shortfall <= 0 and not self.broken


class Evaluator:
    """One texture of a scene, ready to be coded by every option; each coding is measured once.

    `band`: the band worth coding. `whole`: the texture in it, at the stream's rate. Raises InputError.
    """

    def __init__(self, scene: Scene, texture: SceneTexture) -> None:
        self.texture = texture
        self.actuator = scene.actuator(texture)
        self._threshold = read_threshold(scene.threshold_path)
        self._measure, self._waveform = scene.asked.measure, scene.asked.waveform
        self.over_position = isinstance(texture.loaded, Profile) and scene.controller(texture.controller).reads_position
        self._hand_speeds_mm_s = scene.hand_speed_mm_s
        self.hand_speed_mm_s = scene.hand_speed_mm_s[1]
        self.band = band_of(texture.loaded, self.actuator, self._threshold, scene.hand_speed_mm_s, self.over_position)
        self.whole = prepared(
            texture.loaded, self.hand_speed_mm_s, self.over_position, self.band.rate, self.band.lowest
        )
        if self.over_position:
            least = min_samples(self.band.rate, self.actuator.dac_rate_hz)
            if not 0 < least <= len(self.whole.samples):
                raise InputError(
                    f"{texture.name}: its {1e3 * len(self.whole.samples) / self.band.rate:.3g} mm are too short to "
                    f"render by position, which needs {1e3 * least / self.band.rate:.3g} mm; measure a longer profile"
                )
        self.excerpt = self.whole if self.over_position else _strongest(self.whole)
        self.drive_s = self._drive_s()
        self._settings: dict[CodingOption, list[tuple[str | None, Setting]]] = {}
        self._measured: dict[tuple[CodingOption, int, int, bool], MeasuredCoding | None] = {}

    @property
    def measured(self) -> list[MeasuredCoding]:
        """All codings measured so far."""
        return [each for each in self._measured.values() if each is not None]

    @property
    def samples_per_second(self) -> float:
        """Rate of the stream in Hz; over position, at the highest hand speed."""
        return self.band.rate * self.hand_speed_mm_s / 1000 if self.over_position else float(self.band.rate)

    def _drive_s(self) -> float:
        """Return the delay of the controller's output: resampling to the DAC's rate, compensation, and one DAC sample.

        Over position, heights are rendered at the DAC's rate, and the delay of the hand's positions is added.
        """
        rate_hz = self.actuator.dac_rate_hz if self.over_position else self.band.rate
        header = StreamHeader(1, rate_hz, None, self.whole.unit, (1.0,) * self.texture.channels, b"")
        with located(self.texture.name):
            output: float = Drive(header, self.actuator, compensation=True).delay_seconds
        hand_us = HAND_DELAY_US + 2 * HAND_SMOOTHING_US if self.over_position else 0
        return output + 1 / self.actuator.dac_rate_hz + hand_us / 1e6

    def options(self, core: str | None) -> list[CodingOption]:
        """Return the options that a controller can decode, usually the cheapest first. `core`: None = a computer."""
        found = []
        for name, each in codec.CODECS.items():
            if self._waveform and not each.keeps_waveform:
                continue
            shipped = [members[0].family for members in families(each)]
            names = shipped if each.needs_model else [None, *shipped]
            shapes = SHAPE in each.parameters and not self.over_position
            touches = (0.0, *(_TOUCHES.get(self._measure, ()) if shapes else ()))
            found += [
                CodingOption(name, family, block, touch)
                for family in names
                for block in each.blocks or (None,)
                for touch in touches
            ]
        longest = MAX_PACKET_S * self.samples_per_second
        found = [option for option in found if option.block is None or int(option.block) <= longest]
        return [option for option in found if core is None or costs.decoder_cost(option.decoder, core) is not None]

    def settings(self, option: CodingOption) -> list[tuple[str | None, Setting]]:
        """Return the settings of an option, each with its model's name, the coarsest first.

        Empty if the codec rejects this texture.
        """
        if option not in self._settings:
            chosen = codec.codec_by_name(option.codec)
            part = self.excerpt
            members = [None] if option.family is None else models.members(option.family)
            found: list[tuple[str | None, Setting]] = []
            try:
                for model in members:
                    source = Source.of(part.samples, round(part.rate_hz), option.codec, part.unit, True, model)
                    name = None if model is None else model.name
                    found += [(name, chosen.complete(setting)) for setting in source.settings(self._given(option))]
            except CodecError:
                found = []
            self._settings[option] = found
        return self._settings[option]

    def _given(self, option: CodingOption) -> Setting:
        """Return the part of the setting that an option fixes for this texture. Raises CodecError."""
        chosen, part = codec.codec_by_name(option.codec), self.excerpt
        return {**option.given, **codec.shape_setting(chosen, option.touch, part.rate_hz, part.unit)}

    def qualities(self, option: CodingOption) -> list[tuple[str | None, Setting, float | None]]:
        """Return models and settings of an option, the coarsest first; with a capped rate, for each SNR of a packet."""
        every = self.settings(option if option.rate_limit_bps is None else replace(option, rate_limit_bps=None))
        if option.rate_limit_bps is None:
            return [(model, setting, None) for model, setting in every]
        setting = codec.codec_by_name(option.codec).complete(self._given(option))
        return [(self._model_for(option, snr_db), setting, snr_db) for snr_db in PACKET_SNRS_DB]

    def _model_for(self, option: CodingOption, snr_db: float) -> str | None:
        """Return the coarsest model of an option's family that reaches an SNR by itself; else the finest."""
        own = replace(option, rate_limit_bps=None)
        every = [model for model, _ in self.settings(own)]
        if len(set(every)) < 2:
            return every[0] if every else None
        coded = (self.evaluate(own, index, PACKET_BLOCKS[-1]) for index in range(len(every)))
        reached = (each is not None and (each.snr_db is None or each.snr_db >= snr_db) for each in coded)
        return next((model for model, enough in zip(every, reached, strict=True) if enough), every[-1])

    def packet_blocks(self, option: CodingOption) -> list[int]:
        """Return the packet lengths of an option, in blocks."""
        longest = MAX_PACKET_S * self.samples_per_second / _block_samples(option)
        return [blocks for blocks in PACKET_BLOCKS if blocks <= longest] or [1]

    def evaluate(
        self, option: CodingOption, index: int, packet_blocks: int, whole: bool = False
    ) -> MeasuredCoding | None:
        """Code with a setting of an option, in packets of `packet_blocks` blocks; None if the codec rejects it.

        `whole`: code all of the texture, and measure every quality.
        """
        key = option, index, packet_blocks, whole
        if key not in self._measured:
            recording = self.whole if whole else self.excerpt
            try:
                self._measured[key] = self._coded(option, index, packet_blocks, recording, whole)
            except CodecError:
                self._measured[key] = None
        return self._measured[key]

    def _coded(
        self, option: CodingOption, index: int, packet_blocks: int, recording: Recording, every: bool
    ) -> MeasuredCoding:
        model_name, setting, packet_snr_db = self.qualities(option)[index]
        target = None
        if option.rate_limit_bps is not None:
            target = RateTarget(capped_rate_bps=math.floor(_CAP * option.rate_limit_bps), snr_db=packet_snr_db)
        rate_hz = self.samples_per_second
        packet_samples = packet_blocks * _block_samples(option)
        refresh_packets = max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples))
        model = None if model_name is None else models.find(model_name)
        encoding = encode(
            recording,
            option.codec,
            setting,
            model,
            Framing(packet_samples, refresh_packets),
            self.over_position,
            target,
        )
        decoded = encoding.stream.decode()
        felt = [recording]
        if self.over_position:
            felt = [
                replace(recording, rate_hz=recording.rate_hz * speed_mm_s / 1000)
                for speed_mm_s in (self.hand_speed_mm_s, slowest_mm_s(self._hand_speeds_mm_s))
            ]
        packets = encoding.stream.packets
        frames = [len(packet) + added_bytes(packet) for packet in packets]
        packet_s = encoding.stream.packet_samples / rate_hz
        seconds = len(packets) * packet_s
        spectral = every or self._measure == "third_octave_distance_db"
        return MeasuredCoding(
            option=option,
            model=model_name,
            setting=setting,
            target=target,
            packet_samples=encoding.stream.packet_samples,
            refresh_packets=refresh_packets,
            payload_bps=8 * sum(map(len, packets)) / seconds,
            wire_bps=8 * sum(frames) / seconds,
            peak_bps=_peak_bps(frames, packet_s),
            max_frame_bytes=max(frames),
            delay_samples=encoding.stream.delay_samples,
            snr_db=encoding.quality.snr_db,
            spqi=spqi(felt[0], decoded) if every or self._measure == "spqi" else None,
            third_octave_distance_db=(
                metrics.measure(recording.samples, decoded, felt[0].rate_hz, recording.unit).third_octave_distance_db
                if spectral
                else None
            ),
            error_db=self._error_db(encoding, felt) if every or self._measure == "imperceptible" else None,
            quiet=costs.quiet_part(encoding.stream.decode_integers()),
        )

    def _error_db(self, encoding: Encoding, felt: list[Recording]) -> float:
        """Return the level of the error at the skin re the felt level; over position at several speeds."""
        stream = encoding.stream
        if self.over_position:
            decoded = stream.decode()
            return max(error_over_threshold_db(each, decoded, self.actuator, self._threshold) for each in felt)
        codes = played_codes(stream, stream.decode_integers(), self.actuator)
        return played_error_over_threshold_db(
            stream, encoding.recording, codes, self.actuator, self.actuator, self._threshold
        )

    def assessed(self, measured: MeasuredCoding, scene: Scene) -> Candidate:
        """Return a coding, compared with a scene. Its limits and targets may differ from the evaluator's scene."""
        controller, asked = scene.controller(self.texture.controller), scene.asked
        channels, rate_hz = self.texture.channels, self.samples_per_second
        decoding = (
            None
            if controller.core is None
            else costs.decoder_cost(measured.option.decoder, controller.core, measured.option.block)
        )
        instructions = load_percent = flash_bytes = ram_bytes = None
        if decoding is not None and controller.core is not None and controller.clock_hz is not None:
            bits_per_sample = measured.payload_bps / rate_hz / channels
            unit = PROFILE_UNIT if self.over_position else self.whole.unit
            instructions = costs.rest_instructions(
                controller.address, controller.core, unit, channels, rate_hz, rate_hz / measured.packet_samples
            )
            rest_flash_bytes, rest_ram_bytes = costs.rest_memory(channels)
            flash_bytes = rest_flash_bytes + decoding.flash_bytes
            ram_bytes = rest_ram_bytes + decoding.ram_bytes(channels)
            if self.over_position:  # the controller decodes it once, and keeps it
                ram_bytes += int(library().vc_profile_size(len(self.whole.samples), channels))
            else:
                instructions += decoding.instructions_per_second(bits_per_sample, measured.quiet, rate_hz, channels)
            load_percent = 100 * instructions / controller.clock_hz
        fixed_ms, buffer_ms = scene.link.delay_ms + 1e3 * self.drive_s, 0.0
        if not self.over_position:  # a profile is on the controller before, so only the hand's position has a delay
            samples = measured.packet_samples + measured.delay_samples
            carried = scene.link.bytes_per_second or math.inf
            fixed_ms += 1e3 * (samples / rate_hz + measured.max_frame_bytes / carried)
            max_ms = asked.delay_limit_ms or math.inf
            wait_ms = 1e3 * measured.rate_buffer_bytes / carried
            buffer_ms = wait_ms + next(
                (margin for margin in BUFFERS_MS if fixed_ms + wait_ms + margin <= max_ms), BUFFERS_MS[-1]
            )
        forecast = Forecast(
            payload_bps=measured.payload_bps,
            wire_bps=measured.wire_bps,
            instructions_per_second=instructions,
            load_percent=load_percent,
            flash_bytes=flash_bytes,
            ram_bytes=ram_bytes,
            snr_db=measured.snr_db,
            spqi=measured.spqi,
            third_octave_distance_db=measured.third_octave_distance_db,
            error_over_threshold_db=measured.error_db,
            delay_ms=fixed_ms + buffer_ms,
        )
        peak_bps = 0.0 if self.over_position else measured.peak_bps  # a profile is uploaded before
        quality, shortfall = quality_of(measured, asked)
        senders = len({texture.controller for texture in scene.textures})
        limits = (
            Limit("asked", "rate_limit_bps", peak_bps, asked.rate_limit_bps),
            Limit("link", "bytes_per_second", senders * peak_bps / 8, scene.link.bytes_per_second),
            Limit("asked", "delay_limit_ms", forecast.delay_ms, asked.delay_limit_ms),
            Limit("controllers", "clock_hz", 100 / MAX_LOAD_PERCENT * (instructions or 0.0), controller.clock_hz),
            Limit("controllers", "flash_bytes", flash_bytes or 0, controller.flash_bytes),
            Limit("controllers", "ram_bytes", ram_bytes or 0, controller.ram_bytes),
        )
        cost = sum(each.weight * each.amount / each.per for each in costs_of(forecast, scene.weights))
        return Candidate(measured, forecast, buffer_ms, quality, shortfall, limits, cost)


def wanted(asked: Asked) -> float:
    """Return the target quality in its measure."""
    return MARGIN_DB if asked.measure == "imperceptible" else float(getattr(asked, asked.measure))


def quality_of(measured: MeasuredCoding, asked: Asked) -> tuple[float | None, float]:
    """Return the quality in the required measure, and its shortfall: at most 0 if it is reached."""
    quality = measured.error_db if asked.measure == "imperceptible" else getattr(measured, asked.measure)
    return quality, 0.0 if quality is None else MEASURES[asked.measure].figure.worse * (quality - wanted(asked))


@dataclass(frozen=True)
class Cost:
    """One cost of a candidate: its `amount` over `per` counts `weight`. `more`: unit of a difference, in words."""

    name: str
    more: str
    amount: float
    per: float
    weight: float


def costs_of(forecast: Forecast, weights: Weights) -> tuple[Cost, ...]:
    """Return all costs; figures that are None count nothing."""
    instructions, its_weight = forecast.instructions_per_second or 0.0, weights.per_million_instructions_per_second
    memory_bytes = (forecast.flash_bytes or 0) + (forecast.ram_bytes or 0)
    return (
        Cost("bits", "kbit/s more", forecast.wire_bps, 1e3, weights.per_kilobit_per_second),
        Cost("instructions", "million instructions/s more", instructions, 1e6, its_weight),
        Cost("memory", "kB more memory", memory_bytes, 1e3, weights.per_kilobyte),
        Cost("delay", "ms more delay", forecast.delay_ms, 1.0, weights.per_millisecond),
    )


def spqi(reference: Recording, decoded: Signal) -> float | None:
    """Return SPQI at SPQI_RATE_HZ, whatever the stream's rate."""
    other = Recording(decoded, reference.rate_hz, reference.unit, reference.name)
    x, y = (textures.resample(each, SPQI_RATE_HZ).samples for each in (reference, other))
    return metrics.measure(x, y, SPQI_RATE_HZ).spqi


def _strongest(recording: Recording) -> Recording:
    """Return the MEASURED_SAMPLES of most energy, or all of a shorter recording."""
    samples = recording.samples
    count = max(1, MEASURED_SAMPLES // recording.channels)
    if len(samples) <= count:
        return recording
    energy = np.concatenate([[0.0], np.cumsum(np.sum(np.square(samples), axis=1))])
    start = int(np.argmax(energy[count:] - energy[:-count]))
    part = np.ascontiguousarray(samples[start : start + count])
    return Recording(part, recording.rate_hz, recording.unit, recording.name)


def _peak_bps(frames: list[int], packet_s: float) -> float:
    """Return the highest rate of the frames over any second of whole packets, in bit/s."""
    count = min(len(frames), max(1, round(1 / packet_s)))
    sums = np.concatenate([[0], np.cumsum(frames)])
    return float(8 * np.max(sums[count:] - sums[:-count]) / (count * packet_s))


def _block_samples(option: CodingOption) -> int:
    return DEFAULT_BLOCK_SAMPLES if option.block is None else int(option.block)
