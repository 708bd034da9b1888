"""The options to code a texture: cost and quality of each, measured on the texture itself, each only once."""

import math
from copy import copy
from dataclasses import replace

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec import CodecError, Framing, Setting, Signal, Source, metrics
from vibrocast.codec.encoding import Encoding, families
from vibrocast.codec.rate_control import DEFAULT_RATE_BUFFER_S, RateTarget, added_bytes
from vibrocast.codec.source import LIVE_REFRESH_S, live_framing
from vibrocast.codec.threshold import DEFAULT_TOUCH, SHAPE, read_threshold
from vibrocast.planner import costs
from vibrocast.planner.band import (
    error_over_threshold_db,
    played_codes,
    played_error_over_threshold_db,
    slowest_mm_s,
)
from vibrocast.planner.forecast import Candidate, CodingOption, MeasuredCoding, assessed, subject_of
from vibrocast.planner.plan_file import encode
from vibrocast.planner.scene import Scene, SceneTexture
from vibrocast.textures import Recording

PACKET_BLOCKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
DEFAULT_BLOCK_SAMPLES = 32
"""Of codecs with one block length; their packets are rounded up to whole blocks of their own."""
MAX_PACKET_S = LIVE_REFRESH_S
MEASURED_SAMPLES = 1 << 14
"""Samples of all channels on which candidates are compared: those of most energy in a longer texture."""
PACKET_SNRS_DB = tuple(step / 2 for step in range(1, 121))
"""SNRs of a packet that a capped rate may aim at."""
SPQI_RATE_HZ = 2800
"""SPQI counts blocks and thresholds in samples, so it is always measured at the rate of the reference data."""
_TOUCHES = {"spqi": (DEFAULT_TOUCH, 1.0), "imperceptible": (1.0,)}
"""Strengths of the shape for touch that may need fewer bits than a flat one, by the required quality."""
# In any second, a capped rate may exceed the cap by its rate buffer; half a packet may round that second. A larger
# rate buffer would need a lower cap, and lose more than it brings.
_CAP = 1 / (1 + DEFAULT_RATE_BUFFER_S / (1 - MAX_PACKET_S / 2))


