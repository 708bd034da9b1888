"""The plan file of `vibrocast plan`: how to code, send and play each texture (docs/reference/toml_files.md)."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, field, structs

from vibrocast import codec, models, textures
from vibrocast.codec import Framing, Setting
from vibrocast.codec.encoding import Encoding, measure_encoding
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.source import recording_format
from vibrocast.codec.threshold import DETECTION_THRESHOLD, sites, threshold_file
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.errors import InputError, located
from vibrocast.files import atomic_write
from vibrocast.host.bench_file import (
    Bench,
    BenchActuator,
    BenchController,
    TextureTable,
    actuator_toml,
    one_named,
    read_actuators,
)
from vibrocast.output.actuator_files import ActuatorTable
from vibrocast.planner.scene import Source
from vibrocast.textures import Profile, Recording
from vibrocast.toml_tables import Table, Text, check_names, convert, one_of, read_each, read_toml, within

FORMAT = 1
MAX_RATE = 10_000_000
MAX_BUFFER_MS = 2000
LOW_CUT_ORDER = 4


Figure = Annotated[float, within(-1e300, 1e300)]


class Forecast(Table, frozen=True, kw_only=True):
    """The forecast for a texture. Rates and quality were measured on the texture itself.

    `payload_bps`, `wire_bps`: packets alone, and in their frames. `instructions_per_second`, `load_percent`,
    `flash_bytes`, `ram_bytes`: of the controller, from this project's tables (docs/benchmarks/firmware.md), None where
    they were not measured; load is of the whole processor. `snr_db`, `spqi`, `third_octave_distance_db`: as
    evaluation.metrics measures the decoded signal in the band worth coding. `error_over_threshold_db`: the loudest
    part of the error at the skin, relative to the detection threshold. `delay_ms`: from a sample at the host to the
    skin, the sum of packet, codec, buffer, link and compensation.
    """

    payload_bps: Figure
    wire_bps: Figure
    instructions_per_second: Figure | None = None
    load_percent: Figure | None = None
    flash_bytes: int | None = None
    ram_bytes: int | None = None
    snr_db: Figure | None = None
    spqi: Figure | None = None
    third_octave_distance_db: Figure | None = None
    error_over_threshold_db: Figure | None = None
    delay_ms: Figure


class PlannedTexture(Table, frozen=True, kw_only=True):
    """How to code and send one texture.

    `hand_speed_mm_s`: at which a height profile is swept; of a profile over position, the highest.
    `over_position`: the stream is a profile, its `rate` in samples per metre; otherwise in Hz. `lowest`, `highest`:
    the band worth coding, in Hz, or in periods per metre. `packet_samples`, `refresh_packets`: as codec.Framing.
    `capped_rate_bps`, `packet_snr_db`: every packet has this SNR, or one as near to it as the rate allows, frames
    included (codec.CappedRate); None = every packet has the setting. `buffer_ms`: how long packets wait on the
    controller. `sha256`: of the texture's files, as Source gives it; None = not checked.
    """

    name: Text
    source: Source
    controller: str
    hand_speed_mm_s: Annotated[float, within(0, 1e6, "speed of the hand in mm/s")]
    over_position: bool
    codec: str
    model: Text | None = None
    setting: Mapping[str, Any] = field(default_factory=dict)
    rate: Annotated[int, within(1, MAX_RATE, "rate of the stream")]
    lowest: Annotated[float, within(0, MAX_RATE, "lowest frequency worth coding")]
    highest: Annotated[float, within(0, MAX_RATE, "highest frequency worth coding")]
    packet_samples: Annotated[int, within(1, 1 << 20, "samples of a packet")]
    refresh_packets: Annotated[int, within(0, 1 << 20, "packets between two refreshes")]
    buffer_ms: Annotated[float, within(0, MAX_BUFFER_MS, "playout delay in ms")]
    forecast: Forecast
    sha256: Text | None = None
    capped_rate_bps: Annotated[float, within(1, 1e9, "bits per second on the wire")] | None = None
    packet_snr_db: Annotated[float, within(0, 120, "SNR of a packet in dB")] | None = None

    def __post_init__(self) -> None:
        if self.lowest >= self.rate / 2:
            raise ValueError(f"lowest = {self.lowest:g} must be below half of rate = {self.rate}; lower it")
        if (self.capped_rate_bps is None) != (self.packet_snr_db is None):
            raise ValueError("capped_rate_bps and packet_snr_db go together; give both, or neither")
        if self.capped_rate_bps is not None and self.over_position:
            raise ValueError("a profile over position has no rate to cap; leave capped_rate_bps and packet_snr_db out")

    @property
    def target(self) -> RateTarget | None:
        """The target of rate control; None if every packet has the setting."""
        if self.capped_rate_bps is None:
            return None
        return RateTarget(capped_rate_bps=self.capped_rate_bps, snr_db=self.packet_snr_db)

    def recording(self) -> Recording:
        """Load the texture and bring it to the stream's rate and band. Raises TextureError, InputError."""
        self._check_files()
        return prepared(
            self.source.load(self.hand_speed_mm_s), self.hand_speed_mm_s, self.over_position, self.rate, self.lowest
        )

    def _check_files(self) -> None:
        """Raise InputError if the texture's files are missing, or have changed since they were planned."""
        for file in self.source.files:
            if not file.is_file():
                raise InputError(f"{self.name}: {file} does not exist; restore it, or plan the scene again")
        if self.sha256 is not None and self.sha256 != self.source.sha256():
            files = ", ".join(map(str, self.source.files))
            raise InputError(f"{self.name}: {files} changed since the plan was made; plan the scene again")

    def encode(self, recording: Recording | None = None) -> Encoding:
        """Code the texture as planned; `recording`: as `recording` returns it, where that has been done.

        Raises InputError.
        """
        prepared_recording = recording or self.recording()
        model = None if self.model is None else models.find(self.model)
        framing = Framing(self.packet_samples, self.refresh_packets)
        return encode(prepared_recording, self.codec, self.setting, model, framing, self.over_position, self.target)


