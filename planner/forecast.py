"""What a coding of a texture costs and reaches in a scene: forecast, limits and cost, from its measurement alone."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec
from vibrocast.codec import Codec, Setting
from vibrocast.codec.threshold import FLAT, SHAPE
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, StreamHeader
from vibrocast.errors import InputError, located
from vibrocast.firmware.native_core import library
from vibrocast.output.actuator import Actuator
from vibrocast.output.profile import HAND_DELAY_US, HAND_SMOOTHING_US, min_samples
from vibrocast.output.rendering import Drive
from vibrocast.planner import costs
from vibrocast.planner.band import MARGIN_DB, Band, band_of, prepared
from vibrocast.planner.costs import MAX_LOAD_PERCENT
from vibrocast.planner.scene import MEASURES, Asked, Scene, SceneController, SceneTexture, Weights
from vibrocast.textures import Profile, Recording

BUFFERS_MS = (10.0, 8.0, 6.0, 4.0)
"""Playout delays, the usual one first; docs/benchmarks/latency.md has the shortest stable one of each controller."""


@dataclass(frozen=True)
class Subject:
    """A texture of a scene, ready to be coded.

    `band`: the band worth coding. `whole`: the texture in it, at the stream's rate. `drive_s`: the delay of the
    controller's output. `hand_speed_mm_s`: the highest.
    """

    texture: SceneTexture
    actuator: Actuator
    over_position: bool
    hand_speed_mm_s: float
    band: Band
    whole: Recording
    drive_s: float

    @property
    def samples_per_second(self) -> float:
        """Rate of the stream in Hz; over position, at the highest hand speed."""
        return self.band.rate * self.hand_speed_mm_s / 1000 if self.over_position else float(self.band.rate)


def subject_of(scene: Scene, texture: SceneTexture, threshold: NDArray[np.float64]) -> Subject:
    """Prepare a texture of a scene. `threshold`: rows as of codec.threshold.read_threshold. Raises InputError."""
    actuator, (_, speed_mm_s) = scene.actuator(texture), scene.hand_speed_mm_s
    over_position = isinstance(texture.loaded, Profile) and scene.controller(texture.controller).reads_position
    band = band_of(texture.loaded, actuator, threshold, scene.hand_speed_mm_s, over_position)
    whole = prepared(texture.loaded, speed_mm_s, over_position, band.rate, band.lowest)
    if over_position:
        least = min_samples(band.rate, actuator.dac_rate_hz)
        if not 0 < least <= len(whole.samples):
            raise InputError(
                f"{texture.name}: its {1e3 * len(whole.samples) / band.rate:.3g} mm are too short to render by "
                f"position, which needs {1e3 * least / band.rate:.3g} mm; measure a longer profile"
            )
    # Over position, heights are rendered at the DAC's rate, and the delay of the hand's positions is added.
    rate_hz = actuator.dac_rate_hz if over_position else band.rate
    header = StreamHeader(1, rate_hz, None, whole.unit, (1.0,) * texture.channels, b"")
    with located(texture.name):
        drive_s: float = Drive(header, actuator, compensation=True).delay_seconds
    hand_us = HAND_DELAY_US + 2 * HAND_SMOOTHING_US if over_position else 0
    drive_s += 1 / actuator.dac_rate_hz + hand_us / 1e6
    return Subject(texture, actuator, over_position, speed_mm_s, band, whole, drive_s)


@dataclass(frozen=True)
class CodingOption:
    """A way to code a texture, without the quality. `family`: of models, None = no model. `block`: samples, None if the
    codec has one length only. `touch`: strength of the shape by which steps differ over frequency (shape_setting).
    """

    codec: str
    family: str | None
    block: str | None
    touch: float = 0.0

    @property
    def name(self) -> str:
        """Name in the answer, such as "mdct, hop 32"."""
        block = "".join(f", {name} {value}" for name, value in self._known.block_setting(self.block).items())
        touch = f", touch {self.touch:g}" if self.touch else ""
        return (self.codec if self.family is None else f"{self.codec} with {self.family}") + block + touch

    @property
    def decoder(self) -> str:
        """Name in the tables of decoding costs."""
        return self.family or self.codec

    @property
    def given(self) -> Setting:
        """The part of the setting that the option fixes; a strength of touch replaces the shape of the steps.

        The range coder took fewer bits than the Huffman code on every texture (docs/benchmarks/results.md).
        """
        known = {"entropy": "range", SHAPE: FLAT}
        given = {name: value for name, value in known.items() if name in self._known.parameters}
        return {**given, **self._known.block_setting(self.block)}

    @property
    def _known(self) -> Codec:
        return codec.codec_by_name(self.codec)


@dataclass(frozen=True)
class Coding:
    """One coding of a texture, measured. Figures that the required quality does not need may be None.

    `index`, `packet_blocks`: the place of its setting, and the length of its packets, as of `Evaluator.evaluate`.
    `peak_bps`: the highest rate of the frames over any second. `max_frame_bytes`: of the longest frame.
    `delay_samples`: by which the codec lags its input. `error_over_threshold_db`: of the error at the skin re the felt
    level. `quiet`: as costs.quiet_part.
    """

    option: CodingOption
    index: int
    packet_blocks: int
    model: str | None
    setting: Setting
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
    error_over_threshold_db: float | None
    quiet: float


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """The forecast for a texture. Rates and quality were measured on the texture itself.

    `payload_bps`, `wire_bps`: packets alone, and in their frames. `instructions_per_second`, `load_percent`,
    `flash_bytes`, `ram_bytes`: of the controller, from this project's tables (docs/benchmarks/firmware.md), None where
    they were not measured; load is of the whole processor. `snr_db`, `spqi`, `third_octave_distance_db`: as
    evaluation.metrics measures the decoded signal in the band worth coding. `error_over_threshold_db`: the loudest
    part of the error at the skin, relative to the detection threshold. `delay_ms`: from a sample at the host to the
    skin, the sum of packet, codec, buffer, link and compensation.
    """

    payload_bps: float
    wire_bps: float
    instructions_per_second: float | None
    load_percent: float | None
    flash_bytes: int | None
    ram_bytes: int | None
    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    error_over_threshold_db: float | None
    delay_ms: float


def forecast(measured: Coding, subject: Subject, scene: Scene) -> Forecast:
    """Return what a coding costs and reaches on its controller."""
    controller = scene.controller(subject.texture.controller)
    instructions, flash_bytes, ram_bytes = load_of(measured, subject, controller) or (None, None, None)
    return Forecast(
        payload_bps=measured.payload_bps,
        wire_bps=measured.wire_bps,
        instructions_per_second=instructions,
        load_percent=100 * instructions / controller.clock_hz if instructions and controller.clock_hz else None,
        flash_bytes=flash_bytes,
        ram_bytes=ram_bytes,
        snr_db=measured.snr_db,
        spqi=measured.spqi,
        third_octave_distance_db=measured.third_octave_distance_db,
        error_over_threshold_db=measured.error_over_threshold_db,
        delay_ms=unbuffered_ms(measured, subject, scene) + buffer_ms(measured, subject, scene),
    )


def load_of(measured: Coding, subject: Subject, controller: SceneController) -> tuple[float, int, int] | None:
    """Return instructions a second, and bytes of flash and RAM; None where decoding was not measured on the core."""
    core = controller.core
    decoding = core and costs.decoder_cost(measured.option.decoder, core, measured.option.block)
    if not core or not decoding:
        return None
    channels, rate_hz = subject.texture.channels, subject.samples_per_second
    unit = PROFILE_UNIT if subject.over_position else subject.whole.unit
    packets_per_second = rate_hz / measured.packet_samples
    instructions = costs.rest_instructions(controller.address, core, unit, channels, rate_hz, packets_per_second)
    flash_bytes, ram_bytes = costs.rest_memory(channels)
    ram_bytes += decoding.ram_bytes(channels)
    if subject.over_position:  # the controller decodes it once, and keeps it
        ram_bytes += int(library().vc_profile_size(len(subject.whole.samples), channels))
    else:
        bits_per_sample = measured.payload_bps / rate_hz / channels
        instructions += decoding.instructions_per_second(bits_per_sample, measured.quiet, rate_hz, channels)
    return instructions, flash_bytes + decoding.flash_bytes, ram_bytes


def unbuffered_ms(measured: Coding, subject: Subject, scene: Scene) -> float:
    """Return the delay from a sample at the host to the skin, without the playout delay.

    A profile is on the controller before, so only the hand's position has a delay.
    """
    packet_s = 0.0
    if not subject.over_position:
        samples = measured.packet_samples + measured.delay_samples
        packet_s = samples / subject.samples_per_second + measured.max_frame_bytes / scene.link.bytes_per_second
    return scene.link.delay_ms + 1e3 * (subject.drive_s + packet_s)


def buffer_ms(measured: Coding, subject: Subject, scene: Scene) -> float:
    """Return the playout delay: the usual one, or the longest of BUFFERS_MS within the limit of the delay."""
    if subject.over_position:
        return 0.0
    left_ms = (scene.asked.delay_limit_ms or math.inf) - unbuffered_ms(measured, subject, scene)
    return next((each for each in BUFFERS_MS if each <= left_ms), BUFFERS_MS[-1])


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
        table = f"[[controllers]] {controller}:" if self.table == "controllers" else f"[{self.table}]"
        return f"{table} {self.key}"


def limits(forecast: Forecast, peak_bps: float, scene: Scene, controller: SceneController) -> tuple[Limit, ...]:
    """Return the limits of a scene, without the quality. `peak_bps`: of the frames over any second."""
    senders = len({texture.controller for texture in scene.textures})
    clock_hz = 100 / MAX_LOAD_PERCENT * (forecast.instructions_per_second or 0.0)
    return (
        Limit("asked", "rate_limit_bps", peak_bps, scene.asked.rate_limit_bps),
        Limit("link", "bytes_per_second", senders * peak_bps / 8, scene.link.bytes_per_second),
        Limit("asked", "delay_limit_ms", forecast.delay_ms, scene.asked.delay_limit_ms),
        Limit("controllers", "clock_hz", clock_hz, controller.clock_hz),
        Limit("controllers", "flash_bytes", forecast.flash_bytes or 0, controller.flash_bytes),
        Limit("controllers", "ram_bytes", forecast.ram_bytes or 0, controller.ram_bytes),
    )


@dataclass(frozen=True)
class Candidate:
    """A coding, compared with the scene.

    `quality`: in the required measure, None for silence. `shortfall`: difference from the required quality, at most 0
    if it is reached. `limits`: of the scene, without the quality. `cost`: weighted sum.
    """

    measured: Coding
    forecast: Forecast
    buffer_ms: float
    quality: float | None
    shortfall: float
    limits: tuple[Limit, ...]
    cost: float

    @property
    def broken(self) -> tuple[Limit, ...]:
        """The limits that it exceeds."""
        return tuple(each for each in self.limits if each.available is not None and each.needed > each.available)

    @property
    def meets(self) -> bool:
        """Whether it has the required quality within all limits."""
        return self.shortfall <= 0 and not self.broken


def assessed(measured: Coding, subject: Subject, scene: Scene) -> Candidate:
    """Return a coding, compared with a scene."""
    its_forecast = forecast(measured, subject, scene)
    peak_bps = 0.0 if subject.over_position else measured.peak_bps  # a profile is uploaded before
    quality, shortfall = getattr(measured, MEASURES[scene.asked.measure].figure.key), 0.0
    if quality is not None:
        shortfall = MEASURES[scene.asked.measure].figure.worse * (quality - wanted(scene.asked))
    return Candidate(
        measured,
        its_forecast,
        buffer_ms(measured, subject, scene),
        quality,
        shortfall,
        limits(its_forecast, peak_bps, scene, scene.controller(subject.texture.controller)),
        weighted(its_forecast, scene.weights),
    )


def wanted(asked: Asked) -> float:
    """Return the target quality in its measure."""
    return MARGIN_DB if asked.measure == "imperceptible" else float(getattr(asked, asked.measure))


def weighted(forecast: Forecast, weights: Weights) -> float:
    """Return the weighted cost; figures that are None count nothing."""
    memory_bytes = (forecast.flash_bytes or 0) + (forecast.ram_bytes or 0)
    return (
        weights.per_kilobit_per_second * forecast.wire_bps / 1e3
        + weights.per_million_instructions_per_second * (forecast.instructions_per_second or 0.0) / 1e6
        + weights.per_kilobyte * memory_bytes / 1e3
        + weights.per_millisecond * forecast.delay_ms
    )