class Evaluator:
    """Codes one texture of a scene by every option, and measures each coding once. Raises InputError."""

    def __init__(self, scene: Scene, texture: SceneTexture) -> None:
        self.scene = scene
        self._threshold = read_threshold(scene.threshold_path)
        self.subject = subject_of(scene, texture, self._threshold)
        self._excerpt = self.subject.whole if self.subject.over_position else _strongest(self.subject.whole)
        self._settings: dict[CodingOption, list[tuple[str | None, Setting]]] = {}
        self._measured: dict[tuple[CodingOption, int, int, bool], MeasuredCoding | None] = {}

    def in_scene(self, scene: Scene) -> "Evaluator":
        """Return one with the same measurements in a scene with other limits, targets or weights."""
        other = copy(self)
        other.scene = scene
        return other

    def candidates(self) -> tuple[Candidate, ...]:
        """Return all codings measured so far whose packets are not longer than asked for, compared with the scene."""
        return tuple(
            assessed(each, self.subject, self.scene)
            for (option, _, blocks, _), each in self._measured.items()
            if each is not None and (blocks == 1 or blocks * _block_samples(option) <= self._longest_packet)
        )

    def options(self) -> list[CodingOption]:
        """Return the options that the controller can decode, usually the cheapest first."""
        core = self.scene.controller(self.subject.texture.controller).core
        found = []
        for name, each in codec.CODECS.items():
            if self.scene.asked.waveform and not each.keeps_waveform:
                continue
            shipped = [members[0].family for members in families(each)]
            names = shipped if each.needs_model else [None, *shipped]
            shapes = SHAPE in each.parameters and not self.subject.over_position
            touches = (0.0, *(_TOUCHES.get(self.scene.asked.measure, ()) if shapes else ()))
            found += [
                CodingOption(name, family, block, touch)
                for family in names
                for block in each.blocks or (None,)
                for touch in touches
            ]
        found = [option for option in found if _block_samples(option) <= self._longest_packet]
        return [option for option in found if core is None or costs.decoder_cost(option.decoder, core) is not None]

    def settings(self, option: CodingOption) -> list[tuple[str | None, Setting]]:
        """Return the settings of an option, each with its model's name, the coarsest first.

        Empty if the codec rejects this texture.
        """
        if option not in self._settings:
            chosen = codec.codec_by_name(option.codec)
            part = self._excerpt
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
        chosen, part = codec.codec_by_name(option.codec), self._excerpt
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
        reached = (
            each is not None and (each.measured.snr_db is None or each.measured.snr_db >= snr_db) for each in coded
        )
        return next((model for model, enough in zip(every, reached, strict=True) if enough), every[-1])

    @property
    def _longest_packet(self) -> float:
        """The most samples of a packet.

        Longer packets take fewer bits, and delay the signal. So without a limit of the delay, none is longer than those
        of a live stream (`codec.source.live_framing`).
        """
        rate = self.subject.samples_per_second
        if self.scene.asked.delay_limit_ms is None and not self.subject.over_position:
            return live_framing(round(rate)).packet_samples
        return MAX_PACKET_S * rate

    def packet_blocks(self, option: CodingOption) -> list[int]:
        """Return the packet lengths of an option, in blocks."""
        longest = self._longest_packet / _block_samples(option)
        return [blocks for blocks in PACKET_BLOCKS if blocks <= longest] or [1]

    def evaluate(self, option: CodingOption, index: int, packet_blocks: int, whole: bool = False) -> Candidate | None:
        """Code with a setting of an option, in packets of `packet_blocks` blocks; None if the codec rejects it.

        `whole`: code all of the texture, and measure every quality.
        """
        key = option, index, packet_blocks, whole
        if key not in self._measured:
            recording = self.subject.whole if whole else self._excerpt
            try:
                self._measured[key] = self._coded(option, index, packet_blocks, recording, whole)
            except CodecError:
                self._measured[key] = None
        measured = self._measured[key]
        return None if measured is None else assessed(measured, self.subject, self.scene)

    def _coded(
        self, option: CodingOption, index: int, packet_blocks: int, recording: Recording, every: bool
    ) -> MeasuredCoding:
        model_name, setting, packet_snr_db = self.qualities(option)[index]
        target = None
        if option.rate_limit_bps is not None:
            target = RateTarget(capped_rate_bps=math.floor(_CAP * option.rate_limit_bps), snr_db=packet_snr_db)
        rate_hz = self.subject.samples_per_second
        packet_samples = packet_blocks * _block_samples(option)
        refresh_packets = max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples))
        model = None if model_name is None else models.find(model_name)
        encoding = encode(
            recording,
            option.codec,
            setting,
            model,
            Framing(packet_samples, refresh_packets),
            self.subject.over_position,
            target,
        )
        decoded = encoding.stream.decode()
        felt = [recording]
        if self.subject.over_position:
            felt = [
                replace(recording, rate_hz=recording.rate_hz * speed_mm_s / 1000)
                for speed_mm_s in (self.subject.hand_speed_mm_s, slowest_mm_s(self.scene.hand_speed_mm_s))
            ]
        packets = encoding.stream.packets
        frames = [len(packet) + added_bytes(packet) for packet in packets]
        packet_s = encoding.stream.packet_samples / rate_hz
        seconds = len(packets) * packet_s
        spectral = every or self.scene.asked.measure == "third_octave_distance_db"
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
            spqi=spqi(felt[0], decoded) if every or self.scene.asked.measure == "spqi" else None,
            third_octave_distance_db=(
                metrics.measure(recording.samples, decoded, felt[0].rate_hz, recording.unit).third_octave_distance_db
                if spectral
                else None
            ),
            error_db=self._error_db(encoding, felt) if every or self.scene.asked.measure == "imperceptible" else None,
            quiet=costs.quiet_part(encoding.stream.decode_integers()),
        )

    def _error_db(self, encoding: Encoding, felt: list[Recording]) -> float:
        """Return the level of the error at the skin re the felt level; over position at several speeds."""
        stream = encoding.stream
        if self.subject.over_position:
            decoded = stream.decode()
            return max(error_over_threshold_db(each, decoded, self.subject.actuator, self._threshold) for each in felt)
        codes = played_codes(stream, stream.decode_integers(), self.subject.actuator)
        return played_error_over_threshold_db(
            stream, encoding.recording, codes, self.subject.actuator, self.subject.actuator, self._threshold
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