class PlannedController(BenchController, frozen=True):
    """A controller of the plan, by the name that its textures and actuators give; the rest as in the scene."""

    clock_hz: Annotated[float, within(1e6, 5e9, "clock of the processor in Hz")] | None = None


@dataclass(frozen=True)
class Plan:
    """A plan, as `write_plan` writes it and `read_plan` reads it.

    `scene`: the scene's file. `threshold_path`: rows of the detection threshold, as in the scene.
    """

    scene: Path
    controllers: tuple[PlannedController, ...]
    actuators: tuple[BenchActuator, ...]
    textures: tuple[PlannedTexture, ...]
    threshold_path: Path = DETECTION_THRESHOLD

    def texture(self, name: str) -> PlannedTexture:
        """Return the texture of that name. Raises InputError."""
        for texture in self.textures:
            if texture.name == name:
                return texture
        raise InputError(
            f"the plan has no texture {name!r}; choose from {', '.join(each.name for each in self.textures)}"
        )

    def bench(self) -> Bench:
        """Return controllers and actuators as a bench."""
        return Bench(self.controllers, self.actuators)


def prepared(
    loaded: Recording | Profile, hand_speed_mm_s: float, over_position: bool, rate: int, lowest: float
) -> Recording:
    """Return a texture at the stream's rate, without the signal below its band. Raises TextureError.

    Resampling removes the signal above the band. Below `lowest`, a Butterworth high-pass of order LOW_CUT_ORDER runs in
    both directions, without delay. Its corner (-6 dB) lies an octave lower, so it takes 0.03 dB at `lowest`; 0 = no
    high-pass. The rate of a profile over position is per metre.
    """
    from scipy import signal

    if isinstance(loaded, Profile):
        # At 1000 mm/s, a metre takes a second, so that rates per metre are rates in hertz.
        loaded = loaded.recording(1000.0 if over_position else hand_speed_mm_s)
    recording = textures.resample(loaded, rate)
    if lowest <= 0:
        return recording
    sections = signal.butter(LOW_CUT_ORDER, lowest / 2, "highpass", fs=rate, output="sos")
    longest = len(recording.samples) - 1
    cut = signal.sosfiltfilt(sections, recording.samples, axis=0, padlen=min(longest, 3 * (2 * LOW_CUT_ORDER + 1)))
    return Recording(np.ascontiguousarray(cut), recording.rate_hz, recording.unit, recording.name)


def encode(
    recording: Recording,
    codec_name: str,
    setting: Setting,
    model: models.Model | None,
    framing: Framing,
    over_position: bool,
    target: RateTarget | None = None,
) -> Encoding:
    """Code a recording with a setting, in packets of a live stream or of a profile. Raises CodecError.

    `target`: of the rate control of a live stream; None = every packet has the setting.
    """
    unit = PROFILE_UNIT if over_position else recording.unit
    samples, rate = recording.samples, round(recording.rate_hz)
    source = codec.Source.of(samples, rate, codec_name, unit, True, model, framing=framing)
    if target is None:
        return measure_encoding(recording, source.encode(setting))
    policy = target.policy(recording_format(recording))
    return measure_encoding(recording, codec.encode_rate_controlled(source, setting, policy, framing))


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan as TOML. Paths of files start at its folder. Raises OSError."""
    folder = path.parent

    def from_folder(file: Path) -> str:
        return os.path.relpath(file, folder)

    # A threshold that ships has no path: the plan stays valid on another computer.
    shipped = {path: name for name, path in sites().items() if path != DETECTION_THRESHOLD} | {
        DETECTION_THRESHOLD: None
    }
    threshold = shipped[plan.threshold_path] if plan.threshold_path in shipped else from_folder(plan.threshold_path)
    parts = [
        "# Written by `vibrocast plan`. docs/reference/toml_files.md describes every key.",
        _lines({"format": FORMAT, "scene": from_folder(plan.scene), "threshold": threshold}),
    ]
    for controller in plan.controllers:
        parts.append("[[controllers]]\n" + _lines(structs.asdict(controller)))
    for actuator in plan.actuators:
        channel = "" if actuator.channel is None else f"channel = {actuator.channel}\n"
        parts.append(actuator_toml(actuator.model, actuator.controller) + channel)
    for texture in plan.textures:
        source = texture.source
        values = {
            "name": texture.name,
            "file": [from_folder(file) for file in source.files] or None,
            "generate": source.kind,
            **{key: getattr(texture, key) for key in texture.__struct_fields__ if key not in _TABLES},
        }
        parts.append("[[textures]]\n" + _lines(values))
        if source.options:
            parts.append("[textures.options] # properties that the file does not state\n" + _lines(source.options))
        parts.append("[textures.setting] # of the codec\n" + _lines(texture.setting))
        forecast = {
            name: float(f"{value:.6g}") if isinstance(value, float) else value
            for name, value in structs.asdict(texture.forecast).items()
        }
        parts.append("[textures.forecast] # `vibrocast plan --play` compares it with measurements\n" + _lines(forecast))
    with atomic_write(path) as partial:
        partial.write_text("\n".join(parts), encoding="utf-8")


_TABLES = ("name", "source", "setting", "forecast")


def _lines(values: Mapping[str, Any]) -> str:
    """Return key = value lines; None is left out."""
    # Texts, numbers, lists and truth values in JSON are the same in TOML.
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None)


class _PlanFile(Table, frozen=True, kw_only=True):
    format: Annotated[int, within(FORMAT, FORMAT, "version of the format")]
    scene: Text
    threshold: Text | None = None
    controllers: Annotated[tuple[PlannedController, ...], Meta(min_length=1)]
    actuators: Annotated[tuple[ActuatorTable, ...], Meta(min_length=1)]
    textures: Annotated[tuple[dict[str, Any], ...], Meta(min_length=1, description="tables [[textures]]")]


def is_plan(path: Path) -> bool:
    """Return whether a TOML file is a plan rather than a scene. Raises InputError, and OSError if it cannot be read."""
    with located(path):
        return "format" in read_toml(path, "scene or plan")


def read_plan(path: Path) -> Plan:
    """Read a plan file. Raises InputError, and OSError if it cannot be read."""
    folder = path.parent
    with located(path):
        file = convert(read_toml(path, "plan"), _PlanFile)
        names = [controller.name for controller in file.controllers]
        check_names("controllers", names)
        planned = read_each("textures", file.textures, partial(_texture, folder, names))
        check_names("textures", [texture.name for texture in planned])
        return Plan(
            folder / file.scene,
            file.controllers,
            read_actuators(file.actuators, names),
            planned,
            threshold_file(file.threshold, folder),
        )


class _Source(Table, frozen=True):
    file: tuple[str, ...] | None = None
    generate: Annotated[str, one_of(sorted(textures.GENERATORS))] | None = None
    options: dict[str, Any] = field(default_factory=dict)


def _texture(folder: Path, controllers: list[str], table: dict[str, Any]) -> PlannedTexture:
    """Return a texture of a plan. Raises ValueError."""
    own = {key: table.pop(key) for key in _Source.__struct_fields__ if key in table}
    read = convert(own, _Source)
    with located("[options]"):
        options = structs.replace(convert(read.options, TextureTable), file=read.file, generate=read.generate).options()
    source = Source(tuple(folder / file for file in read.file or ()), read.generate, options)
    texture = convert({"source": source, **table}, PlannedTexture)
    one_named(texture.controller, controllers)
    if texture.codec not in codec.CODECS:
        raise ValueError(f"codec must be one of {', '.join(sorted(codec.CODECS))}, not {texture.codec!r}")
    given = {name: tuple(part) if isinstance(part, list) else part for name, part in texture.setting.items()}
    return structs.replace(texture, setting=codec.CODECS[texture.codec].complete(given))
